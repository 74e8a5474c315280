//! Ports of made-up hosts: a UART on the board, an FTDI adapter, one on a controller without PCI.

use std::io;

use super::*;
use crate::Verdict::{Bad, Good, Poor, Unknown};
use crate::facts::testing::{Host, KTHREADD, subject};
use fieldbeat_core::net::{Parity, SerialLine};

const ONLINE: (&str, &str) = ("sys/devices/system/cpu/online", "0-3\n");
const MASK: &str = "sys/devices/virtual/workqueue/cpumask";

fn port(path: &str) -> Port {
    let line = SerialLine { rate: 500_000, parity: Parity::Even, rs485: Rs485::Adapter };
    Port { bus: "lenze".into(), path: path.into(), line }
}

fn spinning() -> Subject {
    let mut subject = subject();
    subject.cycle.wait = Wait::Spin;
    subject
}

/// /dev/ttyS1 as Linux 6.18 shows it: two devices of the serial bus below the one with a driver.
fn uart() -> Host {
    Host::new(&[
        ONLINE,
        KTHREADD,
        ("dev/ttyS1", ""),
        ("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/irq", "26\n"),
        ("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/uartclk", "24000000\n"),
        ("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/type", "4\n"),
        ("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/console", "N\n"),
        ("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/rx_trig_bytes", "8\n"),
        ("sys/bus/pnp/drivers/serial/x", ""),
        ("sys/bus/serial-base/drivers/port/x", ""),
        ("sys/bus/serial-base/drivers/ctrl/x", ""),
        ("proc/irq/26/smp_affinity_list", "0-3\n"),
        ("proc/irq/26/effective_affinity_list", "2\n"),
        (MASK, "7\n"),
    ])
    .linked("sys/class/tty/ttyS1", "sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1")
    .linked(
        "sys/devices/pnp0/00:05/00:05:0/00:05:0.0/tty/ttyS1/device",
        "sys/devices/pnp0/00:05/00:05:0/00:05:0.0",
    )
    .linked("sys/devices/pnp0/00:05/00:05:0/00:05:0.0/driver", "sys/bus/serial-base/drivers/port")
    .linked("sys/devices/pnp0/00:05/00:05:0/driver", "sys/bus/serial-base/drivers/ctrl")
    .linked("sys/devices/pnp0/00:05/driver", "sys/bus/pnp/drivers/serial")
}

const USB: &str = "sys/devices/pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.0/ttyUSB0";

/// An FTDI adapter below a controller with message interrupts, by a link of udev.
fn ftdi() -> Host {
    Host::new(&[
        ONLINE,
        ("dev/ttyUSB0", ""),
        ("sys/bus/usb-serial/drivers/ftdi_sio/x", ""),
        (&format!("{USB}/latency_timer"), "16\n"),
        ("sys/devices/pci0000:00/0000:00:14.0/msi_irqs/31", "msi\n"),
        ("sys/devices/pci0000:00/0000:00:14.0/irq", "9\n"),
        ("sys/devices/pci0000:00/irq", "8\n"),
        ("proc/irq/31/smp_affinity_list", "3\n"),
        ("proc/irq/9/smp_affinity_list", "0\n"),
        ("proc/irq/8/smp_affinity_list", "0\n"),
    ])
    .linked("dev/serial/by-id/usb-FTDI", "dev/ttyUSB0")
    .linked(&format!("{USB}/driver"), "sys/bus/usb-serial/drivers/ftdi_sio")
    .linked("sys/class/tty/ttyUSB0/device", USB)
    .linked("sys/bus/usb-serial/devices/ttyUSB0", USB)
}

fn found(host: &Host, port: &Port, subject: &Subject) -> Vec<Finding> {
    let findings = of_port(&host.0, port, subject);
    findings.iter().for_each(crate::tests::assert_whole);
    findings
}

