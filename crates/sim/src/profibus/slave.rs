//! The states of a DP slave: parametrisation, configuration, data exchange, watchdog; its diagnosis.
//!
//! Knows no time of the wire and no frame count. Facts: sheet, 5, 6; EN 50170. What they leave open is assumed:
//!
//! | case | what the slave does |
//! |---|---|
//! | Set_Prm of another master while locked, Chk_Cfg of another one or before Set_Prm | RS |
//! | Data_Exchange outside its state, or of another master | RS |
//! | outputs of a wrong length | RS, Cfg_Fault, waits for parameters |
//! | outputs of no length | are safe outputs, if fail-safe is parametrised |
//! | Clear | outputs are safe until Operate |
//! | Global_Control outside Data_Exchange | nothing |
//! | min Tsdr below 11 bits or beyond MaxTsdr, reserved bits | Prm_Fault |
//! | the watchdog | is fed by Data_Exchange, one answered from memory included, Set_Prm and Chk_Cfg; nothing else |

use super::Misuse;
use super::acyclic::Acyclic;
use super::channel::ParameterChannel;
use super::drive::Drive;
use super::link::{Answer, Services, response};
use super::prm::{self, Parameters};
use super::settings::{Channel, LenzeSettings};
use super::telegram::Frame;
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::Time;

/// Service access points.
mod sap {
    /// Of the master, for all but MSAC1.
    pub const MASTER: u8 = 62;
    pub const MSAC1: u8 = 51;
    pub const READ_INPUTS: u8 = 56;
    pub const READ_OUTPUTS: u8 = 57;
    pub const GLOBAL_CONTROL: u8 = 58;
    pub const GET_CFG: u8 = 59;
    pub const SLAVE_DIAG: u8 = 60;
    pub const SET_PRM: u8 = 61;
    pub const CHK_CFG: u8 = 62;
}

/// Bits of Global_Control.
mod control {
    pub const CLEAR: u8 = 0x02;
    /// Freeze, unfreeze, sync, unsync.
    pub const MODES: u8 = 0x3C;
}

/// The parameter channel, bytes.
const CHANNEL: usize = 8;

/// The states of a slave that is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DpState {
    /// It waits for Set_Prm.
    WaitPrm,
    /// It waits for Chk_Cfg.
    WaitCfg,
    /// It has its configuration, and is not ready.
    Starting,
    /// Its outputs and inputs are exchanged.
    DataExchange,
}

/// How often a slave did what.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Events {
    /// Data_Exchange with new outputs.
    pub exchanges: u64,
    /// Set_Prm that it took.
    pub parametrised: u64,
    /// Set_Prm and Chk_Cfg that it refused with its diagnosis.
    pub refused: u64,
    /// Its watchdog expired.
    pub watchdogs: u64,
    /// Diagnoses that it sent.
    pub diagnoses: u64,
    /// Global_Control that it followed.
    pub controls: u64,
    /// Requests answered "service not active".
    pub not_active: u64,
}

/// One slave with its drive.
#[derive(Debug)]
pub(super) struct Slave {
    settings: LenzeSettings,
    line: SerialLine,
    state: DpState,
    ready_at: Time,
    /// The master that has parametrised it.
    master: Option<u8>,
    parameters: Parameters,
    /// It was last addressed by its master.
    fed: Time,
    operate: bool,
    /// It left its master by itself, which that one does not know: power was lost, or its watchdog expired.
    orphaned: bool,
    prm_fault: bool,
    cfg_fault: bool,
    not_supported: bool,
    /// It has no valid data for a while (Stat_Diag).
    pub static_diagnosis: bool,
    /// The fault and Stat_Diag as its master has read them.
    reported: (Option<u16>, bool),
    /// So many requests are refused with this function code.
    pub refuse: (u32, u8),
    sizes: (usize, usize),
    outputs: Vec<u8>,
    channel: ParameterChannel,
    acyclic: Acyclic,
    pub drive: Drive,
    pub events: Events,
}

impl Slave {
    pub(super) fn new(settings: &LenzeSettings, line: SerialLine) -> Slave {
        let mut slave = Slave {
            line,
            state: DpState::WaitPrm,
            ready_at: Time(0),
            master: None,
            parameters: Parameters::default(),
            fed: Time(0),
            operate: false,
            orphaned: false,
            prm_fault: false,
            cfg_fault: false,
            not_supported: false,
            static_diagnosis: false,
            reported: (None, false),
            refuse: (0, 0),
            sizes: prm::sizes(&settings.configuration).unwrap_or_default(),
            outputs: Vec::new(),
            channel: ParameterChannel::new(settings.channel, settings.job_ns),
            acyclic: Acyclic::new(settings.acyclic),
            drive: Drive::new(settings),
            events: Events::default(),
            settings: settings.clone(),
        };
        slave.outputs.resize(slave.sizes.0, 0);
        if settings.running.is_some() {
            // As its master has left it, without a watchdog.
            (slave.state, slave.master, slave.operate) =
                (DpState::DataExchange, Some(settings.last_master), true);
        }
        slave
    }

