//! An image on several scales.

use crate::plane::Plane;

/// Smallest side of the coarsest level, pixels.
const COARSEST_SIDE: usize = 20;

/// An image in ever smaller copies, finest first, with the gradients that the search needs. One is made per image and
/// used for all flows from and to it.
#[derive(Clone, Debug)]
pub struct Pyramid {
    pub(super) levels: Vec<Level>,
}

/// One level: brightness and its derivatives along x and y.
#[derive(Clone, Debug)]
pub(super) struct Level {
    pub(super) brightness: Plane,
    pub(super) dx: Plane,
    pub(super) dy: Plane,
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
pub(super) fn derivatives(plane: &Plane) -> (Plane, Plane) {
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
