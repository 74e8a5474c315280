//! The codecs of the master and of its simulated drives against each other, over random values, both ways. They were
//! written by different hands from the same documents: where they differ, one of them has misread.

mod ethercat;
mod linudp;
mod modbus;