    /// Power came back.
    pub(super) fn restart(&mut self) {
        self.leave();
        self.orphaned = true;
        self.parameters = Parameters::default();
        (self.prm_fault, self.cfg_fault, self.not_supported) = (false, false, false);
        (self.reported, self.static_diagnosis) = ((None, false), false);
        self.drive.restart();
    }

    pub(super) fn state(&self) -> DpState {
        self.state
    }

    pub(super) fn master(&self) -> Option<u8> {
        self.master
    }

    /// Time passes, and the watchdog with it.
    pub(super) fn advance(&mut self, now: Time) {
        let expiry = self.parameters.watchdog_ns.map(|ns| self.fed + ns);
        if let Some(expiry) = expiry.filter(|expiry| self.master.is_some() && *expiry <= now) {
            self.ready(expiry);
            self.drive.advance(expiry);
            self.events.watchdogs += 1;
            self.leave();
            self.orphaned = true;
        }
        self.ready(now);
        self.drive.advance(now);
    }

    fn ready(&mut self, now: Time) {
        if self.state == DpState::Starting && now >= self.ready_at {
            self.state = DpState::DataExchange;
            self.operate = !self.settings.dp.needs_operate;
        }
    }

    /// The master is gone, or not wanted: outputs are safe.
    fn leave(&mut self) {
        (self.state, self.master) = (DpState::WaitPrm, None);
        self.clear();
        self.channel.reset();
        self.acyclic.reset();
    }

    fn clear(&mut self) {
        self.operate = false;
        self.outputs.clear();
        self.outputs.resize(self.sizes.0, 0);
        self.drive.set_safe();
    }

    /// Its fault, and whether it has no valid data.
    fn condition(&self) -> (Option<u16>, bool) {
        (self.drive.fault(), self.static_diagnosis)
    }

    fn is_due(&self) -> bool {
        self.condition() != self.reported
    }

    fn exchange(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse, out: &mut Vec<u8>) -> Answer {
        if self.state != DpState::DataExchange || self.master != Some(frame.from) {
            return self.not_active();
        }
        let is_safe = frame.data.is_empty() && self.sizes.0 > 0;
        if frame.data.len() != self.sizes.0 && !(is_safe && self.parameters.fail_safe) {
            misuse.output_length += 1;
            self.cfg_fault = true;
            self.leave();
            return self.not_active();
        }
        self.fed = now;
        self.events.exchanges += 1;
        if is_safe {
            self.drive.set_safe();
        } else if self.operate {
            self.outputs.clear();
            self.outputs.extend_from_slice(frame.data);
            let words = self.outputs.get(self.process_at()..).unwrap_or_default();
            misuse.control_word += u64::from(!self.drive.set_outputs(words));
        }
        if self.settings.channel != Channel::None {
            let mut job = [0; CHANNEL];
            if let Some(sent) = frame.data.first_chunk() {
                job = *sent;
            }
            self.channel.exchange(now, job, &mut self.drive, misuse);
        }
        self.inputs(out);
        match (self.is_due(), out.is_empty()) {
            (true, _) => Answer::Data(response::DATA_HIGH),
            (false, true) => Answer::Ack,
            (false, false) => Answer::Data(response::DATA),
        }
    }

    fn process_at(&self) -> usize {
        if self.settings.channel == Channel::None { 0 } else { CHANNEL }
    }

    fn inputs(&self, out: &mut Vec<u8>) {
        if self.settings.channel != Channel::None {
            out.extend(self.channel.answer());
        }
        self.drive.append_inputs(out);
        out.resize(self.sizes.1, 0);
    }

    fn diagnosis(&mut self, frame: &Frame<'_>, out: &mut Vec<u8>) -> Answer {
        let fault = self.drive.fault();
        let locked = self.settings.dp.shows_lock && self.master.is_some_and(|master| master != frame.from);
        let first = [
            (self.state != DpState::DataExchange, 1),
            (self.cfg_fault, 2),
            (fault.is_some(), 3),
            (self.not_supported, 4),
            (self.prm_fault, 6),
            (locked, 7),
        ];
        let watched = self.master.is_some() && self.parameters.watchdog_ns.is_some();
        let second =
            [(self.state == DpState::WaitPrm, 0), (self.static_diagnosis, 1), (true, 2), (watched, 3)];
        let bits = |bits: &[(bool, u8)]| bits.iter().fold(0, |byte, (set, bit)| byte | u8::from(*set) << bit);
        out.extend([bits(&first), bits(&second), 0, self.master.unwrap_or(255)]);
        out.extend(self.settings.ident.to_be_bytes());
        if let Some(code) = fault {
            // Device-related, of 3 bytes with this one.
            out.push(3);
            out.extend(code.to_be_bytes());
        }
        if self.master.is_none_or(|master| master == frame.from) {
            self.reported = self.condition();
        }
        self.events.diagnoses += 1;
        Answer::Data(response::DATA)
    }

