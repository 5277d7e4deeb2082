//! Time and memory that a run is expected to take.

use cif_dataset::{Dataset, Split};

use super::Calibration;
use crate::budget::{COARSE, INSTANCE, PIXELS_OF_FIT, STEPS_OF_IDENTITY_VIEW, fits_of_resting};
use crate::config::{DensifyRule, TrainConfig};
use crate::density::growth;
use crate::detail::MOST;
use crate::error::TrainError;
use crate::trainer::{deformation_shape, identity_views, memory_of_gaussians, memory_of_planes};
use crate::working_size;

/// Time of one view of those that additions of Gaussians are decided by, in fine steps: it is rendered, and sums over its
/// pixels go back to the Gaussians. These parts of a step are 0.45 of it on two captures.
const STEPS_OF_VIEW: f64 = 0.45;

/// Time of all fine steps with the tests of what effects are worth over that without: 1.04 to 1.06 on ten runs.
const TESTS: f64 = 1.05;

/// Bytes of the program and its libraries, and of tables of masks and fits of objects. These and [`BYTES_OF_STEP`] make
/// the largest memory of eight runs of `draft` 0.89 to 1.21 times what it was.
const PROGRAM: u64 = 64 << 20;
const OBJECTS: u64 = 24 << 20;

/// Bytes of a step for each pixel of a whole image and each Gaussian: images, gradients and scores, pairs of tiles and
/// Gaussians, projected Gaussians.
const BYTES_OF_STEP: [u64; 2] = [360, 1_000];

/// Facts about a run, besides its settings, that decide its cost and the settings that may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Workload {
    /// More than one time.
    pub is_dynamic: bool,
    /// Masks with labelled pixels.
    pub has_instances: bool,
    /// Training frames.
    pub frames: usize,
    /// Instances that travel by their masks.
    pub travelling: usize,
    /// Other instances.
    pub resting: usize,
    /// Images may be reduced.
    pub may_reduce: bool,
    /// Gaussians may be changed.
    pub may_change_gaussians: bool,
}

impl Workload {
    /// The work of a capture, whose settings may change.
    #[must_use]
    pub fn of(dataset: &Dataset, travelling: usize) -> Self {
        Self {
            is_dynamic: dataset.times.len() > 1,
            has_instances: dataset.frames.iter().any(|frame| frame.mask.is_some()),
            frames: dataset.frames.iter().filter(|frame| frame.split == Split::Train).count(),
            travelling,
            resting: dataset.instances.len().saturating_sub(travelling),
            may_reduce: true,
            may_change_gaussians: true,
        }
    }

    /// True where objects are fitted.
    pub(super) fn has_fits(self, config: &TrainConfig) -> bool {
        let motion = &config.motion;
        let are_fitted =
            motion.rigid && motion.guidance > 0.0 && config.effects.motion && config.effects.instances;
        are_fitted && self.is_dynamic && self.has_instances
    }
}

/// Time and memory that a run is expected to take; at most where Gaussians are added by gradients, as nobody knows how many
/// there will be.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Expected {
    /// Seconds of the steps of all stages, and of the estimation of identities.
    pub steps_s: f64,
    /// Seconds of the fits of objects, and of the search for joints of those that do not travel; how many hypotheses an
    /// object asks for decides, so that half or twice as much is possible.
    pub fits_s: f64,
    /// Largest memory, bytes.
    pub memory_bytes: u64,
    /// Most Gaussians: more than the settings say where images show much detail.
    pub gaussians: u32,
    /// Steps that were measured for it.
    pub measured_steps: usize,
}

impl Expected {
    /// Expects of a run with these settings that its steps cost as much as those that were measured.
    ///
    /// # Errors
    /// When the settings have no deformation, or memory cannot hold it.
    pub fn of(
        dataset: &Dataset,
        config: &TrainConfig,
        calibration: &Calibration,
        work: Workload,
    ) -> Result<Self, TrainError> {
        let [width, height] = calibration.image_size.map(f64::from);
        let pixel_s = calibration.shares.pixels * calibration.step_s / (width * height).max(1.0);
        let of_resting = fits_of_resting(config.motion.parts);
        let objects = work.travelling as f64 + work.resting as f64 * of_resting;
        let fits = if work.has_fits(config) { objects } else { 0.0 };
        Ok(Self {
            steps_s: steps_s(config, calibration, work, 1),
            fits_s: fits * PIXELS_OF_FIT * pixel_s,
            memory_bytes: memory(dataset, config, calibration, work)?,
            gaussians: full_set(config, calibration),
            measured_steps: calibration.steps,
        })
    }
}

