//! Outlines of masks that are off by some pixels, as those of trackers are, moved to where the colours change.
//!
//! Near an outline the labels of a pixel's surroundings vote, by how near they are and how alike in colour (a joint
//! bilateral filter of labels, after Petschnigg et al., "Digital photography with flash and no-flash image pairs",
//! SIGGRAPH 2004, applied to the mode instead of the mean). Pixels away from all outlines count most, and a label that
//! has none of them nearby, that of a thin thing, keeps its pixels. Exact masks would lose a little at pixels that
//! show two objects, so that outlines are only moved where many of them are clearly wrong ([`Doubt`]).

use cif_geometry::PixelGrid;

/// Columns of an image by pixel of the distance from an outline within which labels may change, and its limits.
const COLUMNS: u32 = 128;
const NEAR: [u32; 2] = [2, 4];

/// Reach of votes, and their standard deviation, of that distance.
const REACH: f64 = 2.5;
const SPREAD: f32 = 1.5;

/// Standard deviation of the differences of colours among which votes are cast, of [0, 1].
const ALIKE: f32 = 0.05;

/// Votes of pixels that are near an outline themselves.
const UNSURE: f32 = 0.1;

/// Pixels away from outlines, in reach, without which a label keeps a pixel.
const FEWEST: u32 = 3;

/// Times that labels vote.
const ROUNDS: usize = 2;

/// Share of the votes of two labels, and votes at the smallest distance, from which a pixel is clearly wrong.
const CLEAR: (f32, f32) = (0.8, 3.0);

/// Clearly wrong pixels, of those adjacent to an outline, from which masks are rough. Exact masks of five
/// captures have 0.003 to 0.010 of them, those of a tracker with its errors 0.041 to 0.060.
const ROUGH: f64 = 0.03;

/// Pixels that are clearly wrong, and those adjacent to outlines, of some masks.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Doubt {
    wrong: usize,
    adjacent: usize,
}

impl Doubt {
    /// That of the masks of an image.
    pub(crate) fn of(image: &PixelGrid<[u8; 3]>, labels: &PixelGrid<u16>) -> Self {
        let ballot = Ballot::new(image, labels);
        let wrong =
            ballot.near().filter_map(|[x, y]| ballot.winner(x, y)).filter(|winner| winner.clear).count();
        let is_adjacent = |&[x, y]: &[u32; 2]| ballot.differs(x, y, 1);
        Self { wrong, adjacent: ballot.near().filter(is_adjacent).count() }
    }

    /// That of several images.
    pub(crate) fn sum(all: impl Iterator<Item = Self>) -> Self {
        all.fold(Self::default(), |a, b| Self { wrong: a.wrong + b.wrong, adjacent: a.adjacent + b.adjacent })
    }

    /// True where so many are wrong that outlines are better moved.
    pub(crate) fn is_rough(&self) -> bool {
        self.wrong as f64 > ROUGH * self.adjacent as f64
    }
}

/// The masks of an image with their outlines where colours change.
pub(crate) fn moved(image: &PixelGrid<[u8; 3]>, labels: &PixelGrid<u16>) -> PixelGrid<u16> {
    let mut labels = labels.clone();
    for _ in 0..ROUNDS {
        let ballot = Ballot::new(image, &labels);
        let won: Vec<(usize, u16)> = ballot
            .near()
            .filter_map(|[x, y]| Some(((y * labels.width + x) as usize, ballot.winner(x, y)?.label)))
            .collect();
        won.into_iter().for_each(|(pixel, label)| labels.pixels[pixel] = label);
    }
    labels
}

/// The label that has most votes at a pixel, another than its own.
struct Winner {
    label: u16,
    /// True where it has most of them by far.
    clear: bool,
}

/// Pixels that vote.
struct Ballot<'a> {
    image: &'a PixelGrid<[u8; 3]>,
    labels: &'a PixelGrid<u16>,
    /// True of pixels near an outline.
    near: Vec<bool>,
    reach: i64,
    /// Votes by distance along rows and columns: `[rows][columns]` of a quarter.
    by_distance: Vec<Vec<f32>>,
    /// Votes that count as many, for this distance.
    many: f32,
}

