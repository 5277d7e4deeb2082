//! Pixels inside polygons.

use super::coverage::Coverage;

/// Adds the pixels whose centres lie inside any of the outlines, by the even-odd rule for each. Corners are in pixels from
/// the top left corner of the picture; what lies outside of the picture is left out.
pub(super) fn cover(outlines: &[Vec<[f64; 2]>], coverage: &mut Coverage) {
    let (width, height) = (coverage.width, coverage.height);
    let mut crossings = Vec::new();
    for outline in outlines {
        let (top, bottom) =
            outline.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(top, bottom), corner| {
                (top.min(corner[1]), bottom.max(corner[1]))
            });
        // Centres of rows from the first corner on, up to the last.
        let row = |y: f64| (y - 0.5).ceil().clamp(0.0, f64::from(height)) as u32;
        for y in row(top)..row(bottom) {
            let line = f64::from(y) + 0.5;
            crossings.clear();
            for (k, a) in outline.iter().enumerate() {
                let b = outline[(k + 1) % outline.len()];
                if (a[1] <= line) != (b[1] <= line) {
                    crossings.push(a[0] + (line - a[1]) / (b[1] - a[1]) * (b[0] - a[0]));
                }
            }
            crossings.sort_by(f64::total_cmp);
            let start = u64::from(y) * u64::from(width);
            for pair in crossings.chunks_exact(2) {
                // Centres from the first crossing on, before the second.
                let column = |x: f64| (x - 0.5).ceil().clamp(0.0, f64::from(width)) as u64;
                coverage.add(start + column(pair[0])..start + column(pair[1]));
            }
        }
    }
}

/// The corners of a list x, y, x, y, ...
///
/// # Errors
/// When there are fewer than three, or a number is missing or not finite.
pub(super) fn corners(numbers: &[f64]) -> Result<Vec<[f64; 2]>, String> {
    if numbers.len() % 2 == 1 || numbers.len() < 6 {
        return Err(format!(
            "a polygon of {} numbers; x and y of three corners or more are expected",
            numbers.len()
        ));
    }
    if numbers.iter().any(|number| !number.is_finite() || number.abs() > 1e9) {
        return Err("a corner of a polygon is no finite number of pixels".to_owned());
    }
    Ok(numbers.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect())
}
