//! Telegrams of PROFIBUS in words.

use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way, Words};

use crate::wire::dp::Diagnosis;
use crate::wire::fc::{Function, refusal};
use crate::wire::msac1::Answer;
use crate::wire::sap;
use crate::wire::telegram::{Frame, Next, Telegram};

/// Those of this protocol.
pub const TELEGRAMS: &[Telegrams] = &[Telegrams { carrier: Carrier::Serial, front, words }];

fn front(bytes: &[u8]) -> Front {
    match Next::parse(bytes) {
        Next::Incomplete { .. } => Front::Incomplete,
        Next::Telegram { size, .. } => Front::Telegram(size),
        Next::Malformed { drop, .. } => Front::Foreign(drop),
    }
}

fn words(bytes: &[u8], _: Way) -> Option<Words> {
    let Next::Telegram { telegram, .. } = Next::parse(bytes) else { return None };
    Some(match telegram {
        Telegram::Acknowledge => Words::new("acknowledge"),
        Telegram::Token { da, sa } => Words { stations: Some([sa, da]), ..Words::new("token") },
        Telegram::Data(frame) => {
            let head = frame.head;
            let words = if head.fc.0 & REQUEST != 0 { requested(&frame) } else { answered(&frame) };
            Words { stations: Some([head.sa, head.da]), ..words }
        }
    })
}

/// Bits of a function code, and what is below them.
const REQUEST: u8 = 1 << 6;
const FUNCTION: u8 = 0x0F;

/// The service at an access point of a slave; without one it is Data_Exchange.
fn service(slave: Option<u8>) -> String {
    match slave {
        None => "Data_Exchange".to_owned(),
        Some(sap::MSAC1) => "MSAC1".to_owned(),
        Some(sap::GLOBAL_CONTROL) => "Global_Control".to_owned(),
        Some(sap::GET_CFG) => "Get_Cfg".to_owned(),
        Some(sap::SLAVE_DIAG) => "Slave_Diag".to_owned(),
        Some(sap::SET_PRM) => "Set_Prm".to_owned(),
        Some(sap::CHK_CFG) => "Chk_Cfg".to_owned(),
        Some(other) => format!("service access point {other}"),
    }
}

fn requested(frame: &Frame<'_>) -> Words {
    let function = frame.head.fc.0 & FUNCTION;
    if function == Function::FdlStatus as u8 {
        return Words::new("FDL status requested");
    }
    let mut words = Words::new(format_args!("{} requested", service(frame.head.dsap)));
    if ![Function::SdnHigh, Function::SrdLow, Function::SrdHigh].map(|known| known as u8).contains(&function)
    {
        words.field(format_args!("function {function:#x}"));
    }
    words.bytes(frame.data);
    words
}

fn answered(frame: &Frame<'_>) -> Words {
    /// Answers with data, of low and of high priority, and one without.
    const DATA: [u8; 2] = [0x8, 0xA];
    const DONE: u8 = 0x0;
    let function = frame.head.fc.0 & FUNCTION;
    if function == DONE && frame.data.is_empty() {
        return Words::new("done");
    }
    let mut words = Words::new(format_args!("{} answered", service(frame.head.ssap)));
    if function != DONE && !DATA.contains(&function) {
        words.field(refusal(function));
    }
    match frame.head.ssap {
        Some(sap::SLAVE_DIAG) => {
            if let Some(diagnosis) = Diagnosis::parse(frame.data) {
                words.field(format_args!("ident {:04x}h", diagnosis.ident));
                diagnosis.status.names().for_each(|name| words.field(name));
            }
        }
        Some(sap::MSAC1) => {
            if let Some(Answer { result: Err(refused), .. }) = Answer::parse(frame.data) {
                words.field(refused.name().unwrap_or("refused"));
            }
        }
        _ => {}
    }
    words.bytes(frame.data);
    words
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::fc::FunctionCode;
    use crate::wire::sap::Service;
    use crate::wire::telegram::{Head, MAX, token};

    #[test]
    fn telegrams_name_their_service() {
        let mut out = [0; MAX];
        let of = |head: Head, data: &[u8], out: &mut [u8; MAX]| {
            let size = head.emit(data, out).unwrap();
            assert_eq!(
                (front(&out[..size]), front(&out[..size - 1])),
                (Front::Telegram(size), Front::Incomplete)
            );
            words(&out[..size], Way::Unknown).unwrap()
        };
        let exchange = of(Service::DataExchange.head(3, 1, true, true), &[4, 0x7F], &mut out);
        assert_eq!((exchange.stations, &*exchange.text), (Some([1, 3]), "Data_Exchange requested: 04 7f"));
        let answer = Head { da: 1, sa: 3, dsap: Some(62), ssap: Some(60), fc: FunctionCode(8) };
        assert_eq!(
            of(answer, &[2, 5, 0, 255, 0x21, 0x33], &mut out).text,
            "Slave_Diag answered, ident 2133h, not ready, parametrisation requested, slave: 02 05 00 ff 21 33"
        );
        let refused = Head { da: 1, sa: 3, dsap: None, ssap: None, fc: FunctionCode(3) };
        assert_eq!(of(refused, &[], &mut out).text, "Data_Exchange answered, RS: service not active");
        assert_eq!(words(&token(2, 1), Way::Unknown).unwrap().stations, Some([1, 2]));
        assert_eq!(words(&[0xE5], Way::Unknown).unwrap().text, "acknowledge");
        assert_eq!((front(&[0, 0, 0xE5]), words(&[0], Way::Unknown)), (Front::Foreign(2), None));
    }
}
