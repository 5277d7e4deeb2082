//! Motion from a frame to its neighbour.

use crate::flow::Flow;
use crate::plane::{Plane, Tap};

/// Disagreement of forward and backward flow at which motion is trusted by exp(-1/2), pixels.
const DISAGREEMENT: f32 = 1.0;

/// Change of colour along the flow at which motion is trusted by exp(-1/2), in the units of
/// [`Picture::lab`](crate::picture::Picture::lab).
const RECOLORED: f32 = 25.0;

/// Motion from a frame to one of its neighbours.
pub(super) struct Motion {
    /// Flow from the frame that is stepped to, back to the one that is known.
    pub(super) back: Flow,
    /// Per pixel of the frame that is stepped to, 0 to 1: how well the flow is to be trusted.
    pub(super) trust: Vec<f32>,
}

impl Motion {
    /// `back` leads from the pixels of `to` into `from`, `forth` from there. What comes into sight has nothing to come
    /// from: the flows contradict each other, or lead to something of another colour.
    pub(super) fn new(back: Flow, forth: &Flow, to: &[Plane; 3], from: &[Plane; 3]) -> Self {
        let (width, height) = (back.u.width, back.u.height);
        let trust = (0..width * height).map(|at| {
            let (u, v) = (back.u.data[at], back.v.data[at]);
            let tap = Tap::new(width, height, (at % width) as f32 + u, (at / width) as f32 + v);
            let (du, dv) = (u + tap.of(&forth.u.data), v + tap.of(&forth.v.data));
            let mut square = (du * du + dv * dv) / (DISAGREEMENT * DISAGREEMENT);
            for (to, from) in to.iter().zip(from) {
                square += ((to.data[at] - tap.of(&from.data)) / RECOLORED).powi(2);
            }
            (-0.5 * square).exp()
        });
        Self { trust: trust.collect(), back }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flow_to_another_colour_is_not_trusted() {
        // Flows that agree, over a pixel that changes its colour and one that keeps it.
        let still = || Flow { u: Plane::filled(2, 1, 0.0), v: Plane::filled(2, 1, 0.0) };
        let lab = |first: f32| [0; 3].map(|_| Plane { width: 2, height: 1, data: vec![first, 40.0] });
        let trust = Motion::new(still(), &still(), &lab(90.0), &lab(40.0)).trust;
        assert!(trust[0] < 0.05 && trust[1] > 0.99, "{trust:?}");
    }
}
