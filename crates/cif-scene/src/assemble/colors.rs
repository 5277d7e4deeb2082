//! Colours of files as display-referred sRGB, in which splats are kept.

use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};
use glam::{DMat3, DVec3};

/// Largest value of colours whose white is 1; higher ones are brighter than white, or count to 255. Chosen: colours of
/// surfaces seldom pass twice white, and those that count to 255 nearly always do.
const BRIGHTEST: f32 = 2.0;

/// White of colours that do not say theirs, by the largest of them: 1, 255 or 65535, the latter two named in a warning;
/// `place` names them.
pub fn color_range(values: impl IntoIterator<Item = f32>, place: &str, warnings: &mut Vec<String>) -> f32 {
    let largest = values.into_iter().fold(0.0, f32::max);
    let white = match largest {
        _ if largest <= BRIGHTEST => return 1.0,
        _ if largest <= 255.0 => 255.0,
        _ => 65_535.0,
    };
    warnings.push(format!("{place}: its colours go up to {largest}: {white} was taken for full light"));
    white
}

/// How the colours of a file are encoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColorEncoding {
    /// Linear light of the primaries of BT.709 from that of the encoding, for column vectors.
    pub to_rec709: DMat3,
    /// Exponent from encoded values to light; 1 for linear ones.
    pub gamma: f64,
    /// Offset of the curve, as 0.055 of sRGB: above a straight beginning, light is `((v + a) / (1 + a))^gamma`.
    pub linear_bias: f64,
}

impl ColorEncoding {
    /// Linear light of the primaries of sRGB.
    pub const LINEAR: Self = Self { to_rec709: DMat3::IDENTITY, gamma: 1.0, linear_bias: 0.0 };
    /// The encoding of splats.
    pub const SRGB: Self = Self { to_rec709: DMat3::IDENTITY, gamma: 2.4, linear_bias: 0.055 };

    /// Light of an encoded value; below 0 the curve is mirrored.
    fn light(&self, value: f64) -> f64 {
        let (gamma, a) = (self.gamma, self.linear_bias);
        if gamma == 1.0 {
            return value;
        }
        let curve = |value: f64| ((value + a) / (1.0 + a)).powf(gamma);
        // The straight beginning is the tangent through the origin.
        let start = a / (gamma - 1.0);
        let size = value.abs();
        value.signum() * if size < start { size * curve(start) / start } else { curve(size) }
    }

    fn display(&self, value: DVec3) -> DVec3 {
        let light = DVec3::from_array(value.to_array().map(|value| self.light(value)));
        (self.to_rec709 * light).to_array().map(srgb_from_linear).into()
    }

    /// Brings coefficients `[N, (degree + 1)^2, 3]` to display values: the mean colour exactly, what depends on the view
    /// to first order, by the slopes of the conversion there.
    pub fn bring_to_display(&self, coefficients: &mut [f32], degree: u8) {
        /// Half the step of a central difference; single precision holds values near 1 to 1e-7.
        const STEP: f64 = 1e-4;
        for row in coefficients.chunks_exact_mut(3 * coefficient_count(degree)) {
            let encoded = DVec3::from_array(std::array::from_fn(|c| 0.5 + BAND_0 * f64::from(row[c])));
            let slope = |axis: DVec3| {
                (self.display(encoded + STEP * axis) - self.display(encoded - STEP * axis)) / (2.0 * STEP)
            };
            let slopes = DMat3::from_cols(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z));
            for (band, sh) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let changed = match band {
                    0 => (self.display(encoded) - 0.5) / BAND_0,
                    _ => slopes * DVec3::from_array(sh.map(f64::from)),
                };
                *sh = changed.to_array().map(|value| value as f32);
            }
        }
    }
}

/// Linear light to display-referred sRGB (IEC 61966-2-1); above 1 the curve goes on straight, and so it does below 0.
fn srgb_from_linear(value: f64) -> f64 {
    if value <= 0.003_130_8 {
        value * 12.92
    } else if value < 1.0 {
        1.055 * value.powf(1.0 / 2.4) - 0.055
    } else {
        1.0 + 1.055 / 2.4 * (value - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coefficient(color: f64) -> f32 {
        ((color - 0.5) / BAND_0) as f32
    }

    #[test]
    fn light_becomes_what_a_display_shows() {
        let mut sh = [coefficient(0.2); 12];
        ColorEncoding::LINEAR.bring_to_display(&mut sh, 1);
        // 0.2 of full light is 0.484529 on a display, where the slope is 1.1240.
        assert!((f64::from(sh[0]) - f64::from(coefficient(0.484_529))).abs() < 1e-5, "{sh:?}");
        assert!((sh[3] / coefficient(0.2) - 1.1240).abs() < 1e-3, "{sh:?}");
        let mut gamma = [coefficient(0.6); 3];
        ColorEncoding { gamma: 2.2, linear_bias: 0.0, ..ColorEncoding::LINEAR }
            .bring_to_display(&mut gamma, 0);
        let expected = coefficient(srgb_from_linear(0.6_f64.powf(2.2)));
        assert!((gamma[0] - expected).abs() < 1e-5, "{gamma:?} {expected}");
    }

    #[test]
    fn display_values_stay() {
        for color in [0.0, 0.02, 0.3, 0.9, 1.0] {
            let mut sh = [coefficient(color); 12];
            ColorEncoding::SRGB.bring_to_display(&mut sh, 1);
            assert!(sh.iter().all(|value| (value - coefficient(color)).abs() < 4e-3), "{color} {sh:?}");
        }
    }

    #[test]
    fn white_is_known_from_the_range() {
        let mut warnings = Vec::new();
        assert_eq!(color_range([0.0, 1.0, 1.2], "a", &mut warnings), 1.0);
        assert!(warnings.is_empty());
        assert_eq!(color_range([0.0, 128.0], "a", &mut warnings), 255.0);
        assert_eq!(color_range([400.0], "a", &mut warnings), 65_535.0);
        assert!(warnings[0].starts_with("a: its colours go up to 128"), "{warnings:?}");
    }
}
