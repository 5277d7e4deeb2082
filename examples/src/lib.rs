//! Where the examples find their capture and keep their scene.

use std::path::{Path, PathBuf};

/// The capture in the repository.
#[must_use]
pub fn capture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tabletop-mini")
}

/// A file among the build products, made where it does not exist yet.
///
/// # Errors
/// When the folder cannot be made.
pub fn output(name: &str) -> std::io::Result<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/examples-output");
    std::fs::create_dir_all(&folder)?;
    Ok(folder.join(name))
}
