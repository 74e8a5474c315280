//! What is proved of the outputs: the answers to new telegrams alone count.

use super::*;
use crate::native::{NATIVE_WORDS, Native};
use fieldbeat_core::bus::desired::Intent;
use fieldbeat_core::bus::native::native;

struct Rig {
    profile: Profile,
    native: NativePort,
    desired: Desired,
    inputs: Inputs,
}

impl Rig {
    fn new() -> Rig {
        let drive = LenzeDrive::new("x", 3);
        let (_, native): (Native, _) = native();
        let profile = Profile::new(&drive);
        Rig { profile, native, desired: Desired::default(), inputs: Inputs::default() }
    }

    fn power(&mut self, serial: u64, value: Power) {
        self.desired.power = Intent { serial, value };
    }

    fn motion(&mut self, serial: u64, value: Motion) {
        self.desired.motion = Intent { serial, value };
    }

    /// A new telegram leaves, however often it is repeated.
    fn sends(&mut self) {
        let is_native = self.profile.native().is_some();
        self.profile.encode(&self.desired, &mut self.native, is_native);
        self.profile.sent(&mut self.native);
    }

    /// It is answered: the serials of power and motion that are proved then.
    fn answered(&mut self) -> (u64, u64) {
        self.profile.answered();
        self.proves()
    }

    fn proves(&mut self) -> (u64, u64) {
        let mut evidence = Evidence::default();
        self.profile.prove(&self.inputs, &mut evidence);
        (evidence.accepted.power, evidence.accepted.motion)
    }
}

#[test]
fn a_newer_output_is_proved_anew_and_the_other_stays_proved() {
    let mut rig = Rig::new();
    rig.power(1, Power::EnableOperation);
    rig.motion(1, Motion::Follow);
    for _ in 0..2 {
        rig.sends();
        rig.answered();
    }
    rig.motion(2, Motion::Halt);
    // It is desired while a telegram is under way that has the old one.
    rig.profile.encode(&rig.desired, &mut rig.native, false);
    assert!(rig.profile.is_new());
    let mut evidence = Evidence::default();
    evidence.accepted.motion = 1;
    for _ in 0..3 {
        rig.profile.answered();
        rig.profile.prove(&rig.inputs, &mut evidence);
        assert_eq!((evidence.accepted.power, evidence.accepted.motion), (1, 1), "it has not left yet");
    }
    for (proved, steady) in [(1, false), (2, true)] {
        rig.sends();
        rig.profile.answered();
        rig.profile.prove(&rig.inputs, &mut evidence);
        assert_eq!((evidence.accepted.power, evidence.accepted.motion), (1, proved));
        assert_eq!(rig.profile.is_steady(), steady);
    }
    // What was sent before a start-up is proved again.
    rig.profile.dropped();
    for proved in [(0, 0), (1, 2)] {
        rig.sends();
        assert_eq!(rig.answered(), proved);
    }
}

#[test]
fn a_control_word_of_the_application_stays_when_the_drive_drops_out() {
    let (mut application, port): (Native, _) = native();
    let mut rig = Rig { native: port, ..Rig::new() };
    rig.power(1, Power::EnableOperation);
    rig.motion(1, Motion::Native(NativeOwner::Application));
    rig.sends();
    let words = [6; NATIVE_WORDS];
    application.write(NativeOutput { mask: 0b101, words }).unwrap();
    let written =
        |rig: &Rig| rig.profile.native().map(|(output, whole)| (output.mask, output.words[0], whole));
    rig.sends();
    assert_eq!(written(&rig), Some((0b101, 6, true)));
    for _ in 0..2 {
        rig.profile.dropped();
        rig.sends();
        assert_eq!(written(&rig), Some((1, 6, true)));
    }
    // It is the master's again.
    rig.motion(2, Motion::Hold);
    rig.sends();
    assert_eq!(written(&rig), None);
}
