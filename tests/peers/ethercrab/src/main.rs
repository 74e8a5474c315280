//! A master made of the crate ethercrab: `ethercrab-peer INTERFACE DRIVES turn|hold|hold-unwatched`. The segment
//! behind INTERFACE is a coupler and DRIVES Kollmorgen S700. It brings all of them to OP and turns the first drive.
//! `turn` stops it then and goes back to INIT; `hold` keeps it turning until this process is killed,
//! `hold-unwatched` too, with the watchdogs of all outputs switched off. A line on standard output says what it
//! saw, and an error on standard error what it did not.

use std::error::Error as StdError;
use std::time::{Duration, Instant};

use ethercrab::std::{ethercat_now, tx_rx_task};
use ethercrab::subdevice_group::{CycleInfo, DcConfiguration, HasDc, HasPdi, TxRxResponse};
use ethercrab::{DcSync, MainDevice, MainDeviceConfig, PduStorage, RetryBehaviour, SubDeviceGroup, Timeouts};

const SLAVES: usize = 8;
const IMAGE: usize = 128;
static STORAGE: PduStorage<16, { PduStorage::element_size(1100) }> = PduStorage::new();

/// Slow: whoever runs this may have a busy computer.
const CYCLE: Duration = Duration::from_millis(10);
/// Nothing takes so many cycles.
const CYCLES: usize = 3_000;
/// So many cycles a speed is held.
const HELD: usize = 50;
/// The time of the watchdog of the outputs, 100 us ...
const WATCHDOG: u16 = 0x0420;
/// ... and what no busy computer is silent for.
const PATIENT: u16 = 10_000;
/// Counts of the velocity setpoint.
const VELOCITY: i32 = 5_000;

type Done<T> = Result<T, Box<dyn StdError>>;

fn main() -> Done<()> {
    let mut arguments = std::env::args().skip(1);
    let interface = arguments.next().ok_or("which interface?")?;
    let drives: usize = arguments.next().ok_or("how many drives?")?.parse()?;
    let what = arguments.next().ok_or("turn, hold or hold-unwatched?")?;
    let (tx, rx, pdus) = STORAGE.try_split().map_err(|()| "the storage is taken")?;
    let timeouts = Timeouts {
        state_transition: Duration::from_secs(20),
        pdu: Duration::from_secs(1),
        eeprom: Duration::from_secs(1),
        mailbox_echo: Duration::from_secs(5),
        mailbox_response: Duration::from_secs(10),
        ..Timeouts::default()
    };
    let config =
        MainDeviceConfig { dc_static_sync_iterations: 500, retry_behaviour: RetryBehaviour::Count(5) };
    smol::spawn(tx_rx_task(&interface, tx, rx)?).detach();
    smol::block_on(run(MainDevice::new(pdus, timeouts, config), drives, &what))
}

async fn run(master: MainDevice<'static>, drives: usize, what: &str) -> Done<()> {
    let mut group = master.init_single_group::<SLAVES, IMAGE>(ethercat_now).await?;
    println!("slaves {}", group.len());
    for (place, mut slave) in group.iter_mut(&master).enumerate() {
        let identity = slave.identity();
        println!("identity {place} {:#x} {:#x}", identity.vendor_id, identity.product_id);
        println!("clock {place} {:?}", slave.dc_support());
        let watchdog = if what == "hold-unwatched" { 0 } else { PATIENT };
        slave.register_write(WATCHDOG, watchdog).await?;
        if place == 0 {
            continue;
        }
        slave.set_dc_sync(DcSync::Sync0);
        println!("vendor {place} {:#x}", slave.sdo_read::<u32>(0x1018, 1).await?);
        match slave.sdo_read::<u32>(0x5FFF, 1).await {
            Ok(value) => return Err(format!("5FFFh:1 is {value}").into()),
            Err(error) => println!("abort {place} {error}"),
        }
        // 10 ms, and the fixed PDOs.
        slave.sdo_write(0x60C2, 1, 10_u8).await?;
        slave.sdo_write(0x60C2, 2, -3_i8).await?;
        for (list, pdo) in [(0x1C12, 0x1702_u16), (0x1C13, 0x1B03)] {
            slave.sdo_write(list, 0, 0_u8).await?;
            slave.sdo_write(list, 1, pdo).await?;
            slave.sdo_write(list, 0, 1_u8).await?;
        }
    }
    let dc = DcConfiguration {
        start_delay: Duration::from_millis(100),
        sync0_period: CYCLE,
        sync0_shift: CYCLE / 2,
    };
    let group = group.into_pre_op_pdi(&master).await?.configure_dc_sync(&master, dc).await?;
    let group = group.into_safe_op(&master).await?;
    println!("state SAFEOP");
    let line = Line { group: &group, master: &master, drives };
    // The warning that there is no cycle yet (n17) goes away once the drives follow ours.
    line.until("synchronous", |line| line.all(|status| status != 0 && status & 0x80 == 0)).await?;
    let group = group.request_into_op(&master).await?;
    let line = Line { group: &group, master: &master, drives };
    let mut cycles = 0;
    while !line.cycle().await?.all_op() {
        cycles += 1;
        if cycles > CYCLES {
            return Err("not all of them reach OP".into());
        }
    }
    println!("state OP");
    line.turn().await?;
    if what != "turn" {
        println!("holding");
        loop {
            line.cycle().await?;
        }
    }
    line.stop().await?;
    group.into_safe_op(&master).await?.into_pre_op(&master).await?.into_init(&master).await?;
    println!("state INIT");
    Ok(())
}

