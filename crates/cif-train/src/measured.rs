//! Worst errors of hard cases, as `tests/README.md` lists them.

/// Prints the worst error of a case, and holds it to its limit. `path` is `f64` or `f32`: what is measured.
#[track_caller]
pub(crate) fn worst(row: u32, path: &str, what: &str, error: f64, limit: f64) {
    println!("hard case {row} | {path} | alone | {what} | {error:.1e} | {limit:.0e}");
    // A NaN must not pass.
    assert!(error <= limit, "row {row}, {what}, {path}: {error:e} is above {limit:e}");
}
