//! Judgement of poses. "80 of 80 images" proves nothing: repeated shapes and moving objects make
//! models that are wrong as a whole, and two runs by different mappers and seeds are seldom wrong alike. A second run is
//! worth its time where the first leaves a doubt: few points hold its images, or matches do not fit.

use std::fmt;

use super::features::median;
use super::python::Model;
use crate::poses::Poses;
use crate::similarity::{Difference, difference};

/// Share of the images that need a pose.
const REGISTERED: f64 = 0.9;

/// Largest mean reprojection error: pixels, or a share of the larger side where that is more.
const REPROJECTION_PX: f64 = 1.5;
const REPROJECTION_SHARE: f64 = 0.0015;

/// Focal lengths that cameras have, as a share of the larger side of the image.
const FOCAL: [f64; 2] = [0.4, 3.0];

/// Largest first coefficient of radial distortion.
const RADIAL: f64 = 0.5;

/// Points that tie every image to others.
const POINTS: usize = 12;

/// Two runs agree where places differ by less than this share of their spread, orientations by less than this
/// angle in the median, and this share of the images has a pose in both.
const PLACES: f64 = 0.035;
const ANGLE_DEGREES: f64 = 5.0;
const COMMON: f64 = 0.75;

/// One run leaves no doubt where the median image is held by so many points, and this share of all matches fits. On
/// seven captures with known cameras, models that were 4 to 50 % of their spread off had 108 to 238 points and 93 to
/// 99 %, those that were 0.3 to 2 % off 172 to 457 and 97 to 99 %; videos with texture have more than 1000, and 99.9 %.
const SURE_POINTS: usize = 500;
const SURE_FITTING: f64 = 0.97;

/// Another run, to compare with.
#[derive(Clone, Copy, Debug)]
pub(super) enum Second<'a> {
    /// There is none so far.
    NotAsked,
    /// It found no poses.
    Nothing,
    /// Its poses.
    Found(&'a Poses),
}

impl<'a> Second<'a> {
    /// Of the answer of a mapper.
    pub(super) fn of(model: Option<&'a Model>) -> Self {
        model.map_or(Self::Nothing, |model| Self::Found(&model.poses))
    }
}

/// One thing that was looked at.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    /// The argument, with its figures.
    pub words: String,
    /// True where it speaks for the poses.
    pub holds: bool,
}

/// Arguments for and against poses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// Everything that was looked at.
    pub checks: Vec<Check>,
}

impl Verdict {
    /// True where nothing speaks against the poses.
    #[must_use]
    pub fn is_good(&self) -> bool {
        !self.checks.is_empty() && self.checks.iter().all(|check| check.holds)
    }

    /// Number of checks that hold.
    #[must_use]
    pub fn holding(&self) -> usize {
        self.checks.iter().filter(|check| check.holds).count()
    }

    fn add(&mut self, holds: bool, words: String) {
        self.checks.push(Check { words, holds });
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, check) in self.checks.iter().enumerate() {
            let mark = if check.holds { "good" } else { "BAD " };
            write!(f, "{}  {mark}  {}", if number > 0 { "\n" } else { "" }, check.words)?;
        }
        Ok(())
    }
}

/// Judges the model of `images` images by itself and by another run.
pub(super) fn judge(model: &Model, second: Second<'_>, images: usize) -> Verdict {
    let mut verdict = Verdict::default();
    let poses = &model.poses;
    let share = poses.images.len() as f64 / images.max(1) as f64;
    verdict.add(
        share >= REGISTERED && poses.images.len() > 2,
        format!("{} of {images} images have a pose ({:.0} % needed)", poses.images.len(), 100.0 * REGISTERED),
    );
    let side = poses.lenses.iter().map(|lens| lens.size.0.max(lens.size.1)).max().unwrap_or(1);
    let allowed = REPROJECTION_PX.max(REPROJECTION_SHARE * f64::from(side));
    if let Some(error) = poses.reprojection_px {
        // A model without points has no error.
        verdict.add(
            error > 0.0 && error <= allowed,
            format!("points project {error:.2} px from where they are seen (at most {allowed:.1})"),
        );
    }
    for lens in used_lenses(poses) {
        let side = f64::from(lens.size.0.max(lens.size.1));
        let share = lens.focal_px[0] / side;
        let k1 = lens.distortion.radial[0];
        let is_plausible = (FOCAL[0]..=FOCAL[1]).contains(&share) && k1.abs() <= RADIAL;
        verdict.add(
            is_plausible,
            format!(
                "focal length {:.1} px, {share:.2} of the larger side ({} to {}), distortion k1 {k1:.3} (at most \
                 {RADIAL})",
                lens.focal_px[0], FOCAL[0], FOCAL[1]
            ),
        );
    }
    let loose = poses.images.values().filter(|pose| pose.points < POINTS).count();
    verdict.add(
        loose as f64 <= (1.0 - REGISTERED) * poses.images.len() as f64,
        format!("{loose} images are held by fewer than {POINTS} points"),
    );
    let (holds, words) = match second {
        Second::NotAsked => without_second(model),
        Second::Nothing => (false, "a second run found no poses to compare with".to_owned()),
        Second::Found(second) => compared(poses, second),
    };
    verdict.add(holds, words);
    verdict
}

