//! The environment variables that cif reads.
//!
//! A variable is read through its constant here, so that [`ALL`] is complete; `docs/reference/environment.md` is
//! generated from it.

use std::ffi::OsString;

/// An environment variable.
#[derive(Debug)]
pub struct Variable {
    name: &'static str,
    values: &'static str,
    default: &'static str,
    effect: &'static str,
    readers: Readers,
}

/// The programs that read a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Readers {
    /// The command and the Python module.
    Users,
    /// Tests and the build.
    Tests,
}

/// Declares the constants and the list of all of them.
macro_rules! variables {
    ($($(#[doc = $effect:literal])+ $constant:ident = $name:literal, $readers:ident, $values:literal, default $default:literal;)+) => {
        $(
            $(#[doc = $effect])+
            pub const $constant: Variable = Variable {
                name: $name,
                values: $values,
                default: $default,
                effect: concat!($($effect),+),
                readers: Readers::$readers,
            };
        )+

        /// Every variable, those of users first.
        pub const ALL: &[&Variable] = &[$(&$constant),+];
    };
}

variables! {
    /// Python that runs pycolmap and holds the package `onnxruntime`. The Python module uses the Python that it is
    /// loaded in, unless this names another.
    PYTHON = "CIF_PYTHON", Users, "a program or its path", default "`python3`, then `python`";
    /// Optional features that GPUs may use where they have them.
    GPU_FEATURES = "CIF_GPU_FEATURES", Users,
        "`all`, `none`, or a list of `subgroups` and `timestamps` separated by commas",
        default "all that make the GPU faster";
    /// GPU to use, where there are several: the first whose name contains the text, in upper or lower case.
    GPU_NAME = "WGPU_ADAPTER_NAME", Users, "part of a name that `cif info --gpu` lists", default "the first of the list";
    /// Library of ONNX Runtime, which runs detectors, segmenters and embedders.
    ONNX_RUNTIME = "ORT_DYLIB_PATH", Users, "a file", default "the library in the Python package `onnxruntime`";
    /// Messages and errors without colours. See <https://no-color.org>.
    NO_COLOR = "NO_COLOR", Users, "anything", default "colours on a terminal";
    /// Folders in which a Python that cif starts searches for packages. Relative folders are left out, so that a file
    /// in the current folder cannot stand in for a package.
    PYTHON_PATH = "PYTHONPATH", Users, "folders, separated as in `PATH`", default "none";
    /// Name of this machine in locks and records of jobs, on systems other than Linux and Windows.
    HOSTNAME = "HOSTNAME", Users, "a name", default "none";
    /// Name of this machine in locks and records of jobs, on Windows.
    COMPUTERNAME = "COMPUTERNAME", Users, "a name", default "that of the system";
    /// Folders in which USD searches for plugins. The Python module appends the folder of its schemas.
    USD_PLUGINS = "PXR_PLUGINPATH_NAME", Users, "folders, separated as in `PATH`", default "none";

    /// GPU of the tests: `auto` uses a GPU where there is one, a software implementation such as lavapipe too, `off`
    /// skips the tests that need one, `require` fails without one.
    TEST_GPU = "CIF_TEST_GPU", Tests, "`auto`, `off` or `require`", default "`auto`";
    /// ONNX Runtime of the tests: `auto` uses it where it is installed, `off` skips the tests that need it, `require`
    /// fails without it.
    TEST_ONNX = "CIF_TEST_ONNX", Tests, "`auto`, `off` or `require`", default "`auto`; `require` in `make test`";
    /// Python with MuJoCo, for `tests/python/test_mujoco.py`.
    TEST_MUJOCO = "CIF_TEST_MUJOCO", Tests, "a program or its path", default "the tests are skipped";
    /// Python with Newton, for `tests/python/test_newton.py`.
    TEST_NEWTON = "CIF_TEST_NEWTON", Tests, "a program or its path", default "the tests are skipped";
    /// Python with NVIDIA's asset validator, for `tests/python/test_validator.py`.
    TEST_VALIDATOR = "CIF_TEST_VALIDATOR", Tests, "a program or its path", default "the tests are skipped";
    /// Python with NVIDIA's SimReady features, for `tests/python/test_simready.py`.
    TEST_SIMREADY = "CIF_TEST_SIMREADY", Tests, "a program or its path", default "the tests are skipped";
    /// Program `openjd`, for `tests/python/test_batch.py`.
    TEST_OPENJD = "CIF_TEST_OPENJD", Tests, "a program or its path", default "the test is skipped";
    /// Browser for `tests/python/test_page.py`.
    TEST_CHROMIUM = "CIF_TEST_CHROMIUM", Tests, "a program or its path", default "a Chromium on the PATH";
    /// Tests of the page in a browser: `require` fails without one.
    TEST_PAGE = "CIF_TEST_PAGE", Tests, "`require`", default "the tests are skipped without a browser";
    /// Folder of what `make dist` made, for `tests/python/test_dist.py`.
    TEST_DIST = "CIF_TEST_DIST", Tests, "a folder", default "the tests are skipped";
    /// Tests of what `make dist` made in containers: `require` fails without a program that builds them.
    TEST_CONTAINER = "CIF_TEST_CONTAINER", Tests, "`require`", default "the tests are skipped without such a program";
    /// Time for which `make fuzz` damages files, with random seeds.
    FUZZ_MINUTES = "CIF_FUZZ_MINUTES", Tests, "minutes", default "a fixed number of files with fixed seeds";
    /// Readers that are given damaged files: those whose name contains the text.
    FUZZ_READER = "CIF_FUZZ_READER", Tests, "part of a name", default "all readers";
    /// Seed of the only damaged file to try.
    FUZZ_SEED = "CIF_FUZZ_SEED", Tests, "an integer", default "many seeds";
    /// Number of damaged USD stages to try.
    FUZZ_STAGES = "CIF_FUZZ_STAGES", Tests, "an integer", default "120";
    /// Tests that compare the pages of `docs/reference/` with the code write the pages instead, as in `make docs`.
    WRITE_DOCS = "CIF_WRITE_DOCS", Tests, "`1`", default "the pages are compared";
    /// Python that PyO3 is built for; tests that start Python start this one.
    BUILD_PYTHON = "PYO3_PYTHON", Tests, "a program or its path", default "`python3`";
}

impl Variable {
    /// Name, as the shell has it.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// Values that it may have, in Markdown.
    #[must_use]
    pub const fn values(&self) -> &'static str {
        self.values
    }

    /// Behaviour where it is not set, in Markdown.
    #[must_use]
    pub const fn default(&self) -> &'static str {
        self.default
    }

    /// Meaning, in Markdown.
    #[must_use]
    pub const fn effect(&self) -> &'static str {
        self.effect
    }

    /// The programs that read it.
    #[must_use]
    pub const fn readers(&self) -> Readers {
        self.readers
    }

    /// Value; `None` where it is not set.
    #[must_use]
    pub fn value(&self) -> Option<OsString> {
        std::env::var_os(self.name)
    }

    /// Value as text; `None` where it is not set or not UTF-8.
    #[must_use]
    pub fn text(&self) -> Option<String> {
        std::env::var(self.name).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_are_listed_once_and_read_by_their_names() {
        let names: std::collections::BTreeSet<_> = ALL.iter().map(|variable| variable.name()).collect();
        assert_eq!(names.len(), ALL.len());
        assert!(ALL.iter().any(|variable| variable.name() == PYTHON.name()));
        let path = Variable { name: "PATH", ..PYTHON };
        assert_eq!(path.value(), std::env::var_os("PATH"));
        assert_eq!(Variable { name: "CIF_NOT_SET", ..PYTHON }.text(), None);
    }
}
