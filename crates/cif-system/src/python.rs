//! Python as a child process that takes no modules from the current folder: a file there must not stand in for a package.

use std::env::{join_paths, split_paths};
use std::ffi::{OsStr, OsString};
use std::process::Command;

use crate::environment;

/// The search path of modules.
const PATH: &str = environment::PYTHON_PATH.name();

/// For Python from 3.11 on, and whatever Python it starts: the current folder is not searched.
const SAFE_PATH: &str = "PYTHONSAFEPATH";

/// The same for Python 3.10, which knows no such variable: the empty entry is the current folder. Nothing is imported for it,
/// since `sys` is part of the interpreter.
const WITHOUT_CURRENT: &str = "import sys; sys.path[:] = [path for path in sys.path if path]\n";

/// A Python that will run a script. Packages come from where they are installed, those of the user included, and from the
/// absolute paths of `PYTHONPATH`.
#[must_use]
pub fn script(program: impl AsRef<OsStr>, script: &str) -> Command {
    with_path(program.as_ref(), script, environment::PYTHON_PATH.value())
}

fn with_path(program: &OsStr, script: &str, path: Option<OsString>) -> Command {
    let mut command = Command::new(program);
    command.arg("-c").arg(format!("{WITHOUT_CURRENT}{script}"));
    command.env(SAFE_PATH, "1");
    // Entries that are relative or empty are the current folder too, before anything can be said in a script.
    let absolute = path.map(|path| split_paths(&path).filter(|path| path.is_absolute()).collect::<Vec<_>>());
    match absolute.filter(|paths| !paths.is_empty()).and_then(|paths| join_paths(paths).ok()) {
        Some(path) => command.env(PATH, path),
        None => command.env_remove(PATH),
    };
    command
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_of_the_current_folder_are_not_found_and_those_of_the_path_are() {
        let program = environment::BUILD_PYTHON.value().unwrap_or_else(|| "python3".into());
        let (current, named) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        for (folder, module) in [(&current, "planted"), (&named, "named")] {
            let package = folder.path().join(module);
            std::fs::create_dir(&package).unwrap();
            std::fs::write(package.join("__init__.py"), "raise SystemExit(3)\n").unwrap();
        }
        let named = named.path().as_os_str();
        let both = join_paths([OsStr::new(""), OsStr::new("."), named]).unwrap();
        for (path, known) in
            [(None, "False False\n"), (Some("".into()), "False False\n"), (Some(both), "False True\n")]
        {
            let asked =
                "import importlib.util as u; print(*(bool(u.find_spec(m)) for m in ('planted', 'named')))";
            let output = with_path(&program, asked, path.clone()).current_dir(&current).output().unwrap();
            assert_eq!(String::from_utf8_lossy(&output.stdout).replace('\r', ""), known, "{path:?}");
        }
    }
}