/// True where one run leaves no doubt, and why.
fn without_second(model: &Model) -> (bool, String) {
    let points = median(model.poses.images.values().map(|pose| pose.points).collect());
    let words = format!(
        "the median image is held by {points} points, and {:.1} % of all matches fit: no doubt from {SURE_POINTS} and \
         {:.0} % on",
        100.0 * model.fitting,
        100.0 * SURE_FITTING
    );
    (points >= SURE_POINTS && model.fitting >= SURE_FITTING, words)
}

/// True where two runs agree, and how far they are apart.
fn compared(poses: &Poses, second: &Poses) -> (bool, String) {
    let Some(Difference { images: common, places, median_angle }) = difference(poses, second) else {
        return (false, "a second run found no poses to compare with".to_owned());
    };
    let holds = places <= PLACES
        && median_angle.to_degrees() <= ANGLE_DEGREES
        && common as f64 >= COMMON * poses.images.len() as f64;
    let words = format!(
        "two runs put the {common} cameras that both have {:.1} % of their spread apart, turned by {:.1} degrees (at \
         most {:.1} % and {ANGLE_DEGREES:.0} degrees, {:.0} % in common)",
        100.0 * places,
        median_angle.to_degrees(),
        100.0 * PLACES,
        100.0 * COMMON
    );
    (holds, words)
}

/// Lenses that an image with a pose was taken with, in order.
fn used_lenses(poses: &Poses) -> impl Iterator<Item = &crate::poses::Lens> {
    let is_used = |number: usize| poses.images.values().any(|pose| pose.lens == number);
    poses.lenses.iter().enumerate().filter(move |(number, _)| is_used(*number)).map(|(_, lens)| lens)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::similarity::tests::{arc, somewhere};

    /// Judges poses whose matches all fit by those of another run.
    fn judge(poses: &Poses, second: Option<&Poses>, images: usize) -> Verdict {
        let model = Model { poses: poses.clone(), fitting: 1.0 };
        super::judge(&model, second.map_or(Second::Nothing, Second::Found), images)
    }

    fn failing(verdict: &Verdict) -> Vec<&str> {
        verdict.checks.iter().filter(|check| !check.holds).map(|check| check.words.as_str()).collect()
    }

    #[test]
    fn two_runs_in_different_worlds_agree() {
        let (a, mut b) = (arc(20), arc(20));
        b.transform(&somewhere());
        let verdict = judge(&a, Some(&b), 21);
        assert!(verdict.is_good(), "{verdict}");
    }

    #[test]
    fn full_registration_proves_nothing() {
        let (a, mut b) = (arc(20), arc(20));
        // The second half of the path bends the other way.
        for pose in b.images.values_mut().skip(10) {
            pose.world_from_camera.translation.z += 1.2;
        }
        let verdict = judge(&a, Some(&b), 20);
        assert!(failing(&verdict).len() == 1 && failing(&verdict)[0].contains("two runs"), "{verdict}");
        assert!(!judge(&a, None, 20).is_good());
        let few: Poses = Poses { images: arc(20).images.into_iter().take(9).collect(), ..arc(20) };
        assert!(failing(&judge(&a, Some(&few), 20))[0].contains("two runs"));
    }

    #[test]
    fn one_run_is_enough_where_it_leaves_no_doubt() {
        let alone = |points, fitting| {
            let mut poses = arc(20);
            poses.images.values_mut().for_each(|pose| pose.points = points);
            super::judge(&Model { poses, fitting }, Second::NotAsked, 20)
        };
        assert!(alone(900, 0.98).is_good(), "{}", alone(900, 0.98));
        for doubtful in [alone(230, 0.98), alone(900, 0.9)] {
            assert!(
                failing(&doubtful).len() == 1 && failing(&doubtful)[0].contains("no doubt"),
                "{doubtful}"
            );
        }
    }

    #[test]
    fn orientations_count_as_places_do() {
        let (a, mut b) = (arc(20), arc(20));
        for pose in b.images.values_mut() {
            let turn = glam::DMat3::from_axis_angle(DVec3::X, 0.2);
            pose.world_from_camera.rotation *= turn;
        }
        assert!(!judge(&a, Some(&b), 20).is_good());
    }

    #[test]
    fn few_images_wrong_lenses_and_large_errors_are_reported() {
        let a = arc(20);
        for (change, expected) in [
            (
                Box::new(|poses: &mut Poses| poses.lenses[0].focal_px = [2500.0; 2])
                    as Box<dyn Fn(&mut Poses)>,
                "focal",
            ),
            (Box::new(|poses: &mut Poses| poses.lenses[0].distortion.radial[0] = -0.9), "k1"),
            (Box::new(|poses: &mut Poses| poses.reprojection_px = Some(2.6)), "points project"),
            (Box::new(|poses: &mut Poses| poses.reprojection_px = Some(0.0)), "points project"),
            (
                Box::new(|poses: &mut Poses| {
                    poses.images.values_mut().take(5).for_each(|pose| pose.points = 6);
                }),
                "held by fewer",
            ),
        ] {
            let mut changed = a.clone();
            change(&mut changed);
            let verdict = judge(&changed, Some(&a), 20);
            assert!(
                failing(&verdict).len() == 1 && failing(&verdict)[0].contains(expected),
                "{expected}: {verdict}"
            );
        }
        let verdict = judge(&a, Some(&a), 30);
        assert!(failing(&verdict)[0].contains("20 of 30 images"), "{verdict}");
    }
}
