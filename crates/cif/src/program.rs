//! The program that this process runs, for processes of its own that run cif again.

use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

/// Program that the command is part of.
#[derive(Debug)]
enum Program {
    /// The command itself.
    Own(PathBuf),
    /// A Python, with the folder that holds the package.
    Python(PathBuf, PathBuf),
}

static PROGRAM: OnceLock<Program> = OnceLock::new();

/// This process is nothing but the command, unless it was a Python before.
pub(crate) fn set_own() {
    if let Ok(program) = std::env::current_exe() {
        PROGRAM.get_or_init(|| Program::Own(program));
    }
}

/// This process is a Python.
pub(crate) fn set_python(program: PathBuf, packages: PathBuf) {
    PROGRAM.get_or_init(|| Program::Python(program, packages));
}

/// Cif as another process, to which the words of a command line are added: this program, and within programs of others the
/// command on the `PATH`.
pub(crate) fn command() -> Command {
    match PROGRAM.get() {
        Some(Program::Own(program)) => Command::new(program),
        Some(Program::Python(program, packages)) => {
            // A program may have added the folder to its own search path alone.
            let script = "sys.path.append(sys.argv[1]); import cif4d; sys.argv = ['cif', *sys.argv[2:]]; sys.exit(cif4d.main())";
            let mut command = cif_system::python::script(program, script);
            command.arg(packages);
            command
        }
        None => Command::new("cif"),
    }
}
