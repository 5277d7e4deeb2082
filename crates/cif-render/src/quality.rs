//! Renders that take shortcuts: fewer pixels, less view-dependent colour, no faint Gaussians.

use std::borrow::Cow;

use cif_field::Field;
use cif_geometry::scalar::logit;
use cif_geometry::{PinholeCamera, PixelGrid};

use crate::cpu::Renderer;
use crate::{Channels, InstanceImage, RenderSettings, RenderedImage};

/// Shortcuts of a render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// Images are rendered this many times smaller along each side, then enlarged.
    pub reduction: u32,
    /// Highest spherical-harmonics degree; none for that of the scene.
    pub sh_degree: Option<u8>,
    /// Gaussians whose opacity and occupancy are both less are left out.
    pub min_opacity: f32,
}

/// No shortcut.
pub const FINAL: Quality = Quality { reduction: 1, sh_degree: None, min_opacity: 0.0 };

/// Shortcuts of `--quality draft`.
///
/// Faint Gaussians cost as much as others and show little. Smaller images are no part of it: the low-pass filter
/// of 0.3 pixels then blurs twice as far, which costs several dB and, where deformation takes most of the time,
/// saves little.
pub const DRAFT: Quality = Quality { reduction: 1, sh_degree: None, min_opacity: 0.3 };

impl Quality {
    /// The field without what is left out; as it is where that would be everything.
    #[must_use]
    pub fn thin<'a>(&self, field: &'a Field) -> Cow<'a, Field> {
        if self.min_opacity <= 0.0 {
            return Cow::Borrowed(field);
        }
        let least = logit(self.min_opacity);
        let gaussians = &field.gaussians;
        let seen = |row: &u32| {
            let row = *row as usize;
            gaussians.opacity_logits[row] >= least || gaussians.occupancy_logits[row] >= least
        };
        let kept: Vec<u32> = (0..gaussians.len() as u32).filter(seen).collect();
        if kept.is_empty() || kept.len() == gaussians.len() {
            return Cow::Borrowed(field);
        }
        Cow::Owned(field.gather(&kept))
    }

    /// Settings of a render in this quality.
    #[must_use]
    pub fn settings(&self, settings: &RenderSettings) -> RenderSettings {
        let sh_degree = self.sh_degree.map_or(settings.sh_degree, |degree| degree.min(settings.sh_degree));
        RenderSettings { sh_degree, ..*settings }
    }

    /// Renders a view of a field that [`Self::thin`] gave, in the size of the camera.
    pub fn render(
        &self,
        renderer: &mut Renderer,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
    ) -> RenderedImage {
        let settings = self.settings(settings);
        if self.reduction <= 1 {
            return renderer.render(field, camera, time, &settings, channels);
        }
        let less = |pixels: u32| pixels.div_ceil(self.reduction).max(1);
        let small = camera.resized(less(camera.width), less(camera.height));
        enlarge(&renderer.render(field, &small, time, &settings, channels), camera.width, camera.height)
    }
}

/// Colour and coverage are interpolated, everything else is taken from the nearest pixel: labels do not mix,
/// and neither do depths across an edge.
fn enlarge(image: &RenderedImage, width: u32, height: u32) -> RenderedImage {
    let instances = image.instances.as_ref().map(|layers| InstanceImage {
        label: nearest(&layers.label, width, height),
        probability: nearest(&layers.probability, width, height),
        coverage: nearest(&layers.coverage, width, height),
        foreground: nearest(&layers.foreground, width, height),
        entropy: nearest(&layers.entropy, width, height),
    });
    let alpha = interpolate(&image.alpha.map(|value| [*value]), width, height).map(|[value]| *value);
    RenderedImage {
        color: interpolate(&image.color, width, height),
        alpha,
        depth: image.depth.as_ref().map(|depth| nearest(depth, width, height)),
        instances,
    }
}

fn nearest<T: Copy>(grid: &PixelGrid<T>, width: u32, height: u32) -> PixelGrid<T> {
    let source =
        |index: u32, count: u32, of: u32| (u64::from(index) * u64::from(of) / u64::from(count)) as u32;
    let mut pixels = Vec::with_capacity((width * height) as usize);
    for y in 0..height {
        let row = source(y, height, grid.height) * grid.width;
        pixels.extend((0..width).map(|x| grid.pixels[(row + source(x, width, grid.width)) as usize]));
    }
    PixelGrid::from_pixels(width, height, pixels)
}

/// Bilinear, between pixel centres.
fn interpolate<const N: usize>(grid: &PixelGrid<[f32; N]>, width: u32, height: u32) -> PixelGrid<[f32; N]> {
    let at = |index: u32, count: u32, of: u32| {
        let place =
            ((f64::from(index) + 0.5) * f64::from(of) / f64::from(count) - 0.5).clamp(0.0, f64::from(of - 1));
        let low = place.floor();
        (low as u32, (low as u32 + 1).min(of - 1), (place - low) as f32)
    };
    let mut pixels = Vec::with_capacity((width * height) as usize);
    for y in 0..height {
        let (top, bottom, down) = at(y, height, grid.height);
        for x in 0..width {
            let (left, right, along) = at(x, width, grid.width);
            let pixel = |x: u32, y: u32| &grid.pixels[(y * grid.width + x) as usize];
            let (a, b, c, d) =
                (pixel(left, top), pixel(right, top), pixel(left, bottom), pixel(right, bottom));
            pixels.push(std::array::from_fn(|k| {
                let (upper, lower) = (a[k] + (b[k] - a[k]) * along, c[k] + (d[k] - c[k]) * along);
                upper + (lower - upper) * down
            }));
        }
    }
    PixelGrid::from_pixels(width, height, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlarging_keeps_linear_colours_and_whole_labels() {
        let ramp = PixelGrid::from_pixels(4, 1, (0..4).map(|x| [x as f32]).collect());
        let large = interpolate(&ramp, 8, 2);
        let row: Vec<f32> = large.pixels[..8].iter().map(|[value]| *value).collect();
        assert_eq!(row, [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0]);
        assert_eq!(large.pixels[8..], large.pixels[..8]);
        let labels = PixelGrid::from_pixels(2, 1, vec![3u16, 9]);
        assert_eq!(nearest(&labels, 5, 1).pixels, [3, 3, 3, 9, 9]);
        assert_eq!(nearest(&labels, 2, 1), labels);
        // An odd size: half of 5 is rendered with 3.
        assert_eq!(interpolate(&PixelGrid::from_pixels(3, 1, vec![[1.0]; 3]), 5, 1).pixels, [[1.0]; 5]);
    }
}
