//! EtherNet/IP: clients of others, and our simulated drive.
//!
//! | file | what |
//! |---|---|
//! | `clients` | explicit messages of pycomm3 and cpppo |
//! | `programs` | their clients |

mod clients;
