//! One step from a frame to its neighbour.

use rayon::prelude::*;

use super::agree::agreed;
use super::belief::Belief;
use super::motion::Motion;
use super::window::Seen;
use crate::plane::Tap;

/// Keeps every class possible when evidence is multiplied.
const FLOOR: f32 = 0.02;

/// Share by which a pixel whose motion is trusted is drawn to its most probable class after every step: without it,
/// beliefs blur from resampling.
const HARDENING: f32 = 0.5;

/// Least sum, in units of 1 / 255, of what a pixel looks like over classes that may be there: below, looks say little.
const LEAST_LOOKS: f32 = 25.0;

/// Rounds in which pixels follow their neighbours.
const ROUNDS: usize = 2;

/// Distance, in pixels of the halved grid, over which a class may appear next to where motion brought it.
const SUPPORT: usize = 2;

/// Inputs of a step besides the belief.
pub(super) struct Step<'a> {
    /// Columns of the frames.
    pub(super) width: usize,
    /// Rows of the frames.
    pub(super) height: usize,
    /// Motion from the known frame.
    pub(super) motion: &'a Motion,
    /// The frame that is stepped to.
    pub(super) seen: &'a Seen,
}

impl Step<'_> {
    /// The belief about the frame that is stepped to: the known one brought along by flow, times what pixels look like,
    /// where classes may only be near where motion brought them; those that the keyframe shows may come back elsewhere
    /// if looks say so. Where motion is not to be trusted (occlusion, or no
    /// structure to follow), looks alone speak, and the belief becomes less reliable. At last, pixels follow their
    /// neighbours of the same colour.
    pub(super) fn take(&self, known: &Belief) -> Belief {
        let (width, classes) = (self.width, known.classes);
        let pixels = width * self.height;
        let mut moved = vec![0.0_f32; pixels * classes];
        let mut reliability = vec![0.0_f32; pixels];
        moved.par_chunks_mut(width * classes).zip(reliability.par_chunks_mut(width)).enumerate().for_each(
            |(y, (moved, reliability))| {
                for x in 0..width {
                    let at = y * width + x;
                    let (u, v) = (self.motion.back.u.data[at], self.motion.back.v.data[at]);
                    let tap = Tap::new(width, self.height, x as f32 + u, y as f32 + v);
                    reliability[x] = self.motion.trust[at] * tap.of(&known.reliability);
                    tap.of_rows(&known.shares, classes, &mut moved[x * classes..(x + 1) * classes]);
                }
            },
        );
        let anywhere: Vec<f32> = known.shown.iter().map(|shown| if *shown { FLOOR } else { 0.0 }).collect();
        let support = Support::new(&moved, width, self.height, classes);
        moved.par_chunks_mut(width * classes).enumerate().for_each(|(y, row)| {
            let mut near = vec![0.0_f32; classes];
            let mut looks = vec![0.0_f32; classes];
            for x in 0..width {
                let at = y * width + x;
                support.at(x, y, &mut near);
                // What is unlabelled may be anywhere.
                near[0] = 1.0;
                let seen = &self.seen.looks[at * classes..(at + 1) * classes];
                let mut sum = 0.0;
                for (((look, seen), near), anywhere) in looks.iter_mut().zip(seen).zip(&near).zip(&anywhere) {
                    *look = f32::from(*seen) * (near + anywhere);
                    sum += *look;
                }
                let scale = 1.0 / sum.max(LEAST_LOOKS);
                combine(&mut row[x * classes..(x + 1) * classes], &looks, scale, self.motion.trust[at]);
            }
        });
        for _ in 0..ROUNDS {
            moved = agreed(&moved, classes, &self.seen.lab);
        }
        Belief { classes, shares: moved, reliability, shown: known.shown.clone() }
    }
}

