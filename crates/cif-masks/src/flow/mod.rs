//! Dense optical flow by inverse search.
//!
//! Source: Kroeger, Timofte, Dai, Van Gool, "Fast Optical Flow using Dense Inverse Search", ECCV 2016 (DIS). Coarse to
//! fine: on every level, patches on a grid are aligned by inverse compositional Gauss-Newton ([`patches`]), their
//! displacements are blended into a dense field ([`dense`]), and the field is refined by a few rounds of a robust
//! variational method ([`refine`]).

mod dense;
mod patches;
mod refine;

use crate::plane::Plane;

/// Smallest side of the coarsest level, pixels.
const COARSEST_SIDE: usize = 20;

/// A displacement per pixel: pixel (x, y) of the first image shows what lies at (x + u, y + v) in the second.
#[derive(Clone, Debug, PartialEq)]
pub struct Flow {
    /// Displacement to the right, pixels.
    pub u: Plane,
    /// Displacement downwards, pixels.
    pub v: Plane,
}

impl Flow {
    fn zero(width: usize, height: usize) -> Self {
        Self { u: Plane::filled(width, height, 0.0), v: Plane::filled(width, height, 0.0) }
    }

    /// The same motion in pixels of a grid of another size.
    fn resized(&self, width: usize, height: usize) -> Self {
        let scale = |plane: &Plane, factor: f32| {
            let mut plane = plane.resized(width, height);
            plane.data.iter_mut().for_each(|value| *value *= factor);
            plane
        };
        Self {
            u: scale(&self.u, width as f32 / self.u.width as f32),
            v: scale(&self.v, height as f32 / self.v.height as f32),
        }
    }
}

/// An image in ever smaller copies, finest first, with the gradients that the search needs. One is made per image and
/// used for all flows from and to it.
#[derive(Clone, Debug)]
pub struct Pyramid {
    levels: Vec<Level>,
}

/// One level: brightness and its derivatives along x and y.
#[derive(Clone, Debug)]
struct Level {
    brightness: Plane,
    dx: Plane,
    dy: Plane,
}

impl Pyramid {
    /// Builds the levels of an image of brightness, 0 to 255.
    #[must_use]
    pub fn new(brightness: Plane) -> Self {
        let mut levels = Vec::new();
        let mut plane = brightness;
        loop {
            let next = (plane.width.min(plane.height) >= 2 * COARSEST_SIDE).then(|| plane.halved());
            let (dx, dy) = derivatives(&plane);
            levels.push(Level { brightness: plane, dx, dy });
            match next {
                Some(half) => plane = half,
                None => return Self { levels },
            }
        }
    }
}

/// Central differences; one-sided at the border.
fn derivatives(plane: &Plane) -> (Plane, Plane) {
    let (width, height) = (plane.width, plane.height);
    let mut dx = Plane::filled(width, height, 0.0);
    let mut dy = Plane::filled(width, height, 0.0);
    for y in 0..height {
        let row = plane.row(y as isize);
        let out = &mut dx.data[y * width..(y + 1) * width];
        for x in 0..width {
            out[x] = 0.5 * (row[(x + 1).min(width - 1)] - row[x.saturating_sub(1)]);
        }
        let (above, below) = (plane.row(y as isize - 1), plane.row(y as isize + 1));
        for (out, (below, above)) in
            dy.data[y * width..(y + 1) * width].iter_mut().zip(below.iter().zip(above))
        {
            *out = 0.5 * (below - above);
        }
    }
    (dx, dy)
}

/// The flow from the first image to the second.
///
/// # Panics
/// When the images differ in size.
#[must_use]
pub fn flow(first: &Pyramid, second: &Pyramid) -> Flow {
    let size = |pyramid: &Pyramid| {
        let finest = &pyramid.levels[0].brightness;
        (finest.width, finest.height)
    };
    assert_eq!(size(first), size(second), "flow between images of different sizes");
    let mut field: Option<Flow> = None;
    for (a, b) in first.levels.iter().zip(&second.levels).rev() {
        let (width, height) = (a.brightness.width, a.brightness.height);
        let start = match &field {
            Some(coarse) => coarse.resized(width, height),
            None => Flow::zero(width, height),
        };
        let found = patches::search(a, &b.brightness, &start);
        let mut level = dense::blend(a, &b.brightness, &found, start);
        refine::refine(a, b, &mut level);
        field = Some(level);
    }
    field.unwrap_or_else(|| Flow::zero(size(first).0, size(first).1))
}