impl<'a> Ballot<'a> {
    fn new(image: &'a PixelGrid<[u8; 3]>, labels: &'a PixelGrid<u16>) -> Self {
        let distance = (labels.width / COLUMNS).clamp(NEAR[0], NEAR[1]);
        let reach = (REACH * f64::from(distance)) as i64;
        let spread = SPREAD * distance as f32;
        let vote = |dx: i64, dy: i64| (-((dx * dx + dy * dy) as f32) / (2.0 * spread * spread)).exp();
        let by_distance = (0..=reach).map(|dy| (0..=reach).map(|dx| vote(dx, dy)).collect()).collect();
        let ratio = distance as f32 / NEAR[0] as f32;
        let mut ballot =
            Self { image, labels, near: Vec::new(), reach, by_distance, many: CLEAR.1 * ratio * ratio };
        let (width, height) = (labels.width, labels.height);
        ballot.near = (0..height)
            .flat_map(|y| (0..width).map(move |x| [x, y]))
            .map(|[x, y]| ballot.differs(x, y, distance))
            .collect();
        ballot
    }

    /// Pixels near an outline.
    fn near(&self) -> impl Iterator<Item = [u32; 2]> + '_ {
        let width = self.labels.width;
        let at = move |pixel: usize| [pixel as u32 % width, pixel as u32 / width];
        self.near.iter().enumerate().filter(|(_, near)| **near).map(move |(pixel, _)| at(pixel))
    }

    /// True where a pixel within a distance has another label.
    fn differs(&self, x: u32, y: u32, distance: u32) -> bool {
        let own = self.labels.at(x, y);
        let columns = x.saturating_sub(distance)..(x + distance + 1).min(self.labels.width);
        (y.saturating_sub(distance)..(y + distance + 1).min(self.labels.height))
            .any(|y| columns.clone().any(|x| self.labels.at(x, y) != own))
    }

    /// The winner at a pixel; `None` where that is its own label, which may have no pixel away from outlines nearby.
    fn winner(&self, x: u32, y: u32) -> Option<Winner> {
        let (own, color) = (*self.labels.at(x, y), self.image.at(x, y));
        let (mut votes, mut sure): (Vec<(u16, f32)>, u32) = (Vec::new(), 0);
        let range = |at: u32, size: u32| {
            (i64::from(at) - self.reach).max(0)..(i64::from(at) + self.reach + 1).min(i64::from(size))
        };
        for row in range(y, self.labels.height) {
            let by_column = &self.by_distance[row.abs_diff(i64::from(y)) as usize];
            for column in range(x, self.labels.width) {
                let pixel = row as usize * self.labels.width as usize + column as usize;
                let (label, near) = (self.labels.pixels[pixel], self.near[pixel]);
                sure += u32::from(label == own && !near);
                let apart: i32 = color
                    .iter()
                    .zip(&self.image.pixels[pixel])
                    .map(|(a, b)| (i32::from(*a) - i32::from(*b)).pow(2))
                    .sum();
                let alike = (-(apart as f32) / (2.0 * (255.0 * ALIKE).powi(2))).exp();
                let weight = alike
                    * by_column[column.abs_diff(i64::from(x)) as usize]
                    * if near { UNSURE } else { 1.0 };
                match votes.iter_mut().find(|(of, _)| *of == label) {
                    Some((_, sum)) => *sum += weight,
                    None => votes.push((label, weight)),
                }
            }
        }
        if sure < FEWEST {
            return None;
        }
        let of_own = votes.iter().find(|(label, _)| *label == own).map_or(0.0, |(_, sum)| *sum);
        let (label, most) = votes.into_iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))?;
        let clear = most >= CLEAR.0 * (most + of_own) && most >= self.many;
        (most > of_own).then_some(Winner { label, clear })
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;
    use crate::random::{Purpose, stream};

    const SIZE: u32 = 96;

    /// A disc of the label 1, a bar of two pixels of the label 2 and a ground, with noise in their colours.
    fn scene() -> (PixelGrid<[u8; 3]>, PixelGrid<u16>) {
        let labels = labels(|_| 0.0);
        let mut rng = stream(0, Purpose::Objects, 1);
        let colors = [[90, 120, 80], [170, 90, 60], [60, 60, 160]];
        let image = labels.map(|label| {
            colors[usize::from(*label)].map(|value: u8| value.saturating_add_signed(rng.random_range(-8..=8)))
        });
        (image, labels)
    }

    /// Its labels, with an outline of the disc that is farther out by so much in a direction.
    fn labels(out: impl Fn(f64) -> f64) -> PixelGrid<u16> {
        let label = |x: u32, y: u32| {
            let (dx, dy) = (f64::from(x) + 0.5 - 40.0, f64::from(y) + 0.5 - 48.0);
            match (dx.hypot(dy) < 22.0 + out(dy.atan2(dx)), (80..82).contains(&x)) {
                (true, _) => 1,
                (_, true) => 2,
                _ => 0,
            }
        };
        let pixels = (0..SIZE).flat_map(|y| (0..SIZE).map(move |x| (x, y)));
        PixelGrid::from_pixels(SIZE, SIZE, pixels.map(|(x, y)| label(x, y)).collect())
    }

    fn overlap(a: &PixelGrid<u16>, b: &PixelGrid<u16>, label: u16) -> f64 {
        let both = a.pixels.iter().zip(&b.pixels).map(|(a, b)| (*a == label, *b == label));
        let count = |of: fn((bool, bool)) -> bool| both.clone().filter(|pair| of(*pair)).count() as f64;
        count(|(a, b)| a && b) / count(|(a, b)| a || b)
    }

    #[test]
    fn outlines_go_where_colours_change_and_thin_things_stay() {
        let (image, truth) = scene();
        let rough = labels(|angle| 2.0 * (5.0 * angle).sin());
        let mended = moved(&image, &rough);
        let (before, after) = (overlap(&rough, &truth, 1), overlap(&mended, &truth, 1));
        assert!(before < 0.91 && after > 0.99, "{before} {after}");
        assert_eq!(overlap(&mended, &truth, 2), 1.0);
        assert_eq!(moved(&image, &truth).pixels, truth.pixels, "exact masks of clear colours stay");
    }

    #[test]
    fn where_colours_are_alike_outlines_stay() {
        let rough = labels(|angle| 2.0 * (5.0 * angle).sin());
        let plain = rough.map(|_| [120, 120, 120]);
        let mended = moved(&plain, &rough);
        assert!(overlap(&mended, &rough, 1) > 0.95, "{}", overlap(&mended, &rough, 1));
        assert!(!Doubt::of(&plain, &rough).is_rough());
    }

    #[test]
    fn rough_masks_are_distinguished_from_exact_ones() {
        let (image, truth) = scene();
        assert!(!Doubt::of(&image, &truth).is_rough());
        // Colours of both sides in the pixels of an outline are no doubt.
        let blend = |pixel: usize| {
            let (x, y) = (pixel as u32 % SIZE, pixel as u32 / SIZE);
            let near = |at: u32| at.saturating_sub(1)..(at + 2).min(SIZE);
            let around: Vec<[u8; 3]> =
                near(y).flat_map(|y| near(x).map(move |x| (x, y))).map(|(x, y)| *image.at(x, y)).collect();
            [0, 1, 2].map(|k| {
                (around.iter().map(|color| u32::from(color[k])).sum::<u32>() / around.len() as u32) as u8
            })
        };
        let soft = PixelGrid::from_pixels(SIZE, SIZE, (0..image.pixels.len()).map(blend).collect());
        assert!(!Doubt::of(&soft, &truth).is_rough(), "{:?}", Doubt::of(&soft, &truth));
        let rough = labels(|angle| 2.0 * (5.0 * angle).sin());
        let doubts = [Doubt::of(&image, &rough), Doubt::of(&image, &truth)];
        assert!(doubts[0].is_rough() && Doubt::sum(doubts.into_iter()).is_rough(), "{doubts:?}");
        assert!(!Doubt::default().is_rough());
    }
}
