//! Pixels that follow their neighbours of the same colour.

use rayon::prelude::*;

use crate::plane::Plane;

/// Difference of colour at which a neighbour counts by exp(-1/2), in the units of [`Picture::lab`].
///
/// [`Picture::lab`]: crate::picture::Picture::lab
const UNLIKE: f32 = 12.0;

/// Share of a neighbour that counts whatever its colour is.
const ANYWAY: f32 = 0.01;

/// Keeps every class possible when evidence is multiplied.
const FLOOR: f32 = 0.01;

/// Probability from which a pixel is sure of its class. Where those around are sure of the same, they are taken to
/// say what it says.
const SURE: f32 = 0.8;

/// Probabilities of classes, `[pixels][classes]`, each multiplied by the mean of those around, weighed by how alike their
/// colours are, and normalised: one round of a mean field. Source: Kraehenbuehl and Koltun, "Efficient Inference in Fully
/// Connected CRFs with Gaussian Edge Potentials", NIPS 2011, equation 4, here between neighbours alone.
pub(super) fn agreed(shares: &[f32], classes: usize, lab: &[Plane; 3]) -> Vec<f32> {
    let (width, height) = (lab[0].width, lab[0].height);
    let surest = |shares: &[f32]| shares.iter().position(|share| *share > SURE);
    let sure: Vec<Option<usize>> = shares.par_chunks(classes).map(surest).collect();
    let mut out = shares.to_vec();
    out.par_chunks_mut(width * classes).enumerate().for_each(|(y, row)| {
        let mut around = vec![0.0_f32; classes];
        for (x, own) in row.chunks_exact_mut(classes).enumerate() {
            let at = y * width + x;
            let columns = x.saturating_sub(1)..(x + 2).min(width);
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let alike =
                |row: usize| sure[row * width..][columns.clone()].iter().all(|other| *other == sure[at]);
            if sure[at].is_some() && rows.clone().all(alike) {
                // Those around say the same.
                around.copy_from_slice(own);
                multiply(own, &around, 1.0);
                continue;
            }
            around.fill(0.0);
            let mut total = 0.0_f32;
            for other_y in rows {
                for other_x in columns.clone() {
                    let other = other_y * width + other_x;
                    if other == at {
                        continue;
                    }
                    let square = |plane: &Plane| ((plane.data[at] - plane.data[other]) / UNLIKE).powi(2);
                    let weight = (-0.5 * lab.iter().map(square).sum::<f32>()).exp() + ANYWAY;
                    total += weight;
                    for (sum, share) in around.iter_mut().zip(&shares[other * classes..]) {
                        *sum += weight * share;
                    }
                }
            }
            multiply(own, &around, total.max(ANYWAY));
        }
    });
    out
}

/// Multiplies probabilities by those around, given as sums over neighbours of a total weight, and normalises them.
fn multiply(own: &mut [f32], around: &[f32], total: f32) {
    let mut sum = 0.0;
    for (share, around) in own.iter_mut().zip(around) {
        *share *= around / total + FLOOR;
        sum += *share;
    }
    own.iter_mut().for_each(|share| *share /= sum);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_in_doubt_follows_what_has_its_colour() {
        // A row of two colours: what is in doubt next to the border belongs to its own side; what is sure among its
        // like becomes surer.
        let lab =
            [0; 3].map(|_| Plane { width: 6, height: 1, data: vec![10.0, 10.0, 10.0, 80.0, 80.0, 80.0] });
        let shares = [[0.9, 0.1], [0.9, 0.1], [0.45, 0.55], [0.55, 0.45], [0.1, 0.9], [0.1, 0.9]].concat();
        let found = agreed(&shares, 2, &lab);
        assert!(found[4] > 0.6, "{found:?}");
        assert!(found[7] > 0.6, "{found:?}");
        assert!(found[11] > 0.95, "{found:?}");
        for pixel in found.chunks(2) {
            assert!((pixel.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{found:?}");
        }
        // A single pixel keeps what it believes.
        let one = [0; 3].map(|_| Plane::filled(1, 1, 5.0));
        let alone = agreed(&[0.3, 0.7], 2, &one);
        assert!((alone[0] - 0.3).abs() < 1e-6, "{alone:?}");
    }
}
