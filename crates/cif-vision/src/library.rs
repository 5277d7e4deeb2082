//! The library of ONNX Runtime: `ORT_DYLIB_PATH`, or the one in the Python package `onnxruntime`.

use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use cif_system::environment::ONNX_RUNTIME;

use crate::Error;

/// Environment variable that names the library.
pub const VARIABLE: &str = ONNX_RUNTIME.name();

/// Prints the folder of the package without importing it, and nothing where it is missing.
const SCRIPT: &str = "import importlib.util as u; s = u.find_spec('onnxruntime'); \
                      print(s.submodule_search_locations[0] if s and s.submodule_search_locations else '', end='')";

/// Finds the library: what `ORT_DYLIB_PATH` names, else that of the first of `pythons` which has the package.
///
/// # Errors
/// When there is none, or the variable names no file.
pub fn find(pythons: &[OsString]) -> Result<PathBuf, Error> {
    find_named(ONNX_RUNTIME.value(), pythons)
}

fn find_named(named: Option<OsString>, pythons: &[OsString]) -> Result<PathBuf, Error> {
    if let Some(named) = named.filter(|name| !name.is_empty()) {
        // A name alone would be looked for among the libraries of the system.
        let named = PathBuf::from(named);
        let path = std::path::absolute(&named).unwrap_or_else(|_| named.clone());
        cif_input::check(&path).map_err(|error| {
            Error::refused(
                format!("{VARIABLE} names {}: {error}", path.display()),
                "give the path of libonnxruntime.so, libonnxruntime.dylib or onnxruntime.dll",
            )
        })?;
        return is_library(&path).then_some(path).ok_or_else(|| {
            Error::refused(
                format!("{VARIABLE} names {}, which is no library", named.display()),
                "give the path of libonnxruntime.so, libonnxruntime.dylib or onnxruntime.dll",
            )
        });
    }
    pythons.iter().find_map(|python| library_in(&package(python)?.join("capi"))).ok_or_else(|| {
        let asked: Vec<_> = pythons.iter().map(|python| python.to_string_lossy()).collect();
        Error::refused(
            format!(
                "models are run by ONNX Runtime, whose library is not there (looked for the Python package \
                 onnxruntime with {})",
                asked.join(", ")
            ),
            format!(
                "pip install 'cif4d[vision]', or pip install onnxruntime; or name the library by {VARIABLE}"
            ),
        )
    })
}

/// True where a file begins as libraries of Linux, macOS or Windows do: ELF, Mach-O (of one processor or several), or PE.
fn is_library(path: &Path) -> bool {
    const BEGINNINGS: [&[u8]; 6] = [
        b"\x7fELF",
        b"\xcf\xfa\xed\xfe",
        b"\xce\xfa\xed\xfe",
        b"\xca\xfe\xba\xbe",
        b"\xca\xfe\xba\xbf",
        b"MZ",
    ];
    let mut start = [0; 4];
    let read = std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut start));
    read.is_ok() && BEGINNINGS.iter().any(|beginning| start.starts_with(beginning))
}

/// Folder of the Python package.
fn package(python: &OsString) -> Option<PathBuf> {
    let asked =
        cif_system::python::script(python, SCRIPT).stdin(Stdio::null()).stderr(Stdio::null()).output();
    let output = asked.ok().filter(|output| output.status.success())?.stdout;
    let folder = PathBuf::from(String::from_utf8(output).ok()?);
    folder.is_absolute().then_some(folder)
}

/// The library in a folder: `libonnxruntime.so.1.23.0` and alike, not those of its providers.
fn library_in(folder: &Path) -> Option<PathBuf> {
    let is_library = |name: &str| {
        name == "onnxruntime.dll"
            || name
                .strip_prefix("libonnxruntime.")
                .is_some_and(|rest| rest.starts_with("so") || rest.ends_with("dylib"))
    };
    let files = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let mut found: Vec<PathBuf> = files
        .filter(|path| path.file_name().and_then(|name| name.to_str()).is_some_and(is_library))
        .collect();
    found.sort();
    found.pop()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_library_is_distinguished_from_its_providers() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["libonnxruntime_providers_shared.so", "onnxruntime_pybind11_state.so", "__init__.py"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        assert_eq!(library_in(folder.path()), None);
        for name in ["libonnxruntime.so.1.23.0", "libonnxruntime.1.23.0.dylib", "onnxruntime.dll"] {
            let path = folder.path().join(name);
            std::fs::write(&path, "").unwrap();
            assert_eq!(library_in(folder.path()).as_deref(), Some(&*path));
            std::fs::remove_file(path).unwrap();
        }
        assert_eq!(library_in(&folder.path().join("nowhere")), None);
    }

    #[test]
    fn a_package_of_the_current_folder_is_not_taken() {
        const FOLDER: &str = "CIF_VISION_TEST_FOLDER";
        let python = cif_system::environment::BUILD_PYTHON.value().unwrap_or_else(|| "python3".into());
        if let Some(folder) = std::env::var_os(FOLDER) {
            let found = package(&python);
            assert!(!found.as_ref().is_some_and(|found| found.starts_with(folder)), "{found:?}");
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let capi = folder.path().join("onnxruntime/capi");
        std::fs::create_dir_all(&capi).unwrap();
        std::fs::write(capi.join("../__init__.py"), "").unwrap();
        std::fs::write(capi.join("libonnxruntime.so.9"), "").unwrap();
        // The current folder is one for the whole process.
        let child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "library::tests::a_package_of_the_current_folder_is_not_taken"])
            .env(FOLDER, folder.path().canonicalize().unwrap())
            .current_dir(folder.path())
            .output()
            .unwrap();
        assert!(child.status.success(), "{}", String::from_utf8_lossy(&child.stdout));
    }

    #[test]
    fn pythons_without_the_package_are_reported() {
        let named = find_named(Some("no/libonnxruntime.so".into()), &[]).unwrap_err().to_string();
        assert!(named.contains(VARIABLE) && named.contains("no/libonnxruntime.so"), "{named}");
        let folder = tempfile::tempdir().unwrap();
        let text = folder.path().join("libonnxruntime.so");
        std::fs::write(&text, "root:x:0:0").unwrap();
        let named = find_named(Some(text.clone().into()), &[]).unwrap_err().to_string();
        assert!(named.contains(VARIABLE) && named.contains("is no library"), "{named}");
        std::fs::write(&text, b"\x7fELF\x02").unwrap();
        assert_eq!(find_named(Some(text.clone().into()), &[]).unwrap(), text);
        let error = find_named(None, &["no-such-python".into()]).unwrap_err();
        let Error::Refused { problem, fix } = error else { panic!("another error") };
        assert!(problem.contains("no-such-python"), "{problem}");
        assert!(fix.contains("pip install") && fix.contains(VARIABLE), "{fix}");
    }
}