    fn set_prm(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse) -> Answer {
        if self.master.is_some_and(|master| master != frame.from) {
            misuse.state += 1;
            return self.not_active();
        }
        let max_tsdr = self.settings.link.max_tsdr(self.line.rate);
        match Parameters::read(frame.data, &self.settings, max_tsdr, self.parameters) {
            Ok(prm::Request::Unlock) => self.leave(),
            Ok(prm::Request::Keep(parameters)) => self.parameters = parameters,
            Ok(prm::Request::Lock(parameters)) => {
                (self.parameters, self.master, self.fed) = (parameters, Some(frame.from), now);
                self.orphaned = false;
                (self.prm_fault, self.cfg_fault, self.not_supported) = (false, false, false);
                self.events.parametrised += 1;
                if self.state == DpState::WaitPrm {
                    self.state = DpState::WaitCfg;
                }
            }
            Err(refusal) => {
                misuse.length += u64::from(refusal == prm::Refusal::Length);
                misuse.parameters += u64::from(refusal == prm::Refusal::Malformed);
                self.not_supported = refusal == prm::Refusal::NotSupported;
                self.prm_fault = true;
                self.events.refused += 1;
                self.leave();
            }
        }
        Answer::Ack
    }

    fn chk_cfg(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse) -> Answer {
        if self.state == DpState::WaitPrm || self.master != Some(frame.from) {
            misuse.state += u64::from(!self.orphaned);
            return self.not_active();
        }
        self.fed = now;
        self.cfg_fault = frame.data != self.settings.configuration;
        if self.cfg_fault {
            self.events.refused += 1;
            self.leave();
        } else if self.state == DpState::WaitCfg {
            (self.state, self.ready_at) = (DpState::Starting, now + self.settings.dp.ready_ns);
        }
        Answer::Ack
    }

    fn acyclic(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse, out: &mut Vec<u8>) -> Answer {
        if self.state != DpState::DataExchange || self.master != Some(frame.from) || !self.parameters.dpv1 {
            misuse.state += u64::from(!self.orphaned);
            return self.not_active();
        }
        self.acyclic.request(now, frame.data, &mut self.drive, misuse, out)
    }

    fn not_active(&mut self) -> Answer {
        self.events.not_active += 1;
        Answer::Status(response::NO_SERVICE)
    }

    /// Services that have no data in their request.
    fn empty(&mut self, frame: &Frame<'_>, misuse: &mut Misuse, out: &mut Vec<u8>, service: u8) -> Answer {
        if !frame.data.is_empty() {
            misuse.length += 1;
            return Answer::Status(response::USER_ERROR);
        }
        match service {
            sap::SLAVE_DIAG => return self.diagnosis(frame, out),
            sap::GET_CFG => out.extend_from_slice(&self.settings.configuration),
            _ if self.state != DpState::DataExchange => return self.not_active(),
            sap::READ_INPUTS => self.inputs(out),
            _ => out.extend_from_slice(&self.outputs),
        }
        Answer::Data(response::DATA)
    }
}

impl Services for Slave {
    fn request(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse, out: &mut Vec<u8>) -> Answer {
        self.advance(now);
        if let (count @ 1.., function) = self.refuse {
            self.refuse.0 = count - 1;
            return Answer::Status(function);
        }
        match frame.saps {
            (None, None) => self.exchange(now, frame, misuse, out),
            (Some(sap::MSAC1), Some(sap::MSAC1)) => self.acyclic(now, frame, misuse, out),
            (Some(sap::SET_PRM), Some(sap::MASTER)) => self.set_prm(now, frame, misuse),
            (Some(sap::CHK_CFG), Some(sap::MASTER)) => self.chk_cfg(now, frame, misuse),
            (
                Some(service @ (sap::READ_INPUTS | sap::READ_OUTPUTS | sap::GET_CFG | sap::SLAVE_DIAG)),
                Some(sap::MASTER),
            ) => self.empty(frame, misuse, out, service),
            _ => {
                misuse.access_point += 1;
                self.not_active()
            }
        }
    }

    fn repeated(&mut self, now: Time, frame: &Frame<'_>) {
        self.advance(now);
        if self.master == Some(frame.from) && frame.saps == (None, None) {
            self.fed = now;
        }
    }

    /// Global_Control.
    fn unanswered(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse) {
        self.advance(now);
        if frame.saps != (Some(sap::GLOBAL_CONTROL), Some(sap::MASTER)) {
            return misuse.access_point += 1;
        }
        let [command, groups] = *frame.data else { return misuse.length += 1 };
        let unknown = !control::CLEAR & if self.settings.dp.sync_freeze { !control::MODES } else { 0xFF };
        let is_meant = groups == 0 || groups & self.parameters.group != 0;
        if self.state != DpState::DataExchange || self.master != Some(frame.from) || !is_meant {
            return;
        }
        misuse.control += u64::from(command & unknown != 0);
        self.events.controls += 1;
        match command & control::CLEAR {
            0 => self.operate = true,
            _ => self.clear(),
        }
    }

    fn answer_bits(&self) -> u16 {
        let max_tsdr = self.settings.link.max_tsdr(self.line.rate);
        self.settings.link.answer_bits.unwrap_or(0).max(self.parameters.min_tsdr).min(max_tsdr)
    }
}
