//! The keys of `simulate` of a drive with `protocol = "ethernet-ip"`.
