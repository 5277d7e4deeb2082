//! Pixels that cannot be of what stands around them.
//!
//! Unlabelled pixels mostly stand still, and move in the image as their surroundings do. A pixel that has another
//! colour than what was, and than what will be, where the motion around it leads, is of something that passes in front.
//! It speaks for objects whose own motion cannot be followed: that roll, or come back from behind others.

use rayon::prelude::*;

use super::motion::Motion;
use crate::flow::Flow;
use crate::plane::{Plane, Tap};

/// Frames that are looked back and ahead at most: an object should have left its place.
const FAR: usize = 6;

/// Frames that are looked back and ahead at the least.
const NEAR: usize = 2;

/// Trust from which the motion of a pixel speaks for itself.
const TRUSTED: f32 = 0.9;

/// Change of colour at which a pixel is unlabelled by about exp(-1/2) as much, in the units of [`Picture::lab`].
///
/// [`Picture::lab`]: crate::picture::Picture::lab
const RECOLORED: f32 = 30.0;

/// Square of the share of it from which it counts.
const NOTED: f32 = 0.01;

/// Least factor.
const FLOOR: f32 = 0.1;

/// Factors of the evidence that pixels of some frames in a row are unlabelled, by the motion between neighbours and the
/// colours of each.
pub(super) fn factors(motions: &[[Motion; 2]], lab: &[&[Plane; 3]]) -> Vec<Vec<f32>> {
    let around: Vec<[Flow; 2]> = motions
        .par_iter()
        .map(|pair| pair.each_ref().map(|motion| filled(&motion.back, &motion.trust)))
        .collect();
    let of_frame = |frame: usize| {
        let pixels = lab[frame][0].data.len();
        let (before, after) = (FAR.min(frame), FAR.min(lab.len() - 1 - frame));
        if before < NEAR || after < NEAR {
            return vec![1.0; pixels];
        }
        let back: Vec<&Flow> = (0..before).map(|k| &around[frame - 1 - k][0]).collect();
        let ahead: Vec<&Flow> = (0..after).map(|k| &around[frame + k][1]).collect();
        let factor = |pixel: usize| {
            if motions[frame - 1][0].trust[pixel].min(motions[frame][1].trust[pixel]) > TRUSTED {
                return 1.0;
            }
            let mut square = change(&back, lab[frame], lab[frame - before], pixel);
            if square > NOTED {
                square = square.min(change(&ahead, lab[frame], lab[frame + after], pixel));
            }
            if square <= NOTED {
                return 1.0;
            }
            FLOOR + (1.0 - FLOOR) * (-0.5 * square).exp()
        };
        (0..pixels).map(factor).collect()
    };
    (0..lab.len()).into_par_iter().map(of_frame).collect()
}

/// Square of the least difference of colour between a pixel and those about where motion leads, in units of
/// [`RECOLORED`]; 0 beyond the image.
fn change(motion: &[&Flow], own: &[Plane; 3], other: &[Plane; 3], pixel: usize) -> f32 {
    let (width, height) = (own[0].width, own[0].height);
    let (mut x, mut y) = ((pixel % width) as f32, (pixel / width) as f32);
    for flow in motion {
        let tap = Tap::new(width, height, x, y);
        (x, y) = (x + tap.of(&flow.u.data), y + tap.of(&flow.v.data));
        if !(0.0..width as f32).contains(&x) || !(0.0..height as f32).contains(&y) {
            return 0.0;
        }
    }
    let mut least = f32::INFINITY;
    for (dx, dy) in (-1..2).flat_map(|dy| (-1..2).map(move |dx| (dx as f32, dy as f32))) {
        let tap = Tap::new(width, height, x + dx, y + dy);
        let square = |(own, other): (&Plane, &Plane)| (own.data[pixel] - tap.of(&other.data)).powi(2);
        least = least.min(own.iter().zip(other).map(square).sum());
    }
    least / (RECOLORED * RECOLORED)
}

