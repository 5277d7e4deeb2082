//! The text of `cif --version`: the build and the machine.

use std::fmt::Write as _;
use std::sync::OnceLock;

use cif_train::Trainer;

/// Parts that a build may leave out, and whether this one has them.
const FEATURES: [(&str, bool); 3] =
    [("usd", cfg!(feature = "usd")), ("wgpu", cfg!(feature = "wgpu")), ("onnx", cfg!(feature = "onnx"))];

/// Version, commit, features, vector instructions, and where GPUs are shown: one a line, but for a commit that is not
/// known. GPUs are not asked for here: drivers take up to a second to start, and may fail.
pub(crate) fn long() -> &'static str {
    static TEXT: OnceLock<String> = OnceLock::new();
    TEXT.get_or_init(|| text(option_env!("CIF_COMMIT"), &FEATURES, &Trainer::vector_instructions()))
}

/// As [`long`], of a build and a machine.
fn text(commit: Option<&str>, features: &[(&str, bool)], vectors: &str) -> String {
    let mut text = env!("CARGO_PKG_VERSION").to_owned();
    let mut row = |name: &str, value: &str| {
        // A text takes every line.
        let _ = write!(text, "\n{name:<10}{value}");
    };
    if let Some(commit) = commit {
        row("commit", commit);
    }
    let built: Vec<&str> = features.iter().filter(|(_, is_built)| *is_built).map(|(name, _)| *name).collect();
    let built = if built.is_empty() { "none".to_owned() } else { built.join(", ") };
    row("features", &built);
    row("SIMD", vectors);
    if features.contains(&("wgpu", true)) {
        row("GPU", "shown by cif info --gpu");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::text;

    #[test]
    fn what_is_not_known_is_left_out() {
        let version = env!("CARGO_PKG_VERSION");
        let features = [("usd", true), ("wgpu", true), ("onnx", false)];
        assert_eq!(
            text(Some("0123456789-dirty"), &features, "avx2"),
            format!(
                "{version}\ncommit    0123456789-dirty\nfeatures  usd, wgpu\nSIMD      avx2\n\
                 GPU       shown by cif info --gpu"
            )
        );
        assert_eq!(
            text(None, &[("usd", false)], "portable"),
            format!("{version}\nfeatures  none\nSIMD      portable")
        );
    }
}
