//! Colours: display-referred as captured, or linear as compositors expect them.

/// Which colours a file holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ColorEncoding {
    /// Linear light with Rec. 709 primaries: the sRGB curve of the captured colours is undone. Programs that open EXR
    /// files assume this encoding.
    #[default]
    Linear,
    /// The colours as captured, with the sRGB curve.
    Display,
}

impl ColorEncoding {
    /// Name in the `colorInteropID` attribute (ASWF Color Interop Forum).
    #[must_use]
    pub fn interop_id(self) -> &'static str {
        match self {
            Self::Linear => "lin_rec709_scene",
            Self::Display => "srgb_rec709_display",
        }
    }
}

/// The inverse of the sRGB curve (IEC 61966-2-1), continued as an odd function below 0.
#[must_use]
pub fn linear_from_srgb(value: f32) -> f32 {
    let size = value.abs();
    let linear = if size <= 0.040_45 { size / 12.92 } else { ((size + 0.055) / 1.055).powf(2.4) };
    linear.copysign(value)
}

/// Colour of the splats alone, multiplied by alpha: `color` lies on `background`, which is taken away.
///
/// Splats are blended in display-referred colours. To make them linear, the colour of what covers the pixel is:
/// where alpha is 1 the result is exactly the linear picture.
#[must_use]
pub fn premultiplied(color: [f32; 3], alpha: f32, background: [f32; 3], encoding: ColorEncoding) -> [f32; 3] {
    std::array::from_fn(|channel| {
        let own = color[channel] - (1.0 - alpha) * background[channel];
        match encoding {
            ColorEncoding::Display => own,
            ColorEncoding::Linear if alpha > 0.0 => alpha * linear_from_srgb(own / alpha),
            ColorEncoding::Linear => 0.0,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_is_that_of_the_standard() {
        for (display, linear) in [(0.0, 0.0), (0.040_45, 0.003_130_8), (0.5, 0.214_041), (1.0, 1.0)] {
            assert!((linear_from_srgb(display) - linear).abs() < 1e-6, "{display}");
        }
        assert_eq!(linear_from_srgb(-0.5), -linear_from_srgb(0.5));
    }

    #[test]
    fn the_background_leaves_and_comes_back() {
        let (background, splats, alpha) = ([1.0, 0.5, 0.0], [0.25, 0.5, 0.75], 0.4);
        let on_background = std::array::from_fn(|c| alpha * splats[c] + (1.0 - alpha) * background[c]);
        let display = premultiplied(on_background, alpha, background, ColorEncoding::Display);
        let linear = premultiplied(on_background, alpha, background, ColorEncoding::Linear);
        for channel in 0..3 {
            assert!((display[channel] - alpha * splats[channel]).abs() < 1e-6);
            assert!((linear[channel] - alpha * linear_from_srgb(splats[channel])).abs() < 1e-6);
        }
        assert_eq!(premultiplied(background, 0.0, background, ColorEncoding::Linear), [0.0; 3]);
    }
}
