//! Options of an export.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use cif_geometry::UpAxis;

use super::motion::MotionModel;

/// Largest deviation of a fitted motion from the trained one. Recorded poses are not fitted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Tolerance {
    /// World units (metres).
    Absolute(f64),
    /// Percent of the size of the instance: the diagonal of the box of its centres at the reference time,
    /// outermost 2 % of the weight left out on each side.
    Percent(f64),
}

impl Default for Tolerance {
    fn default() -> Self {
        Self::Percent(0.2)
    }
}

impl Tolerance {
    /// The tolerance of an instance of this size, world units.
    #[must_use]
    pub fn in_world_units(self, size: f64) -> f64 {
        match self {
            Self::Absolute(distance) => distance,
            Self::Percent(percent) => size * percent / 100.0,
        }
    }
}

impl FromStr for Tolerance {
    type Err = OptionError;

    /// `0.5%` is a percentage, `0.002` are world units.
    fn from_str(text: &str) -> Result<Self, OptionError> {
        let trimmed = text.trim();
        let (number, percent) = match trimmed.strip_suffix('%') {
            Some(number) => (number.trim_end(), true),
            None => (trimmed, false),
        };
        match number.parse::<f64>() {
            Ok(value) if value.is_finite() && value >= 0.0 => {
                Ok(if percent { Self::Percent(value) } else { Self::Absolute(value) })
            }
            _ => Err(OptionError {
                option: "tolerance",
                value: text.to_owned(),
                expected: "a distance in world units (0.002) or a percentage of the instance size (1%)",
            }),
        }
    }
}

/// A value that an option does not take.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{option} is {value}, but must be {expected}")]
pub struct OptionError {
    /// The option.
    pub option: &'static str,
    /// Its value, as given.
    pub value: String,
    /// Values that it takes.
    pub expected: &'static str,
}

/// Captured frame numbers, both ends included. Frame numbers index [`cif_field::Timeline::times`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameRange {
    /// First frame.
    pub first: usize,
    /// Last frame.
    pub last: usize,
}

impl FromStr for FrameRange {
    type Err = OptionError;

    /// `12` or `0:71`.
    fn from_str(text: &str) -> Result<Self, OptionError> {
        let parse = |part: &str| part.trim().parse::<usize>().ok();
        let range = match text.split_once(':') {
            Some((first, last)) => parse(first).zip(parse(last)),
            None => parse(text).map(|frame| (frame, frame)),
        };
        match range {
            Some((first, last)) if first <= last => Ok(Self { first, last }),
            _ => Err(OptionError {
                option: "frame range",
                value: text.to_owned(),
                expected: "FIRST:LAST with FIRST <= LAST, or one frame number",
            }),
        }
    }
}

/// Options of [`crate::build`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneOptions {
    /// Largest residual of a motion that is fitted: of everything but recorded poses, which leave as they are
    /// ([`crate::motion`]). Default 0.2 % of the instance size.
    pub tolerance: Tolerance,
    /// Largest RMS error of opacities and colours that change over time, in units of opacity and of
    /// spherical-harmonics coefficients; 0 keeps them at every sampled frame. Default 0.01.
    pub appearance_tolerance: f64,
    /// The most expensive motion model that may be chosen; what is lost is only reported then. `rigid` keeps
    /// every instance a rigid body; `parts` is for formats that hold no dense motion but that of a few splats of the
    /// background ([`crate::LOOSE_SPLATS`]). Default dense.
    pub most_expensive_motion: MotionModel,
    /// Gaussians below this opacity are left out. Default 1/255: the blending rule never draws fainter ones.
    pub min_opacity: f32,
    /// Gaussians below this occupancy are left out. Default 0: none.
    pub min_occupancy: f32,
    /// Gaussians whose instance mass (occupancy times probability of the most probable instance) is below
    /// this are background, unless they are enclosed by an instance (see [`crate::from_field::assignment`]). Default 0:
    /// the share of labelled pixels decides alone. Colour is drawn by opacity, so that many splats of an object keep
    /// occupancies near their start of 0.02; a threshold above leaves their colour behind when the object moves.
    pub background_threshold: f32,
    /// Most rigid parts of an instance that are looked for, 2 to 64; what needs more becomes dense. Default 8.
    pub max_parts: usize,
    /// Leave out samples that interpolation reproduces: inside the tolerance, or up to rounding where poses are recorded.
    /// Default true.
    pub reduce_keys: bool,
    /// Most convex hulls of an instance, 0 for no colliders. More than one pay for concave instances. Default 1.
    pub hulls_per_instance: usize,
    /// Most convex hulls of the background. Default 0: viewers need none, and one hull of a whole room would
    /// hold every object in it. Simulators in which objects fall need about 16 to 64.
    pub background_hulls: usize,
    /// Frames to export; `None` takes all.
    pub frames: Option<FrameRange>,
    /// Every how many frames motion and cameras are sampled; the last frame is always kept. Default 1.
    pub frame_step: usize,
    /// Declared up axis. Default `None`: that of the file that the field was imported from, else z.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up_axis: Option<UpAxis>,
    /// Metres per world unit. Default `None`: that of the file that the field was imported from, else 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub meters_per_unit: Option<f64>,
    /// Most points of a node's proxy; 0 leaves proxies out. Default 2000.
    pub proxy_points: usize,
    /// Make the low-pass filter of the renderer (0.3 px^2) part of the splats, at the distances from which the recorded
    /// cameras see them, for viewers that have no such filter: thin parts vanish there. Viewers that have one then
    /// filter twice. Default false.
    pub bake_blur: bool,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self {
            tolerance: Tolerance::default(),
            appearance_tolerance: 0.01,
            most_expensive_motion: MotionModel::Dense,
            min_opacity: 1.0 / 255.0,
            min_occupancy: 0.0,
            background_threshold: 0.0,
            max_parts: 8,
            reduce_keys: true,
            hulls_per_instance: 1,
            background_hulls: 0,
            frames: None,
            frame_step: 1,
            up_axis: None,
            meters_per_unit: None,
            proxy_points: 2000,
            bake_blur: false,
        }
    }
}

