//! The program: all of it is in `fieldbeat-cli`.

fn main() -> std::process::ExitCode {
    fieldbeat_cli::main()
}
