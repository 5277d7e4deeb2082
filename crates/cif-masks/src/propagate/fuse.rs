//! Ids and confidence out of beliefs.

use cif_geometry::PixelGrid;
use rayon::prelude::*;

use super::Mask;
use super::agree::agreed;
use super::belief::Belief;
use crate::plane::{Plane, Tap};

/// Keeps a way that is unreliable or far in time in play.
const FLOOR: f32 = 0.02;

/// Blends beliefs about a frame, each weighed by its share and by its reliability at the pixel, lets pixels follow their
/// neighbours of the same colour (`lab`), and takes the most probable class of every pixel of the image. Its confidence
/// is its probability before neighbours were asked.
pub(super) fn mask(
    ways: &[(f32, &Belief)],
    lab: &[Plane; 3],
    ids: &[u16],
    (width, height): (usize, usize),
    full: (usize, usize),
) -> Mask {
    let classes = ids.len();
    let mut shares = vec![0.0_f32; width * height * classes];
    shares.par_chunks_mut(classes).enumerate().for_each(|(pixel, shares)| {
        let mut sum = 0.0;
        for (share, belief) in ways {
            let weight = (share + FLOOR) * (belief.reliability[pixel] + FLOOR);
            sum += weight;
            let theirs = &belief.shares[pixel * classes..(pixel + 1) * classes];
            shares.iter_mut().zip(theirs).for_each(|(share, other)| *share += weight * other);
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
