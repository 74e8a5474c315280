//! What others make of our bytes on the wire, and we of theirs: Wireshark's dissectors, and where a protocol has them,
//! other implementations of it, each a program of its own. `.ci/run` installs them.
//!
//!     cargo test --test peers -- --ignored --test-threads 1
//!
//! | file | what |
//! |---|---|
//! | `capture` | a capture by tshark, and what its dissectors make of it |
//! | `dashboard` | the dashboard of Grafana, and Prometheus, which answers its queries |
//! | `ethercat` | frames of EtherCAT, and masters of the crate ethercrab and of SOEM |
//! | `ethernet_ip` | EtherNet/IP: frames, and an adapter, scanners and clients of others |
//! | `linudp` | frames of LinUDP |
//! | `modbus` | Modbus TCP: frames, and servers and clients of libmodbus and pymodbus |
//! | `peer` | a peer that takes commands by lines, and one that is a package of its own |
//! | `profibus` | PROFIBUS DP: masters of the crate profirust and of pyprofibus |
//! | `recordings` | recordings: Foxglove's own library, and the Python library of MCAP |
//! | `readers` | distributions and metrics, not on a wire: HdrHistogram's JavaScript port, Prometheus' Python client |
//! | `schema` | configurations: jsonschema, taplo and tombi on the schema |
//!
//! Each test owns 127.x.n.0/24, by the number n of its machine, which is unique in all of these files.

mod capture;
mod dashboard;
mod ethercat;
mod ethernet_ip;
mod linudp;
mod modbus;
mod peer;
mod profibus;
mod readers;
mod recordings;
mod schema;
#[path = "../support/mod.rs"]
mod support;
