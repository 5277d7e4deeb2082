//! Ids and confidence out of beliefs.

use cif_geometry::PixelGrid;
use rayon::prelude::*;

use super::agree::agreed;
use super::belief::Belief;
use super::clip::Mask;
use crate::plane::{Plane, Tap};

/// Keeps a belief that is unreliable or far in time in play.
const FLOOR: f32 = 0.02;

/// Blends beliefs about a frame, each weighed by its share and by its reliability at the pixel, lets pixels follow their
/// neighbours of the same colour (`lab`), and takes the most probable class of every pixel of the image. Its confidence
/// is its probability before neighbours were asked.
pub(super) fn mask(
    directions: &[(f32, &Belief)],
    lab: &[Plane; 3],
    ids: &[u16],
    (width, height): (usize, usize),
    full: (usize, usize),
) -> Mask {
    let classes = ids.len();
    let mut shares = vec![0.0_f32; width * height * classes];
    shares.par_chunks_mut(classes).enumerate().for_each(|(pixel, shares)| {
        let mut sum = 0.0;
        for (k, (share, belief)) in directions.iter().enumerate() {
            let weight = (share + FLOOR) * (belief.reliability[pixel] + FLOOR);
            sum += weight;
            let other = directions.get(1 - k).map_or(*belief, |(_, other)| *other);
            add_belief(shares, weight, belief, other, pixel);
        }
        shares.iter_mut().for_each(|share| *share /= sum);
    });
    let among = agreed(&shares, classes, lab);
    // Neighbours that share a mistake make it no surer: they settle the class, not its probability.
    let with_confidence = |among: &[f32], shares: &[f32]| {
        let class = most_probable(among);
        (ids[class], (shares[class] * 255.0 + 0.5) as u8)
    };
    let enlarged = (width, height) != full;
    let (full_width, full_height) = full;
    let step = (width as f32 / full_width as f32, height as f32 / full_height as f32);
    let pixels: Vec<(u16, u8)> = (0..full_width * full_height)
        .into_par_iter()
        .map_init(
            || [vec![0.0_f32; classes], vec![0.0_f32; classes]],
            |[among_sum, shares_sum], pixel| {
                if !enlarged {
                    let row = pixel * classes..(pixel + 1) * classes;
                    return with_confidence(&among[row.clone()], &shares[row]);
                }
                let x = ((pixel % full_width) as f32 + 0.5) * step.0 - 0.5;
                let y = ((pixel / full_width) as f32 + 0.5) * step.1 - 0.5;
                let tap = Tap::new(width, height, x, y);
                tap.of_rows(&among, classes, among_sum);
                tap.of_rows(&shares, classes, shares_sum);
                with_confidence(among_sum, shares_sum)
            },
        )
        .collect();
    let (found, confidence) = pixels.into_iter().unzip();
    let (width, height) = (full_width as u32, full_height as u32);
    Mask {
        ids: PixelGrid::from_pixels(width, height, found),
        confidence: PixelGrid::from_pixels(width, height, confidence),
    }
}

/// Adds a belief about a pixel to weighted sums of shares. The belief from a keyframe that does not show an object does
/// not know where that object is: as far as it is not reliable, the `other` one decides.
fn add_belief(sums: &mut [f32], weight: f32, belief: &Belief, other: &Belief, pixel: usize) {
    let row = pixel * belief.classes..(pixel + 1) * belief.classes;
    let (own, other) = (&belief.shares[row.clone()], &other.shares[row]);
    let open = 1.0 - belief.reliability[pixel];
    let unknown: f32 =
        belief.shown.iter().zip(other).map(|(shown, share)| if *shown { 0.0 } else { *share }).sum();
    for (((sum, own), other), shown) in sums.iter_mut().zip(own).zip(other).zip(&belief.shown) {
        let taken = if *shown { 0.0 } else { open * other };
        *sum += weight * ((1.0 - open * unknown) * own + taken);
    }
}

/// The class with the largest share, of equal ones the first.
fn most_probable(shares: &[f32]) -> usize {
    let mut best = 0;
    for (class, share) in shares.iter().enumerate().skip(1) {
        if *share > shares[best] {
            best = class;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_keyframe_without_an_object_does_not_deny_it_where_its_way_is_unreliable() {
        // The first belief has never seen class 2, of which the second is fairly sure.
        let belief = |shares: [f32; 3], reliability: f32, sees: bool| Belief {
            classes: 3,
            shares: shares.to_vec(),
            reliability: vec![reliability],
            shown: vec![true, true, sees],
        };
        let fused = |reliability: f32| {
            let first = belief([0.8, 0.2, 0.0], reliability, false);
            let second = belief([0.4, 0.0, 0.6], 0.0, true);
            let mut sums = [0.0; 3];
            add_belief(&mut sums, 0.9, &first, &second, 0);
            add_belief(&mut sums, 0.1, &second, &first, 0);
            sums
        };
        let close = |found: [f32; 3], expected: [f32; 3]| {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        };
        close(fused(0.0), [0.9 * 0.32 + 0.1 * 0.4, 0.9 * 0.08, 0.6]);
        // Where its belief is reliable, it is not there.
        close(fused(1.0), [0.9 * 0.8 + 0.1 * 0.4, 0.9 * 0.2, 0.1 * 0.6]);
    }
}
