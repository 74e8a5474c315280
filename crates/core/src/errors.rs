//! What all error types have in common: whoever prints one with `{:?}` reads the sentence, too. So `fn main() ->
//! Result<(), MasterError>`, `unwrap` and `expect` show what is wrong and the remedy, not the fields of a struct.

/// `Debug` of error types prints what their `Display` prints.
#[macro_export]
macro_rules! debug_as_display {
    ($($error:ty),+) => {
        $(impl std::fmt::Debug for $error {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                std::fmt::Display::fmt(self, f)
            }
        })+
    };
}

/// The remedy where drives answer, but too late.
pub const TOO_LATE: &str =
    "raise reply_within, receive_deadline or the period, or look at what holds them or this computer up";

/// The remedy where no descriptor is left, whatever was to be opened.
pub fn no_descriptor(error: &std::io::Error) -> Option<&'static str> {
    match error.raw_os_error()? {
        libc::EMFILE => Some(
            "this process has too many files and sockets open: raise its limit (ulimit -n, or LimitNOFILE= \
             of the service)",
        ),
        libc::ENFILE => Some("this computer has too many files and sockets open: raise fs.file-max (sysctl)"),
        _ => None,
    }
}