/// Expected seconds of all stages, images reduced by `reduction` more.
pub(super) fn steps_s(
    config: &TrainConfig,
    calibration: &Calibration,
    work: Workload,
    reduction: u32,
) -> f64 {
    let most = f64::from(full_set(config, calibration));
    // Densification may start with more than it may add up to.
    let initial = (calibration.initial as f64).min(most);
    let mean = mean_gaussians(config, initial, most);
    let size = calibration.image_size.map(|side| side / reduction);
    let working = working_size::of_size(size, config);
    let costs = working_size::step_costs(size.map(|side| side / working), working, &config.stages);
    let (halved, whole) = (costs.first.share, costs.last.share);
    let few = calibration.step_s(initial, reduction * working);
    // These see images of half the size, if any do.
    let before = if halved > 0.0 { 2 * reduction * working } else { reduction * working };
    let before = calibration.step_before_s(mean, before) - calibration.step_s(mean, before);
    let middle = calibration.step_s(mean, reduction * working);
    let fine = TESTS
        * f64::from(config.fine_iterations())
        * (share_before_tests(config, work) * before
            + halved * calibration.step_s(mean, 2 * reduction * working)
            + whole * calibration.step_s(mean, reduction)
            + (1.0 - halved - whole) * middle)
        + STEPS_OF_VIEW * f64::from(views_of_additions(config)) * middle;
    let coarse = f64::from(config.stages.coarse) * few * if work.is_dynamic { COARSE } else { 1.0 };
    let full = calibration.step_s(most, reduction * working);
    let identity_views = identity_views(config, work.frames).iter().sum::<usize>() as f64;
    let of_instances = f64::from(config.stages.instance) * INSTANCE + STEPS_OF_IDENTITY_VIEW * identity_views;
    coarse + fine + if work.has_instances { of_instances * full } else { 0.0 }
}

/// Most Gaussians with these settings: more than they say where the images of the capture show much detail.
fn full_set(config: &TrainConfig, calibration: &Calibration) -> u32 {
    let most = config.densify.max_gaussians;
    match config.densify.detail > 0.0 {
        true => calibration.most.min((MOST * f64::from(most)) as u32).max(most),
        false => most,
    }
}

/// Mean of the Gaussians of the fine stage.
fn mean_gaussians(config: &TrainConfig, initial: f64, most: f64) -> f64 {
    let fine = config.fine_iterations().max(1);
    let growing = config.densify.full_after(fine) / f64::from(fine);
    growing * growth::mean(initial, most) + (1.0 - growing) * most
}

/// Views that additions of Gaussians look at, in all.
fn views_of_additions(config: &TrainConfig) -> u32 {
    let densify = &config.densify;
    let steps = densify.until.min(config.fine_iterations()).saturating_sub(densify.from);
    match densify.rule {
        DensifyRule::Error => densify.views * steps.checked_div(densify.every).unwrap_or(0),
        DensifyRule::Gradient => 0,
    }
}

/// Share of the fine steps before those that stand still are looked for.
fn share_before_tests(config: &TrainConfig, work: Workload) -> f64 {
    let effects = &config.effects;
    let by_masks = f64::from(effects.still_told) / f64::from(config.fine_iterations().max(1));
    match work.travelling {
        _ if effects.still_every == 0 => 0.0,
        0 => f64::from(effects.still_from),
        _ => by_masks.min(f64::from(effects.still_from)),
    }
}

