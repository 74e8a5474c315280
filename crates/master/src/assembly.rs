//! The loop of a plan with its buses, and the application's handles.

use std::any::Any;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use super::MasterError;
use fieldbeat_core::axis::acyclic::Acyclic;
use fieldbeat_core::axis::cell;
use fieldbeat_core::axis::doorbell::Bells;
use fieldbeat_core::axis::handle::{URGENT_ROOM, most_unended, room_for_ends};
use fieldbeat_core::axis::newest;
use fieldbeat_core::axis::{Axis, AxisEnds, Feedback, Observer, Pulse};
use fieldbeat_core::bus::diagnosis::Seen;
use fieldbeat_core::bus::{BusFacts, BusNumbers, DeviceEnds, LastResort, OpenError, Opened, ReplyWithin};
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::cycle::bound::{self, Paced};
use fieldbeat_core::cycle::engine::{AxisEntry, AxisOutlet, Channels, Control, Engine};
use fieldbeat_core::cycle::ring::{self, Kept, RecordReader};
use fieldbeat_core::cycle::status::{AxisGauge, AxisInfo, BusGauge, BusInfo, DriveNumbers, Gauges, Status};
use fieldbeat_core::cycle::task::Task;
use fieldbeat_core::cycle::window::{Gate, OpenBus};
use fieldbeat_core::drive::controller::{DriveController, Probes, Queues};
use fieldbeat_core::drive::journal::Journal;
use fieldbeat_core::inputs::Inlet;
use fieldbeat_core::net::Carriers;
use fieldbeat_core::rt::{self, Clock, Regions, Wires};
use fieldbeat_telemetry::TelemetryThread;

/// An engine, its axes, and everything that belongs to them.
#[derive(Debug)]
pub struct Assembly<C> {
    /// The loop: [`begin`](Engine::begin), then [`step`](Engine::step).
    pub engine: Engine<C>,
    /// The application's ends, in the order of the plan.
    pub axes: Vec<Axis>,
    /// The application's ends of the devices that are not drives.
    pub devices: Devices,
    /// Acyclic access to the drives, followed by the devices that have it, for users other than the application.
    pub acyclics: Vec<Acyclic>,
    /// The counts of the loop.
    pub gauges: Gauges,
    /// The loop's records for the telemetry. Whoever steps the engine empties them, or records are lost.
    pub records: RecordReader,
    /// Why the records end with this process, although they are to outlive it.
    pub unnamed: Option<io::Error>,
    /// The application's sign of life.
    pub pulse: Pulse,
    /// Who may use the wires.
    pub wires: Wires,
    /// The stops of the drives of buses without the loop.
    pub last_resorts: Vec<LastResort>,
    /// Memory that the loop touches, for [`rt::thread::enter`].
    pub regions: Regions,
}

/// The application's ends of the devices that take part in the cycle and are not drives.
#[derive(Debug, Default)]
pub struct Devices(Vec<(String, Option<Box<dyn Any + Send>>)>);

impl Devices {
    /// Takes the process data of a device; only once, because it has one owner. `T` is the type that its protocol
    /// names.
    pub fn take<T: 'static>(&mut self, name: &str) -> Result<T, MasterError> {
        let Some((_, end)) = self.0.iter_mut().find(|(known, _)| known == name) else {
            return Err(MasterError::unknown("device", name, self.0.iter().map(|(name, _)| name)));
        };
        match end.take().map(|end| end.downcast::<T>()) {
            Some(Ok(device)) => Ok(*device),
            Some(Err(of_another_type)) => {
                *end = Some(of_another_type);
                Err(MasterError::DeviceType(name.to_owned()))
            }
            None => Err(MasterError::DeviceTaken(name.to_owned())),
        }
    }
}

