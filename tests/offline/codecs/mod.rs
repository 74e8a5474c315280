//! The codec of the master and that of the simulated drives, each written from the manuals by itself: a field that one
//! of them misreads shows here as a difference.

mod linudp;
mod modbus;