fn one<'a>(findings: &'a [Finding], name: &str) -> &'a Finding {
    let name = format!("lenze: {name}");
    findings.iter().find(|finding| finding.name == name).unwrap_or_else(|| panic!("{name}: {findings:?}"))
}

#[test]
fn a_uart_is_named_with_its_driver_its_interrupt_and_its_workers() {
    let findings = found(&uart(), &port("/dev/ttyS1"), &subject());
    let says = |name| (one(&findings, name).verdict, one(&findings, name).found.as_str());
    assert_eq!(says("serial port"), (Good, "ttyS1, serial"));
    assert_eq!(says("interrupts"), (Good, "irq 26 elsewhere"));
    assert_eq!(says("interrupt threads"), (Good, "none: handled in interrupts, above every priority"));
    assert_eq!(says("workers"), (Good, "on 0-2"));
    assert_eq!(says("receive window"), (Good, "it sleeps"));
    assert_eq!(says("rate"), (Unknown, "not known: the port was not tried"));
    assert_eq!(says("receive trigger"), (Poor, "8 bytes: the end of a telegram waits for 88 us"));
    assert_eq!(
        one(&findings, "receive trigger").fix.as_deref(),
        Some("echo 1 | sudo tee /sys/class/tty/ttyS1/rx_trig_bytes")
    );
    // Where bytes are short, an interrupt for each would cost too much.
    let fast = Port { line: SerialLine { rate: 1_500_000, ..port("").line }, ..port("/dev/ttyS1") };
    assert_eq!(one(&found(&uart(), &fast, &subject()), "receive trigger").verdict, Good);
    assert_eq!(found(&uart(), &port("local:wire"), &subject()).len(), 1);
}

#[test]
fn an_adapter_is_followed_to_its_controller_and_its_latency_timer_is_shortened() {
    let path = "/dev/serial/by-id/usb-FTDI";
    let findings = found(&ftdi(), &port(path), &subject());
    let says = |name| (one(&findings, name).verdict, one(&findings, name).found.as_str());
    assert_eq!(says("serial port"), (Good, "ttyUSB0, ftdi_sio"));
    assert_eq!(says("interrupts"), (Poor, "irq 31 on core 3"));
    assert_eq!(says("latency timer"), (Poor, "16 ms"));
    let timer = one(&findings, "latency timer");
    assert_eq!(
        timer.fix.as_deref(),
        Some("echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer")
    );
    assert!(timer.undo.as_deref().unwrap().starts_with("echo 16 "));
    let host = ftdi().with(&[(&format!("{USB}/latency_timer"), "1\n")]);
    assert_eq!(one(&found(&host, &port(path), &subject()), "latency timer").verdict, Good);
    assert!(!findings.iter().any(|finding| finding.name.contains("trigger")));
}

#[test]
fn a_controller_without_pci_is_found_in_the_list_of_interrupts() {
    let device = "sys/devices/platform/soc/3f980000.usb/usb1/1-1/1-1:1.0/ttyUSB0";
    let host = |list: &str| {
        Host::new(&[
            ("dev/ttyUSB0", ""),
            (&format!("{device}/x"), ""),
            ("proc/interrupts", list),
            ("proc/irq/40/smp_affinity_list", "3\n"),
        ])
        .linked("sys/class/tty/ttyUSB0/device", device)
    };
    let list =
        "           CPU0\n 39:   1  GICv2  41 Level  dwc2:usb2\n 40:  77  GICv2  42 Level  dwc_otg:usb1\n";
    let served_by = |list: &str| served(&host(list).0.root, &port("/dev/ttyUSB0"), "ttyUSB0").interrupts;
    assert_eq!(served_by(list), [40]);
    assert_eq!(served_by("ERR: 0\n"), [0_u32; 0]);
    let findings = found(&host(""), &port("/dev/ttyUSB0"), &subject());
    assert_eq!(one(&findings, "interrupts").verdict, Unknown);
}

