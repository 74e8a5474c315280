//! Service access points: which service is at which (sheet, 5), and the head of its requests.

use super::fc::{Function, FunctionCode};
use super::telegram::{BROADCAST, Head};

/// Acyclic access of a class 1 master, both ways.
pub const MSAC1: u8 = 51;
/// Global_Control.
pub const GLOBAL_CONTROL: u8 = 58;
/// Get_Cfg.
pub const GET_CFG: u8 = 59;
/// Slave_Diag.
pub const SLAVE_DIAG: u8 = 60;
/// Set_Prm.
pub const SET_PRM: u8 = 61;
/// Chk_Cfg.
pub const CHK_CFG: u8 = 62;
/// The master's, for all of DP-V0 but Data_Exchange.
pub const MASTER: u8 = 62;

/// A service of a slave that is answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Service {
    /// Whether there is a station, and of what kind.
    FdlStatus,
    /// Outputs to the slave, inputs from it.
    DataExchange,
    /// The diagnosis.
    SlaveDiag,
    /// The parametrisation.
    SetPrm,
    /// The configuration, to compare.
    ChkCfg,
    /// The configuration, to read.
    GetCfg,
    /// Acyclic access.
    Msac1,
}

impl Service {
    /// DSAP and SSAP.
    #[inline]
    pub const fn saps(self) -> Option<(u8, u8)> {
        Some(match self {
            Service::FdlStatus | Service::DataExchange => return None,
            Service::SlaveDiag => (SLAVE_DIAG, MASTER),
            Service::SetPrm => (SET_PRM, MASTER),
            Service::ChkCfg => (CHK_CFG, MASTER),
            Service::GetCfg => (GET_CFG, MASTER),
            Service::Msac1 => (MSAC1, MSAC1),
        })
    }

    /// The head of a request from station `sa` to station `da`. FDL status has no count. Services of DP-V0 have high
    /// priority, acyclic access has low (sheet, 3 and 6).
    #[inline]
    pub const fn head(self, da: u8, sa: u8, fcb: bool, fcv: bool) -> Head {
        let fc = match self {
            Service::FdlStatus => FunctionCode::request(Function::FdlStatus, false, false),
            Service::Msac1 => FunctionCode::request(Function::SrdLow, fcb, fcv),
            _ => FunctionCode::request(Function::SrdHigh, fcb, fcv),
        };
        let (dsap, ssap) = match self.saps() {
            Some((dsap, ssap)) => (Some(dsap), Some(ssap)),
            None => (None, None),
        };
        Head { da, sa, dsap, ssap, fc }
    }
}

/// The head of Global_Control to all slaves. It is not answered.
pub const fn global_control(sa: u8) -> Head {
    let fc = FunctionCode::request(Function::SdnHigh, false, false);
    Head { da: BROADCAST, sa, dsap: Some(GLOBAL_CONTROL), ssap: Some(MASTER), fc }
}
