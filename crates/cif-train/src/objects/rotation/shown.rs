//! Turns about an axis that the pictures show: light that stays and paint that turns explain pixels that were left out better
//! than what stays alone does, and of rough surfaces than paint that slides over what stays as the camera travels.

use glam::DVec3;
use rayon::prelude::*;

use super::compare::{self, gains, standard_errors};
use super::evidence::{Evidence, Look, Pixel};
use super::judge::{APART, SIGMAS};
use super::painted::{Cells, Seen, Spot, Turned, Turning, mean};

/// Pixels of a view that turns are found by.
const PIXELS: usize = 400;

/// Turns of paint, of the angle by which a camera goes around, that a surface at rest seems to have where it is modelled at
/// another depth than its own: `1 - r / R` of paint at a radius `r` where `R` is modelled, from a model of half the size (-10
/// tenths) to the far wall that an opening shows (20). The paint of a vase at rest slides by -0.2: turns beat that by 0.6
/// standard errors, slides of 0.1 less or more by up to 2.1, and what steps of a half try by 4.5.
const SLIDES: std::ops::RangeInclusive<i32> = -10..=20;

/// Places of a surface that pixels show, and how well they are explained where nothing turns.
pub(super) struct Shown {
    all: Seen,
    /// Places that a few pixels of each view show.
    pub(super) few: Seen,
    still: Vec<f32>,
}

impl Shown {
    /// Places that pixels show, from the middle of the axis, in the frame in which the surface turns, seen at a cosine;
    /// `None` where there is too little.
    pub(super) fn of(
        evidence: &Evidence<'_>,
        cells: Cells,
        place: impl Fn(&Look<'_>, &Pixel) -> Option<(DVec3, f64)>,
    ) -> Option<Self> {
        let all = Seen::of(evidence, cells, place);
        // Light of each camera by itself is known from fewer pixels than paint that all of them show.
        let still = all.residuals(evidence, &all.still(), all.cameras > 1);
        let few = all.few(PIXELS, &still)?;
        Some(Self { all, few, still })
    }

    /// Mean gain of turns on pixels that were left out, and by how many standard errors it is one.
    pub(super) fn gain(&self, evidence: &Evidence<'_>, turned: &Turned) -> (f64, f64) {
        let gains = gains(evidence, &self.all.residuals(evidence, turned, true), &self.still);
        (compare::mean(&gains), standard_errors(&gains))
    }

    /// Turns of some angles at the times.
    pub(super) fn turned(&self, axis: DVec3, angle: impl FnMut(&usize) -> f64) -> Turned {
        Turned { axis, angles: self.all.times.iter().map(angle).collect(), cost: 0.0 }
    }

    /// Turns that were found as angles by time.
    pub(super) fn turning(&self, found: &Turned) -> Turning {
        let angles = self.all.times.iter().copied().zip(found.angles.iter().copied()).collect();
        Turning { axis: found.axis, angles }
    }

    /// Mean residuals of pixels left out, with turns and by light alone; `None` where they do not show the turns, by more
    /// than 30 degrees.
    pub(super) fn errors(&self, evidence: &Evidence<'_>, found: &Turned) -> Option<[f64; 2]> {
        let residuals = self.all.residuals(evidence, found, true);
        let is_shown = found.reach() > APART && beats(evidence, &residuals, &self.still);
        if is_shown { Some([mean(&residuals)?, self.few.error]) } else { None }
    }

    /// True where neither paint that slides over the surface instead as the camera travels, nor another look of all of it from
    /// some time on explains as much as turns that were found.
    pub(super) fn turns(&self, evidence: &Evidence<'_>, found: &Turned) -> bool {
        self.beat_slides(evidence, found, &self.all.residuals(evidence, found, true))
    }

    /// The same of a surface that is not known exactly: turns that each half of it shows explain the other half better than
    /// no turn and any of this do.
    pub(super) fn turns_in_halves(&self, evidence: &Evidence<'_>, found: &Turned) -> bool {
        let crossed = self.crossed(evidence, found.axis);
        beats(evidence, &crossed, &self.still) && self.beat_slides(evidence, found, &crossed)
    }

    /// True where residuals with turns are less than those with a look that changes, or with paint that slides.
    fn beat_slides(&self, evidence: &Evidence<'_>, found: &Turned, residuals: &[f32]) -> bool {
        let sides = self.all.sides(found.axis);
        let slid = |tenths: i32| {
            let angles = sides.iter().map(|side| 0.1 * f64::from(tenths) * side).collect();
            self.all.residuals(evidence, &Turned { axis: found.axis, angles, cost: 0.0 }, true)
        };
        beats(evidence, residuals, &self.all.changed(evidence, found))
            && SLIDES.into_par_iter().all(|tenths| beats(evidence, residuals, &slid(tenths)))
    }

    /// Residuals of the pixels of each half of the surface, above and below the middle of the axis, with the turns that the
    /// other half shows: turns that were found by the pixels which they are to explain always explain a little.
    fn crossed(&self, evidence: &Evidence<'_>, axis: DVec3) -> Vec<f32> {
        let mut heights: Vec<f64> = self.few.spots.iter().map(|spot| spot.place.dot(axis)).collect();
        let middle = cif_geometry::stats::median(&mut heights).unwrap_or(0.0);
        let is_above = |spot: &Spot| spot.place.dot(axis) > middle;
        let [above, below] = [true, false].map(|above| {
            let half = self.few.only(|spot| is_above(spot) == above);
            self.all.residuals(evidence, &half.turned_about(axis), true)
        });
        let mut crossed = vec![f32::NAN; evidence.len()];
        for spot in &self.all.spots {
            let other = if is_above(spot) { &below } else { &above };
            crossed[spot.pixel] = other[spot.pixel];
        }
        crossed
    }
}

/// True where residuals are less than others by more than chance.
fn beats(evidence: &Evidence<'_>, residuals: &[f32], others: &[f32]) -> bool {
    standard_errors(&gains(evidence, residuals, others)) > SIGMAS
}