#[test]
fn a_port_that_is_absent_denied_in_use_or_the_console_is_said_to_be() {
    let gone = found(&uart(), &port("/dev/ttyS7"), &subject());
    assert_eq!((gone.len(), gone[0].verdict, gone[0].found.as_str()), (1, Bad, "no port /dev/ttyS7"));
    let with = |outcome: Outcome| {
        let mut host = uart();
        host.0.probes.ports.push(("/dev/ttyS1".into(), outcome));
        found(&host, &port("/dev/ttyS1"), &subject())
    };
    let used = with(Err(Untried::InUse("picocom (7)".into())));
    assert_eq!((used[0].verdict, used[0].found.as_str()), (Poor, "ttyS1, serial; in use by picocom (7)"));
    assert_eq!(one(&used, "rate").found, "not known: the port is in use, and is not disturbed");
    let denied = with(Err(Untried::Refused(io::Error::from_raw_os_error(libc::EACCES))));
    assert!(denied[0].verdict == Bad && denied[0].fix.as_deref().unwrap().contains("dialout"));
    assert_eq!(one(&denied, "rate").verdict, Unknown);
    assert!(one(&with(Err(Untried::Hidden)), "rate").found.contains("as root"));
    let console = uart().with(&[("sys/class/tty/ttyS1/console", "Y\n")]);
    let console = found(&console, &port("/dev/ttyS1"), &subject());
    assert!(console[0].verdict == Bad && console[0].fix.as_deref().unwrap().contains("console=ttyS1"));
}

#[test]
fn the_rate_is_what_the_driver_sets_and_the_clock_divides() {
    let tried =
        |rate, refused: Option<&str>| Tried { rate, refused: refused.map(str::to_owned), switches: false };
    let check = |host: &Host, wanted, tried: Tried| {
        let line = SerialLine { rate: wanted, ..port("").line };
        rate(&host.0.root, &Port { line, ..port("/dev/ttyS1") }, "ttyS1", Some(&Ok(tried)))
    };
    let host = uart();
    assert_eq!(check(&host, 1_500_000, tried(1_500_000, None)).found, "1500000 bit/s set and read back");
    let refused = check(&host, 500_000, tried(460_800, Some("its driver has 460800 bit/s")));
    assert_eq!((refused.verdict, refused.found.as_str()), (Bad, "its driver has 460800 bit/s"));
    // 14.7456 MHz / 16 = 921600: its half is 8 % off 500000, and its driver does not say so.
    let clock = "sys/class/tty/ttyS1/uartclk";
    let slow = uart().with(&[(clock, "14745600\n")]);
    let off = check(&slow, 500_000, tried(500_000, None));
    assert_eq!(
        (off.verdict, off.found.as_str()),
        (Poor, "its clock divides to 460800 bit/s, whatever its driver reports")
    );
    assert_eq!(check(&slow, 9_600, tried(9_600, None)).verdict, Good);
    // One that may divide by fractions, and numbers that cannot be.
    let other = uart().with(&[("sys/class/tty/ttyS1/type", "24\n"), (clock, "14745600\n")]);
    assert_eq!(check(&other, 500_000, tried(500_000, None)).verdict, Good);
    assert_eq!(divided(&host.0.root, "ttyS1", 0), None);
    assert_eq!(divided(&host.0.root, "ttyS1", u32::MAX), Some(1_500_000));
    let silent = uart().with(&[(clock, "0\n")]);
    assert_eq!(divided(&silent.0.root, "ttyS1", 500_000), None);
}