/// A line in SAFEOP or OP; the drives are behind the coupler.
struct Line<'a, S> {
    group: &'a SubDeviceGroup<SLAVES, IMAGE, ethercrab::DefaultLock, S, HasDc>,
    master: &'a MainDevice<'static>,
    drives: usize,
}

impl<S: HasPdi> Line<'_, S> {
    async fn cycle(&self) -> Done<TxRxResponse<SLAVES, CycleInfo>> {
        let begin = Instant::now();
        let response = self.group.tx_rx_dc(self.master).await?;
        smol::Timer::at(begin + response.extra.next_cycle_wait).await;
        Ok(response)
    }

    /// Position and status word of a drive.
    fn inputs(&self, drive: usize) -> Done<(i32, u16)> {
        let slave = self.group.subdevice(self.master, 1 + drive)?;
        let inputs = slave.inputs_raw();
        let [a, b, c, d, _, _, e, f] = inputs[..] else {
            return Err(format!("{} bytes of inputs", inputs.len()).into());
        };
        Ok((i32::from_le_bytes([a, b, c, d]), u16::from_le_bytes([e, f])))
    }

    fn set(&self, drive: usize, velocity: i32, control: u16) -> Done<()> {
        let slave = self.group.subdevice(self.master, 1 + drive)?;
        let mut outputs = slave.outputs_raw_mut();
        let bytes = [&velocity.to_le_bytes()[..], &control.to_le_bytes()].concat();
        if outputs.len() != bytes.len() {
            return Err(format!("{} bytes of outputs", outputs.len()).into());
        }
        outputs.copy_from_slice(&bytes);
        Ok(())
    }

    fn all(&self, is: impl Fn(u16) -> bool) -> bool {
        (0..self.drives).all(|drive| self.inputs(drive).is_ok_and(|(_, status)| is(status)))
    }

    async fn until(&self, what: &str, done: impl Fn(&Self) -> bool) -> Done<()> {
        for _ in 0..CYCLES {
            self.cycle().await?;
            if done(self) {
                return Ok(());
            }
        }
        let seen: Vec<_> = (0..self.drives).map(|drive| self.inputs(drive)).collect();
        Err(format!("not {what}: {seen:x?}").into())
    }

    /// Enables the first drive and turns it. The others stay off.
    async fn turn(&self) -> Done<()> {
        let first = |mask: u16, value: u16| {
            move |line: &Self| line.inputs(0).is_ok_and(|(_, status)| status & mask == value)
        };
        for (control, what, value) in [
            (0x06, "ready to switch on", 0x21),
            (0x07, "switched on", 0x23),
            (0x0F, "operation enabled", 0x27),
        ] {
            self.set(0, 0, control)?;
            self.until(what, first(0x6F, value)).await?;
            println!("status {:#06x}", self.inputs(0)?.1);
        }
        let (begin, other) = (self.inputs(0)?.0, self.inputs(self.drives - 1)?.0);
        self.set(0, VELOCITY, 0x0F)?;
        let mut counts = 0;
        for _ in 0..HELD {
            counts = self.cycle().await?.working_counter;
        }
        println!("counter {counts}");
        println!("moved {} {}", self.inputs(0)?.0 - begin, self.inputs(self.drives - 1)?.0 - other);
        Ok(())
    }

    /// Stops and disables the first drive.
    async fn stop(&self) -> Done<()> {
        self.set(0, 0, 0x0F)?;
        for _ in 0..HELD {
            self.cycle().await?;
        }
        let still = self.inputs(0)?.0;
        for _ in 0..HELD {
            self.cycle().await?;
        }
        println!("still {}", self.inputs(0)?.0 - still);
        self.set(0, 0, 0x06)?;
        let is_ready = |line: &Self| line.inputs(0).is_ok_and(|(_, status)| status & 0x6F == 0x21);
        self.until("ready to switch on", is_ready).await?;
        println!("status {:#06x}", self.inputs(0)?.1);
        Ok(())
    }
}