/// Largest memory of a run, bytes.
fn memory(
    dataset: &Dataset,
    config: &TrainConfig,
    calibration: &Calibration,
    work: Workload,
) -> Result<u64, TrainError> {
    let pixels =
        |by: u32| -> u64 { calibration.image_size.map(|side| u64::from(side / by)).iter().product() };
    let reduction = working_size::of_size(calibration.image_size, config);
    let of_pixel = if work.has_instances { 3 + 2 } else { 3 };
    // Images of half the size are kept as well.
    let frames = work.frames as u64 * pixels(reduction) * of_pixel * 5 / 4;
    let frames = frames.min(u64::from(config.frame_memory_mib) << 20);
    let planes = match work.is_dynamic && config.effects.motion {
        true => memory_of_planes(&deformation_shape(dataset, config)?).bytes,
        false => 0,
    };
    let gaussians = full_set(config, calibration);
    let [of_pixels, of_gaussians] = BYTES_OF_STEP;
    let step = of_pixels * pixels(1) + of_gaussians * u64::from(gaussians);
    let objects = if work.has_fits(config) { OBJECTS } else { 0 };
    Ok(PROGRAM + objects + frames + planes + memory_of_gaussians(gaussians).bytes + step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::times::{StepShares, raster_cost};
    use crate::trainer::guard_tests::support::{Scene, capture};

    /// 10 ms per step with a full set of 10 000, half of it for pixels, a tenth for what moves.
    const MEASURED: Calibration = Calibration {
        initial: 2_000,
        most: 10_000,
        gaussians: 10_000,
        step_s: 0.01,
        shares: StepShares { pixels: 0.5, moving: 0.1, fixed: 0.1 },
        moving: 0.25,
        image_size: [200, 100],
        steps: 24,
    };

    const WORK: Workload = Workload {
        is_dynamic: true,
        has_instances: true,
        frames: 40,
        travelling: 2,
        resting: 0,
        may_reduce: true,
        may_change_gaussians: true,
    };

    fn config() -> TrainConfig {
        let mut config = TrainConfig::default();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (0, 1_000, 0);
        config.densify.max_gaussians = 10_000;
        config
    }

    #[test]
    fn steps_cost_what_their_pixels_and_gaussians_do() {
        let still = Workload { has_instances: false, ..WORK };
        let mut config = config();
        config.effects.still_every = 0;
        // A full set all the time; too small for half of the size.
        (config.densify.full_at, config.densify.until) = (0.0, 0);
        let seconds = steps_s(&config, &MEASURED, still, 1);
        assert!((seconds / (TESTS * 1_000.0 * 0.01) - 1.0).abs() < 1e-6, "{seconds}");
        // All of them move in the first steps: four times those of later ones.
        (config.effects.still_every, config.effects.still_from, config.effects.still_told) = (500, 0.2, 100);
        let more = TESTS * 0.01 * 0.1 * 3.0;
        let known = steps_s(&config, &MEASURED, still, 1) - seconds;
        assert!((known / (100.0 * more) - 1.0).abs() < 1e-6, "{known}");
        let unknown = steps_s(&config, &MEASURED, Workload { travelling: 0, ..still }, 1) - seconds;
        assert!((unknown / (200.0 * more) - 1.0).abs() < 1e-6, "{unknown}");
        // Identities are estimated over all frames; coarse steps have the Gaussians of the beginning.
        let identity = steps_s(&config, &MEASURED, WORK, 1) - seconds - known;
        assert!((identity / (40.0 * STEPS_OF_IDENTITY_VIEW * 0.01) - 1.0).abs() < 1e-6, "{identity}");
        config.stages.coarse = 100;
        let coarse = steps_s(&config, &MEASURED, still, 1) - seconds - known;
        let step = COARSE * 0.01 * (0.5 * raster_cost(1.0, 0.2) + 0.1 + 0.4 * 0.2);
        assert!((coarse / (100.0 * step) - 1.0).abs() < 1e-6, "{coarse}");
    }

    #[test]
    fn detail_makes_a_full_set_larger_where_settings_let_it() {
        let mut config = config();
        let detailed = Calibration { most: 15_000, ..MEASURED };
        assert_eq!(full_set(&config, &detailed), 15_000);
        config.densify.max_gaussians = 6_000;
        assert_eq!(full_set(&config, &detailed), 12_000, "no more than twice as many");
        assert_eq!(full_set(&config, &Calibration { most: 5_000, ..MEASURED }), 6_000);
        config.densify.detail = 0.0;
        assert_eq!(full_set(&config, &detailed), 6_000);
    }

    #[test]
    fn additions_make_the_set_larger_and_look_at_views() {
        let mut config = config();
        (config.densify.full_at, config.densify.until, config.densify.from) = (0.5, 800, 100);
        (config.densify.every, config.densify.views) = (50, 8);
        // From 2 000 to 10 000 within 400 of 1 000 steps.
        let steps: f64 = (0..400).map(|step| 2_000.0 * 5.0_f64.powf((f64::from(step) + 0.5) / 400.0)).sum();
        let expected = (steps + 600.0 * 10_000.0) / 1_000.0;
        let mean = mean_gaussians(&config, 2_000.0, 10_000.0);
        assert!((mean / expected - 1.0).abs() < 1e-5, "{mean} {expected}");
        assert_eq!(mean_gaussians(&config, 10_000.0, 10_000.0), 10_000.0);
        assert_eq!(views_of_additions(&config), 8 * 14);
        config.densify.rule = DensifyRule::Gradient;
        assert_eq!(views_of_additions(&config), 0);
    }

    #[test]
    fn fits_take_time_by_objects_and_memory_grows_with_frames_up_to_its_bound() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let mut config = config();
        (config.motion.rigid, config.motion.guidance) = (true, 10.0);
        let of = |config: &TrainConfig, work| Expected::of(&dataset, config, &MEASURED, work).unwrap();
        let fit = PIXELS_OF_FIT * 0.005 / 20_000.0;
        assert!((of(&config, WORK).fits_s / (2.0 * fit) - 1.0).abs() < 1e-9);
        let others = Workload { travelling: 1, resting: 7, ..WORK };
        config.motion.parts = false;
        assert!((of(&config, others).fits_s / (fit + 7.0 * fits_of_resting(false) * fit) - 1.0).abs() < 1e-9);
        config.motion.parts = true;
        assert!(fits_of_resting(true) > fits_of_resting(false));
        let resting = 7.0 * fits_of_resting(true);
        assert!((of(&config, others).fits_s / (fit + resting * fit) - 1.0).abs() < 1e-9);
        assert_eq!(of(&config, WORK).gaussians, 10_000);
        let many = of(&config, Workload { frames: 1_040, ..WORK });
        let more = many.memory_bytes - of(&config, WORK).memory_bytes;
        assert_eq!(more, 1_000 * 20_000 * 5 * 5 / 4, "labels as well, and half the size");
        config.frame_memory_mib = 64;
        let bounded = of(&config, Workload { frames: 10_000, ..WORK }).memory_bytes;
        assert_eq!(bounded, of(&config, Workload { frames: 20_000, ..WORK }).memory_bytes);
        config.motion.rigid = false;
        assert_eq!(of(&config, WORK).fits_s, 0.0);
    }
}
