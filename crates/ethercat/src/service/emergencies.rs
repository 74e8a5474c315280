//! Emergencies of a slave that wait to be taken.

use crate::wire::mailbox::Emergency;

/// Emergencies that wait to be taken; later ones are counted and dropped.
pub(super) const EMERGENCIES: usize = 8;

/// Emergencies in their order.
#[derive(Debug, Default)]
pub struct Emergencies {
    places: [Emergency; EMERGENCIES],
    first: usize,
    pub(super) count: usize,
}

impl Emergencies {
    /// False: there is no room.
    pub(super) fn push(&mut self, emergency: Emergency) -> bool {
        let has_room = self.count < EMERGENCIES;
        if has_room {
            self.places[(self.first + self.count) % EMERGENCIES] = emergency;
            self.count += 1;
        }
        has_room
    }

    pub(super) fn pop(&mut self) -> Option<Emergency> {
        self.count = self.count.checked_sub(1)?;
        let next = self.places[self.first];
        self.first = (self.first + 1) % EMERGENCIES;
        Some(next)
    }
}
