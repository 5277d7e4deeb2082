//! Modules come from where they are installed.

use pyo3::prelude::*;

use crate::pxr::without_current_folder;

#[test]
fn relative_entries_of_the_search_path_are_left_out_of_imports_and_stay() {
    let _session = super::session();
    Python::attach(|py| {
        let path = || py.import("sys").and_then(|sys| sys.getattr("path")).unwrap();
        let entries = || path().extract::<Vec<String>>().unwrap();
        let installed = entries();
        for entry in ["", ".", "here"] {
            path().call_method1("insert", (0, entry)).unwrap();
        }
        let before = entries();
        let meanwhile = without_current_folder(py, || Ok(entries())).unwrap();
        let after = entries();
        for _ in 0..3 {
            path().call_method1("pop", (0,)).unwrap();
        }
        assert_eq!((meanwhile, after), (installed, before));
    });
}
