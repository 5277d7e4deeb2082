//! Pixels inside polygons.

/// Places, row by row and ascending, of the pixels whose centres lie inside any of the outlines, by the even-odd rule for
/// each. Corners are in pixels from the top left corner of the picture; what lies outside of the picture is left out.
pub(super) fn fill(outlines: &[Vec<[f64; 2]>], (width, height): (u32, u32)) -> Vec<u32> {
    let mut found = Vec::new();
    let mut crossings = Vec::new();
    for y in 0..height {
        let line = f64::from(y) + 0.5;
        let start = found.len();
        for outline in outlines {
            crossings.clear();
            for (k, a) in outline.iter().enumerate() {
                let b = outline[(k + 1) % outline.len()];
                if (a[1] <= line) != (b[1] <= line) {
                    crossings.push(a[0] + (line - a[1]) / (b[1] - a[1]) * (b[0] - a[0]));
                }
            }
            crossings.sort_by(f64::total_cmp);
            for pair in crossings.chunks_exact(2) {
                // Centres from the first crossing on, before the second.
                let column = |x: f64| (x - 0.5).ceil().clamp(0.0, f64::from(width)) as u32;
                found.extend((column(pair[0])..column(pair[1])).map(|x| y * width + x));
            }
        }
        if outlines.len() > 1 {
            found[start..].sort_unstable();
        }
    }
    found.dedup();
    found
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