impl SceneOptions {
    /// Refuses values outside their range.
    pub(crate) fn validate(&self) -> Result<(), OptionError> {
        let unit = |option, value: f32| {
            if (0.0..=1.0).contains(&value) {
                Ok(())
            } else {
                Err(OptionError { option, value: value.to_string(), expected: "between 0 and 1" })
            }
        };
        unit("min_opacity", self.min_opacity)?;
        unit("min_occupancy", self.min_occupancy)?;
        unit("background_threshold", self.background_threshold)?;
        let (Tolerance::Absolute(tolerance) | Tolerance::Percent(tolerance)) = self.tolerance;
        if !(tolerance.is_finite() && tolerance >= 0.0) {
            return Err(OptionError {
                option: "tolerance",
                value: tolerance.to_string(),
                expected: "0 or more",
            });
        }
        if !(self.appearance_tolerance.is_finite() && self.appearance_tolerance >= 0.0) {
            return Err(OptionError {
                option: "appearance tolerance",
                value: self.appearance_tolerance.to_string(),
                expected: "0 or more",
            });
        }
        if !(2..=64).contains(&self.max_parts) {
            return Err(OptionError {
                option: "max_parts",
                value: self.max_parts.to_string(),
                expected: "2 to 64",
            });
        }
        if self.frame_step == 0 {
            return Err(OptionError { option: "frame_step", value: "0".into(), expected: "1 or more" });
        }
        if let Some(unit) = self.meters_per_unit.filter(|unit| !(unit.is_finite() && *unit > 0.0)) {
            return Err(OptionError {
                option: "meters_per_unit",
                value: unit.to_string(),
                expected: "above 0",
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tolerances_parse_both_units() {
        assert_eq!("0.5%".parse::<Tolerance>().unwrap(), Tolerance::Percent(0.5));
        assert_eq!("0.002".parse::<Tolerance>().unwrap(), Tolerance::Absolute(0.002));
        for bad in ["", "x%", "-1", "nan", "inf%"] {
            assert!(bad.parse::<Tolerance>().is_err(), "{bad}");
        }
    }

    #[test]
    fn frame_ranges_parse() {
        assert_eq!("3:9".parse::<FrameRange>().unwrap(), FrameRange { first: 3, last: 9 });
        assert_eq!("4".parse::<FrameRange>().unwrap(), FrameRange { first: 4, last: 4 });
        for bad in ["9:3", "a:b", ":", "-1:4"] {
            assert!(bad.parse::<FrameRange>().is_err(), "{bad}");
        }
    }

    #[test]
    fn options_outside_their_range_are_refused() {
        let bad = [
            SceneOptions { max_parts: 1, ..SceneOptions::default() },
            SceneOptions { frame_step: 0, ..SceneOptions::default() },
            SceneOptions { min_opacity: f32::NAN, ..SceneOptions::default() },
            SceneOptions { meters_per_unit: Some(0.0), ..SceneOptions::default() },
            SceneOptions { tolerance: Tolerance::Percent(-1.0), ..SceneOptions::default() },
            SceneOptions { appearance_tolerance: f64::NAN, ..SceneOptions::default() },
        ];
        for options in bad {
            assert!(options.validate().is_err(), "{options:?}");
        }
        assert!(SceneOptions::default().validate().is_ok());
    }
}