#[test]
fn the_direction_is_switched_as_configured() {
    let by = |rs485, tried: Option<&Outcome>| {
        let line = SerialLine { rs485, ..port("").line };
        direction(&Port { line, ..port("/dev/ttyS1") }, tried).verdict
    };
    let outcome = |switches| Ok(Tried { rate: 500_000, refused: None, switches });
    assert_eq!(by(Rs485::Driver, Some(&outcome(true))), Good);
    assert_eq!(by(Rs485::Driver, Some(&outcome(false))), Bad);
    assert_eq!((by(Rs485::Driver, None), by(Rs485::Driver, Some(&Err(Untried::Hidden)))), (Unknown, Unknown));
    assert_eq!(by(Rs485::Adapter, Some(&outcome(false))), Good);
}

#[test]
fn workers_belong_on_other_cores() {
    let check = |files: &[(&str, &str)]| worker(&Host::new(files).0.root, &port("/dev/ttyS1"), &subject());
    let here = check(&[ONLINE, (MASK, "f\n")]);
    assert_eq!((here.verdict, here.found.as_str()), (Poor, "on 0-3, which has core 3"));
    assert_eq!(here.fix.as_deref(), Some("echo 7 | sudo tee /sys/devices/virtual/workqueue/cpumask"));
    assert_eq!(here.undo.as_deref(), Some("echo f | sudo tee /sys/devices/virtual/workqueue/cpumask"));
    assert_eq!(check(&[ONLINE, (MASK, "7\n")]).verdict, Good);
    assert_eq!(check(&[("sys/devices/system/cpu/online", "3\n"), (MASK, "8\n")]).undo, None);
    assert_eq!((check(&[]).verdict, check(&[(MASK, "x\n")]).verdict), (Unknown, Unknown));
}

#[test]
fn a_window_that_spins_where_the_port_is_served_is_refused() {
    let blocked =
        |host: &Host, path: &str, subject: &Subject| blocked_port(&host.0.root, &port(path), subject);
    let irq_here = ("proc/irq/26/effective_affinity_list", "3\n");
    let path = "/dev/ttyS1";
    assert_eq!(blocked(&uart(), path, &spinning()), None);
    let by_irq = blocked(&uart().with(&[irq_here]), path, &spinning()).unwrap();
    assert!(by_irq.starts_with("lenze: /dev/ttyS1 is served on core 3 (irq 26), where"), "{by_irq}");
    let by_both = blocked(&uart().with(&[irq_here, (MASK, "f\n")]), path, &spinning()).unwrap();
    assert!(by_both.contains("(irq 26, workers of the kernel)"), "{by_both}");
    let host = uart().with(&[(MASK, "f\n")]);
    assert!(blocked(&host, path, &spinning()).is_some());
    // The workers need no adapter to be known.
    assert!(blocked(&host, "/dev/ttyUSB9", &spinning()).is_some());
    // It sleeps, has no priority, is on another core, or needs no worker.
    assert_eq!(blocked(&host, path, &subject()), None);
    let mut other = spinning();
    other.cycle.realtime = Realtime::Off;
    assert_eq!(blocked(&host, path, &other), None);
    assert_eq!(blocked(&host, path, &Subject { core: 4, ..spinning() }), None);
    assert_eq!(blocked(&host, "local:wire", &spinning()), None);
    // A host that does not say where is not refused.
    assert_eq!(blocked(&Host::new(&[("dev/ttyS1", "")]), path, &spinning()), None);
    let window = |host: &Host| window(&host.0.root, &port(path), &spinning()).verdict;
    assert_eq!((window(&host), window(&uart())), (Bad, Good));
}

#[test]
fn masks_are_the_kernels() {
    for (cores, mask) in [(&[0, 1, 2][..], "7"), (&[3, 35], "8,8"), (&[32, 64], "1,1,0"), (&[], "0")] {
        assert_eq!(mask_of(cores), mask);
        assert_eq!(cores_of_mask(mask).unwrap(), cores);
    }
    assert_eq!(cores_of_mask("00ff,00000001"), Some(vec![0, 32, 33, 34, 35, 36, 37, 38, 39]));
    assert_eq!((cores_of_mask("g"), cores_of_mask("")), (None, None));
}
