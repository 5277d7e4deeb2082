//! Opacities, colours and visibility over time.

/// Opacities and colours over time; see [`crate::appearance`]. Where there are samples they stand for the values of
/// [`Splats`] at all times, linear in between and held outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Appearance {
    /// Opacities, one per splat; ascending time codes, empty where they stay as in [`Splats::opacities`].
    pub opacities: Vec<AppearanceSample>,
    /// Coefficients as in [`Splats::sh_coefficients`]; ascending time codes, empty where they stay.
    pub colors: Vec<AppearanceSample>,
}

/// Values of all splats of a node at one time code.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceSample {
    /// Time code.
    pub time_code: f64,
    /// Values, splat-major.
    pub values: Vec<f32>,
}

/// A change of visibility; it holds until the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilitySample {
    /// Time code.
    pub time_code: f64,
    /// True when the node can be seen from here on.
    pub visible: bool,
}

/// True when changes of visibility leave something visible at a time code; before the first one it counts.
#[must_use]
pub fn is_visible_at(changes: &[VisibilitySample], time_code: f64) -> bool {
    let after = changes.partition_point(|sample| sample.time_code <= time_code);
    changes.get(after.max(1) - 1).is_none_or(|sample| sample.visible)
}
