//! Features of pixels.

use crate::picture::Picture;
use crate::plane::Plane;

/// Numbers per pixel.
pub(crate) const DIMENSIONS: usize = 11;

/// Standard deviations of the blurs of colour, pixels.
const BLURS: [f32; 2] = [1.5, 4.0];

/// Standard deviation of the blur of gradients, pixels.
const GRADIENT_BLUR: f32 = 2.0;

/// Features of every pixel of an image: L*a*b* as it is and blurred twice, and the blurred magnitudes of the
/// derivatives of L* along x and y.
pub(crate) struct Features {
    /// `[pixels]`, row-major.
    pub(crate) values: Vec<[f32; DIMENSIONS]>,
}

impl Features {
    pub(crate) fn new(picture: &Picture) -> Self {
        let lightness = &picture.lab[0];
        let (width, height) = (lightness.width, lightness.height);
        let magnitude = |dx: isize, dy: isize| {
            let at = |x: isize, y: isize| lightness.row(y)[x.clamp(0, width as isize - 1) as usize];
            Plane::from_fn(width, height, |x, y| {
                let (x, y) = (x as isize, y as isize);
                (at(x + dx, y + dy) - at(x - dx, y - dy)).abs()
            })
            .blurred(GRADIENT_BLUR)
        };
        let mut planes = Vec::with_capacity(DIMENSIONS);
        planes.extend(picture.lab.iter().cloned());
        for sigma in BLURS {
            planes.extend(picture.lab.iter().map(|plane| plane.blurred(sigma)));
        }
        planes.extend([magnitude(1, 0), magnitude(0, 1)]);
        let values = (0..width * height).map(|k| std::array::from_fn(|d| planes[d].data[k]));
        Self { values: values.collect() }
    }
}