/// A flow that is filled in from around where it is not trusted: means of ever larger blocks, each weighed by the square
/// of trust. Source: Gortler, Grzeszczuk, Szeliski, Cohen, "The Lumigraph", SIGGRAPH 1996, section 3.4 (pull, push).
fn filled(flow: &Flow, trust: &[f32]) -> Flow {
    let (width, height) = (flow.u.width, flow.u.height);
    let weighed = |plane: &Plane| Plane {
        data: plane.data.iter().zip(trust).map(|(value, trust)| trust * trust * value).collect(),
        ..*plane
    };
    let mut levels = vec![[weighed(&flow.u), weighed(&flow.v), weighed(&Plane::filled(width, height, 1.0))]];
    while levels[levels.len() - 1][2].data.len() > 1 {
        let mut next = levels[levels.len() - 1].each_ref().map(Plane::halved);
        for k in 0..next[2].data.len() {
            // Sums of four, of a weight of one at the most.
            let scale = 4.0 / (4.0 * next[2].data[k]).max(1.0);
            next.iter_mut().for_each(|plane| plane.data[k] *= scale);
        }
        levels.push(next);
    }
    let mut field = [(); 2].map(|()| Plane::filled(1, 1, 0.0));
    for level in levels.iter().rev() {
        let weight = &level[2];
        for (plane, own) in field.iter_mut().zip(level) {
            *plane = plane.resized(weight.width, weight.height);
            for ((value, own), weight) in plane.data.iter_mut().zip(&own.data).zip(&weight.data) {
                *value = own + (1.0 - weight) * *value;
            }
        }
    }
    let [u, v] = field;
    Flow { u, v }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 24;

    fn still() -> Flow {
        Flow { u: Plane::filled(SIDE, SIDE, 0.0), v: Plane::filled(SIDE, SIDE, 0.0) }
    }

    #[test]
    fn flow_is_filled_in_from_around() {
        // It leads two pixels to the right but for a hole, in which it is wild.
        let hole = |x: usize, y: usize| (9..13).contains(&x) && (9..13).contains(&y);
        let u = Plane::from_fn(SIDE, SIDE, |x, y| if hole(x, y) { -50.0 } else { 2.0 });
        let trust = Plane::from_fn(SIDE, SIDE, |x, y| f32::from(u8::from(!hole(x, y))));
        let found = filled(&Flow { u, ..still() }, &trust.data);
        assert!(found.u.data.iter().all(|value| (value - 2.0).abs() < 1e-3), "{:?}", found.u.data);
        assert!(found.v.data.iter().all(|value| *value == 0.0));
    }

    #[test]
    fn what_passes_is_not_of_what_stands_behind_it() {
        // A bright square of four pixels passes in front of a dark wall, three pixels a frame, and is not followed.
        let shows = |frame: usize, x: usize, y: usize| {
            (3 * frame..3 * frame + 4).contains(&x) && (10..14).contains(&y)
        };
        let bright =
            |frame: usize| Plane::from_fn(SIDE, SIDE, |x, y| 80.0 * f32::from(u8::from(shows(frame, x, y))));
        let lab: Vec<[Plane; 3]> = (0..5).map(|frame| [0; 3].map(|_| bright(frame))).collect();
        let motion = |frame: usize| Motion {
            back: still(),
            trust: Plane::from_fn(SIDE, SIDE, |x, y| f32::from(u8::from(!shows(frame, x, y)))).data,
        };
        let motions: Vec<[Motion; 2]> = (0..4).map(|k| [motion(k + 1), motion(k)]).collect();
        let found = factors(&motions, &lab.iter().collect::<Vec<_>>());
        for (pixel, factor) in found[2].iter().enumerate() {
            let passes = shows(2, pixel % SIDE, pixel / SIDE);
            assert!(if passes { *factor < 0.2 } else { *factor > 0.9 }, "pixel {pixel}: {factor}");
        }
        // The ends see one side only.
        assert!(found[0].iter().chain(&found[4]).all(|factor| *factor == 1.0));
    }
}