/// The normalised geometric mean of what motion, as far as it is trusted, and looks say, drawn to its most probable class.
fn combine(shares: &mut [f32], looks: &[f32], scale: f32, trust: f32) {
    let unknown = (1.0 - trust) / shares.len() as f32;
    let mut sum = 0.0;
    let (mut best, mut most) = (0, 0.0);
    for (class, (share, look)) in shares.iter_mut().zip(looks).enumerate() {
        *share = ((trust * *share + unknown + FLOOR) * (look * scale + FLOOR)).sqrt();
        sum += *share;
        if *share > most {
            (best, most) = (class, *share);
        }
    }
    let hardening = HARDENING * trust;
    let scale = (1.0 - hardening) / sum;
    shares.iter_mut().for_each(|share| *share *= scale);
    shares[best] += hardening;
}

/// Where classes may be: their shares widened, on a grid of half the size.
struct Support {
    width: usize,
    height: usize,
    classes: usize,
    /// `[pixels][classes]`.
    shares: Vec<f32>,
}

impl Support {
    fn new(shares: &[f32], width: usize, height: usize, classes: usize) -> Self {
        let (half_width, half_height) = (width.div_ceil(2), height.div_ceil(2));
        let row_of = |y: usize| &shares[y * width * classes..(y + 1) * width * classes];
        let mut across = vec![0.0_f32; half_width * half_height * classes];
        across.par_chunks_mut(half_width * classes).enumerate().for_each(|(y, out)| {
            // The largest of 2 x 2, then of the pixels around.
            let rows = [row_of(2 * y), row_of((2 * y + 1).min(height - 1))];
            let mut small = vec![0.0_f32; half_width * classes];
            for x in 0..half_width {
                for column in [2 * x, (2 * x + 1).min(width - 1)] {
                    for row in rows {
                        largest(&mut small[x * classes..(x + 1) * classes], &row[column * classes..]);
                    }
                }
            }
            for x in 0..half_width {
                let near = x.saturating_sub(SUPPORT)..(x + SUPPORT + 1).min(half_width);
                for other in near {
                    largest(&mut out[x * classes..(x + 1) * classes], &small[other * classes..]);
                }
            }
        });
        let mut down = vec![0.0_f32; across.len()];
        down.par_chunks_mut(half_width * classes).enumerate().for_each(|(y, out)| {
            for other in y.saturating_sub(SUPPORT)..(y + SUPPORT + 1).min(half_height) {
                largest(out, &across[other * half_width * classes..]);
            }
        });
        // A soft edge: (1 2 1) / 4 along both axes.
        let smooth = |from: &[f32]| {
            let mut out = vec![0.0_f32; from.len()];
            out.par_chunks_mut(half_width * classes).enumerate().for_each(|(y, out)| {
                let row = |y: usize| &from[y * half_width * classes..(y + 1) * half_width * classes];
                let rows = [row(y.saturating_sub(1)), row(y), row((y + 1).min(half_height - 1))];
                for x in 0..half_width {
                    let columns = [x.saturating_sub(1), x, (x + 1).min(half_width - 1)];
                    for (row, down) in rows.iter().zip([0.25, 0.5, 0.25]) {
                        for (column, along) in columns.iter().zip([0.25, 0.5, 0.25]) {
                            let values = &row[column * classes..(column + 1) * classes];
                            for (out, value) in out[x * classes..(x + 1) * classes].iter_mut().zip(values) {
                                *out += down * along * value;
                            }
                        }
                    }
                }
            });
            out
        };
        Self { width: half_width, height: half_height, classes, shares: smooth(&down) }
    }

    /// Support of every class at a pixel of the full grid.
    fn at(&self, x: usize, y: usize, out: &mut [f32]) {
        let (x, y) = ((x as f32 + 0.5) / 2.0 - 0.5, (y as f32 + 0.5) / 2.0 - 0.5);
        Tap::new(self.width, self.height, x, y).of_rows(&self.shares, self.classes, out);
    }
}

/// Raises values to those of another row.
fn largest(values: &mut [f32], others: &[f32]) {
    for (value, other) in values.iter_mut().zip(others) {
        *value = value.max(*other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_decide_where_motion_is_not_trusted() {
        let combined = |trust: f32| {
            let mut shares = [0.9, 0.1];
            combine(&mut shares, &[0.3, 0.7], 1.0, trust);
            shares
        };
        assert!(combined(1.0)[0] > 0.75, "{:?}", combined(1.0));
        assert!(combined(0.0)[1] > 0.55, "{:?}", combined(0.0));
    }
}
