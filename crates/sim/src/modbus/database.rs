//! The values of the parameters: in use, saved, and as delivered; and the parameters that menu 0 shows.
//! Knows nothing of a parameter's effect. A written value is lost at a restart unless it was saved: xx.000 = 1000
//! or 1001 in any menu, then a reset of the drive; 1233 and 1244 restore the values as delivered (all four
//! assumed).

use super::settings::UnidriveSettings;
use super::table::{self, Row, TABLE};

/// Values of xx.000.
const SAVE: [i32; 2] = [1000, 1001];
const RESTORE: [i32; 2] = [1233, 1244];

/// All values, in the order of the table.
#[derive(Debug)]
pub(super) struct Database {
    rows: &'static [Row],
    used: Vec<i32>,
    saved: Vec<i32>,
    delivered: Vec<i32>,
    /// The parameters that menu 0 shows, by their index in the table.
    shown: [Option<usize>; table::SETUPS],
    menu_zero: bool,
    /// Modified addressing is in use since the last start.
    modified: bool,
}

impl Database {
    pub(super) fn new(settings: &UnidriveSettings) -> Database {
        let rows = &TABLE.rows[..];
        let mut delivered: Vec<i32> = rows.iter().map(|row| row.default).collect();
        let motor = &settings.motor;
        let modified = settings.interface.modified;
        for (row, value) in [
            (table::MAXIMUM_REFERENCE, motor.rated_rpm * 1e1),
            (table::RATED_SPEED, motor.rated_rpm * 1e2),
            (table::ACCELERATION, settings.ramps_s.0 * 1e3),
            (table::DECELERATION, settings.ramps_s.1 * 1e3),
            (table::ADDRESSING, modified.into()),
        ] {
            delivered[row] = rows[row].clamp(value.round() as i32);
        }
        let parts = [settings.serial % 1_000_000_000, settings.serial / 1_000_000_000];
        for (row, part) in table::SERIAL.into_iter().zip(parts) {
            delivered[row] = rows[row].clamp(i32::try_from(part).unwrap_or(i32::MAX));
        }
        let mut saved = delivered.clone();
        for ([menu, number], value) in &settings.commissioned {
            if let Some(row) = TABLE
                .find(*menu, *number)
                .or_else(|| TABLE.find(menu.saturating_add(table::INTERFACE), *number))
            {
                saved[row] = rows[row].clamp(*value);
            }
        }
        let mut database = Database {
            rows,
            used: saved.clone(),
            saved,
            delivered,
            shown: [None; table::SETUPS],
            menu_zero: settings.interface.menu_zero,
            modified,
        };
        database.restart();
        database
    }

    /// The saved values are in use again.
    pub(super) fn restart(&mut self) {
        for (place, row) in self.rows.iter().enumerate() {
            self.used[place] = if row.saved { self.saved[place] } else { row.default };
        }
        self.modified = self.is_on(table::ADDRESSING);
        self.show();
    }

    /// The drive was reset: commands in any xx.000 are carried out.
    pub(super) fn reset(&mut self) {
        let mut commands = [0; 2];
        for (row, value) in self.rows.iter().zip(&mut self.used).filter(|(row, _)| row.number == 0) {
            commands[0] |= i32::from(SAVE.contains(value));
            commands[1] |= i32::from(RESTORE.contains(value));
            *value = row.default;
        }
        match commands {
            [_, 1] => {
                self.saved.copy_from_slice(&self.delivered);
                for (place, _) in self.rows.iter().enumerate().filter(|(_, row)| row.saved) {
                    self.used[place] = self.saved[place];
                }
                self.show();
            }
            [1, _] => self.saved.copy_from_slice(&self.used),
            _ => {}
        }
    }

    /// The parameter at this index.
    pub(super) fn row(&self, place: usize) -> &'static Row {
        &self.rows[place]
    }

    /// The value of the parameter at this index.
    pub(super) fn get(&self, place: usize) -> i32 {
        self.used[place]
    }

    /// Whether a flag is set.
    pub(super) fn is_on(&self, place: usize) -> bool {
        self.used[place] != 0
    }

    /// Gives it a value that was checked, or that is the drive's own.
    pub(super) fn set(&mut self, place: usize, value: i32) {
        self.used[place] = value;
        if self.rows[place].menu == table::SETUP_MENU {
            self.show();
        }
    }

    /// The index of a parameter of the interface itself or of the drive; that of menu 0 is the one that it shows.
    pub(super) fn find(&self, menu: u8, number: u8, is_own: bool) -> Option<usize> {
        match menu {
            _ if is_own => TABLE.find(menu.checked_add(table::INTERFACE)?, number),
            0 => *self.shown.get(usize::from(number).checked_sub(1)?)?,
            table::INTERFACE.. => None,
            _ => TABLE.find(menu, number),
        }
    }

    /// Addresses are made of 256 parameters a menu.
    pub(super) fn is_modified(&self) -> bool {
        self.modified
    }

    /// Looks up the parameters that menu 0 shows. It does not show itself.
    fn show(&mut self) {
        for number in 1..=table::SETUPS {
            let setup = TABLE.find(table::SETUP_MENU, number as u8).map_or(0, |place| self.used[place]);
            let (menu, source) = (u8::try_from(setup / 1_000), u8::try_from(setup % 1_000));
            self.shown[number - 1] = match (menu, source) {
                (Ok(menu @ 1..), Ok(source)) if self.menu_zero => self.find(menu, source, false),
                _ => None,
            };
        }
    }
}
