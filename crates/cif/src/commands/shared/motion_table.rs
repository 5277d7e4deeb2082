//! Columns of motion in the tables of `cif export` and `cif bench export`.

use cif_scene::graph::ReportRow;

/// Headings of [`cells`].
pub(in crate::commands) const HEADINGS: [&str; 10] =
    ["motion", "parts", "size", "allowed", "error RMS", "decisive", "max", "samples", "KB", "seconds"];

/// Motion of a node: distances in world units, kilobytes of the sampled values, seconds of fitting.
pub(in crate::commands) fn cells(row: &ReportRow) -> [String; 10] {
    let motion = &row.motion;
    [
        motion.model.to_string(),
        if motion.parts > 0 { motion.parts.to_string() } else { String::new() },
        format!("{:.4}", motion.size),
        format!("{:.5}", motion.tolerance),
        format!("{:.5}", motion.residual.rms),
        format!("{:.5}", motion.residual.decisive),
        format!("{:.5}", motion.residual.max),
        motion.samples.to_string(),
        format!("{:.1}", motion.motion_bytes as f64 / 1e3),
        format!("{:.3}", row.seconds),
    ]
}
