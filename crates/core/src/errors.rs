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

/// A user in words: by his name, or by his number where he has none here.
pub fn user(uid: u32) -> String {
    let name = nix::unistd::User::from_uid(uid.into()).ok().flatten().map(|user| user.name);
    format!("user {}", name.unwrap_or_else(|| uid.to_string()))
}