/// Opens the buses of `plan` over `carriers` and builds the loop for a caller that steps it by hand on its own
/// thread, clock and carriers: virtual time and the benches. `wires` are new ones. `kept` says which of the loop's
/// records stay at hand. Sends nothing.
pub fn assemble<C: Clock>(
    plan: &Plan,
    clock: C,
    carriers: &dyn Carriers,
    task: Option<Task>,
    control: Control,
    wires: Wires,
    kept: Kept,
) -> Result<Assembly<C>, OpenError> {
    let (period_ns, grid) = (plan.cycle.period_ns, plan.cycle.grid());
    let pulse = Pulse::default();
    let mut last_resorts = Vec::new();
    let mut regions = Regions::default();
    let (mut entries, mut buses) = (Vec::new(), Vec::new());
    let (mut axes, mut acyclics) = (Vec::new(), Vec::new());
    let (mut devices, mut of_devices) = (Devices::default(), Vec::new());
    let (status_in, status) = cell::cell(Status::default());
    let mut gauges = Gauges { status, axes: Vec::new(), buses: Vec::new() };
    let machine = plan.axes();
    let names: Arc<[String]> = machine.iter().map(|axis| axis.name.clone()).collect();
    let log = carriers.log();
    let bells = Bells::new(machine.len()).logged(&log);
    let gate = Gate::new(wires.clone(), log.clone());
    for (place, bus_plan) in plan.buses.iter().enumerate() {
        log.opens(place);
        let Opened { bus, ends, notes, last_resort } = bus_plan.open(period_ns, carriers)?;
        let (first, facts) = (entries.len(), bus_plan.facts(grid));
        last_resorts.extend(last_resort);
        let drives = bus_plan.axes().into_iter().zip(&facts.drives).zip(ends.drives);
        for (index, ((axis, drive), ends)) in drives.enumerate() {
            // The queues of the first member hold the parts of all. A group of the plan has the full room for each
            // of them; any other one at least has room for one call, and for its stops.
            let group = axis.stop.group;
            let most =
                machine.iter().filter(|other| group.is_some() && other.stop.group == group).count().max(1);
            let led = plan.groups.iter().filter(|group| group.axes.first() == Some(&axis.name));
            let members = led.map(|group| group.axes.len()).max().unwrap_or(1);
            let room = |queue: usize| queue.saturating_mul(members).max(most);
            let (posted_in, posted) = rt::ring(room(axis.command_queue) + URGENT_ROOM * most, &mut regions);
            let (setpoint_in, setpoint_out) = newest::newest(most);
            let (row_in, row_out) = rt::ring(room(axis.stream_queue), &mut regions);
            let (event_in, event_out) = rt::ring(axis.event_queue + room_for_ends(axis), &mut regions);
            let (writer, reader) = cell::cell(Feedback::default());
            let (sample_in, sample_out) = match axis.sample_queue {
                0 => (None, None),
                depth => {
                    let (producer, consumer) = rt::ring(depth, &mut regions);
                    (Some(producer), Some(consumer))
                }
            };
            let queues = Queues {
                posted: Inlet::new(posted).logged(&log),
                commands: rt::deque(most_unended(axis), &mut regions),
                rows: Inlet::new(row_out).logged(&log),
                setpoints: setpoint_out,
                events: event_in,
                room_for_ends: room_for_ends(axis),
                samples: sample_in,
                log: log.source(),
                journal: Journal::new(room_for_ends(axis), &mut regions),
            };
            // First probes are spread over a few cycles: all of them in one cycle would be a burst that never
            // occurs later.
            let first_probe = (entries.len() / PROBES_A_CYCLE) as u64;
            let silence = bound::silence(&Paced::of(grid, drive, axis), plan.cycle.overrun);
            let controller = DriveController::new(
                axis.clone(),
                drive.capabilities,
                (writer, queues),
                period_ns,
                first_probe,
                silence,
                match drive.reply_within {
                    ReplyWithin::OwnClock(_) => Probes::AtOwnRate,
                    _ if facts.is_one_frame => Probes::Carried,
                    _ => Probes::Spaced,
                },
            );
            let every = Duration::from_nanos(period_ns.saturating_mul(axis.divisor.into()));
            let observer = Observer::new(reader, wires.clone());
            let notation = Arc::clone(&facts.notation);
            let acyclic = Acyclic::new(&axis.name, ends.acyclic, notation, observer.clone(), every);
            let (numbers_in, numbers) = cell::cell(DriveNumbers::default());
            let connection = notes.clone().map(|notes| (notes, index));
            let info = AxisInfo {
                name: axis.name.clone(),
                protocol: facts.protocol,
                connection,
                diagnosis: facts.diagnosis,
                seen: Seen::default(),
                bus: buses.len(),
            };
            gauges.axes.push(AxisGauge { info: info.clone(), observer: observer.clone(), numbers });
            entries.push(AxisEntry { controller, outlet: AxisOutlet { info, numbers: numbers_in } });
            axes.push(Axis::new(
                axis.clone(),
                (axes.len(), names.clone()),
                pulse.clone(),
                acyclic.clone(),
                AxisEnds {
                    commands: posted_in,
                    bell: bells.bell(axes.len()),
                    rows: row_in,
                    setpoints: setpoint_in,
                    events: event_out,
                    feedback: observer.clone(),
                    samples: sample_out,
                    native: Some(ends.native),
                    faults: facts.fault_names,
                    lacks: drive.capabilities.lacks,
                },
            ));
            acyclics.push(acyclic);
        }
        for (name, DeviceEnds { native, acyclic, observer }) in facts.devices.iter().zip(ends.devices) {
            devices.0.push((name.clone(), Some(native)));
            let (notation, period) = (Arc::clone(&facts.notation), Duration::from_nanos(period_ns));
            of_devices.push(Acyclic::new(name, acyclic, notation, observer.on(&wires), period));
        }
        let is_polled =
            facts.drives.iter().any(|drive| matches!(drive.reply_within, ReplyWithin::Turn { .. }));
        let (numbers_in, numbers) = cell::cell(BusNumbers::default());
        let BusFacts { devices, own_counters, is_one_frame, .. } = facts;
        let info = BusInfo { name: bus_plan.name().to_owned(), devices, own_counters, notes };
        gauges.buses.push(BusGauge { info: info.clone(), numbers });
        buses.push(OpenBus {
            is_one_frame,
            bus,
            info,
            first,
            end: entries.len(),
            is_at_work: false,
            is_polled,
            gate: gate.clone(),
            numbers: numbers_in,
        });
    }
    acyclics.extend(of_devices);
    let native_records = plan.native_records_a_cycle();
    let records_a_cycle = plan.records_a_cycle() + native_records;
    let room = TelemetryThread::ring_size(records_a_cycle, period_ns);
    let (record_in, records, unnamed) = ring::records(room, kept, &mut regions);
    let channels =
        Channels { control, pulse: pulse.clone(), bells, records: record_in, status: status_in, log, gate };
    let mut engine = Engine::new(clock, plan.cycle.clone(), entries, buses, task, channels);
    engine.record_native(plan.native_layouts().into_iter().flatten().map(|(axis, _)| axis), native_records);
    engine.memory(&mut regions);
    Ok(Assembly {
        engine,
        axes,
        devices,
        acyclics,
        gauges,
        records,
        unnamed,
        pulse,
        wires,
        last_resorts,
        regions,
    })
}

/// How many drives are probed for the first time in one cycle.
const PROBES_A_CYCLE: usize = 16;
