//! Every setting of a training run.
//!
//! "Default" below is the value of the `standard` preset; [`TrainConfig::preset`] gives the others. Codes
//! such as A7 name the question of the methods reference (section 12) that a setting answers.

mod older;
mod options;
mod presets;
mod validate;

use std::collections::{BTreeMap, BTreeSet};

use cif_field::{Heads, SortMetric, TimeEncoding};
use serde::{Deserialize, Serialize};

pub use options::{
    Ablation, DensifyRule, Excess, HeadName, InstanceGeometry, LabelShares, Normalisation, ObjectMotion,
    OccupancyStart, Preset, ScaleCorrection, WeakSet, Weakness,
};
pub use validate::{ConfigError, MAX_REDUCTION};

/// Settings of a run. Every table and key may be left out of a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Preset that the other values started from; recorded, and otherwise without effect.
    pub preset: Preset,
    /// Seed of every random choice, default 0. Same seed and settings: same result, bit for bit.
    pub seed: u64,
    /// Image reduction: 1, 2, 4, ...; default none, which takes the largest images stored. Applied where the
    /// capture is opened.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub downscale: Option<u32>,
    /// Colour behind everything, display-referred RGB in [0, 1]. Default none: white where images have transparent
    /// pixels, and the colour of a backdrop where a quarter of the pixels at their borders has exactly one; else scenes
    /// show the mean colour at these borders, and steps have black or white, whichever is farther from it, so that nothing
    /// shows through. White in `paper`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<[f32; 3]>,
    /// Gaussians nearer to the camera than this are not drawn, units of the capture. Default 0: as near as its points
    /// say that the scene comes; 0.2 in `paper`.
    pub near: f32,
    /// Compensates opacity for the 0.3 px low-pass filter, default off; viewers of exported files do not.
    pub antialiased: bool,
    /// Depth order, `z` or `distance`, default `z`.
    pub sort_metric: SortMetric,
    /// Memory for decoded training frames, MiB, default 1024; frames beyond it are decoded ahead of the
    /// steps that need them, at most 8 at a time, which takes memory of its own.
    pub frame_memory_mib: u32,
    /// Length of the stages.
    pub stages: StagesConfig,
    /// Initial Gaussians and the deformation network.
    pub model: ModelConfig,
    /// Learning rates.
    pub rates: RatesConfig,
    /// Optimiser variants.
    pub adam: AdamConfig,
    /// Weights of the loss terms.
    pub loss: LossConfig,
    /// Motion that masks tell.
    pub motion: MotionConfig,
    /// Cloning, splitting and pruning of Gaussians in the coarse and fine stages.
    pub densify: DensifyConfig,
    /// Identity estimation.
    pub identity: IdentityConfig,
    /// Instance stage.
    pub instance: InstanceConfig,
    /// Head that the instance stage trains.
    pub head: HeadConfig,
    /// Instance-guided resampling.
    pub resample: ResampleConfig,
    /// Effects that a run may leave out where the capture does not call for them.
    pub effects: EffectsConfig,
    /// Reports, evaluations and checkpoints on the way.
    pub report: ReportConfig,
}

/// Length of the stages, in optimiser steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StagesConfig {
    /// Coarse steps: one static set for all times, default 300, and 2000 in the layout D-NeRF, which has no points:
    /// what objects stand on is looked for in what they reconstruct. A capture with one time has no coarse stage:
    /// its steps are added to the fine stage, which then has no deformation.
    pub coarse: u32,
    /// Fine steps: deformation and regularisers on, default 7000.
    pub fine: u32,
    /// True when the coarse steps count towards `fine`, default no (A1).
    pub fine_includes_coarse: bool,
    /// Instance steps, default 1000; skipped without masks.
    pub instance: u32,
    /// Share of the fine steps, the first ones, that see images of half the width and height, [0, 1], default 0.4, 0 in
    /// `paper`; where no masks guide what moves, coarse steps see them too. Images whose shorter side has less than 128
    /// pixels stay whole.
    pub half_size: f32,
    /// Reduction of the images that a run works on, but for its last fine steps: 1 to 16, or 0, the default, by powers of
    /// two until they have no more than 32 pixels for each of `densify.max_gaussians`; 1 in `paper`.
    pub reduction: u32,
    /// Share of the fine steps, the last ones, that see whole images in a run that works on reduced ones, [0, 1], default
    /// 0.05.
    pub whole_size: f32,
    /// Views per step, 1 to 1024, default 1 (A27: all stages alike).
    pub batch: u32,
}

/// Initial Gaussians and the deformation network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// Most initial points kept; denser clouds are thinned by voxels. Default 20 000.
    pub max_initial_points: u32,
    /// True where a capture that has no points gets those that its images show by its poses, through pycolmap; default
    /// true, and false in `paper` for the layout D-NeRF. Where none were found, a run records false.
    pub triangulate: bool,
    /// Opacity of initial Gaussians, (0, 1), default 0.1.
    pub initial_opacity: f32,
    /// Nodes of the spatial planes along x, y, z at multiplier 1, default 64 each.
    pub spatial_resolution: [u32; 3],
    /// Nodes of the time planes over [-1, 1], of which times in [0, 1] use the upper half. Default 0: one for six
    /// training images, at least 25, at most two for each distinct time, within 8 and 150.
    pub time_resolution: u32,
    /// Spatial resolution factor of each level, default [1, 2].
    pub multipliers: Vec<u32>,
    /// Feature channels per plane, default 16.
    pub channels: u32,
    /// Width of the network, default 64.
    pub width: u32,
    /// Parameters that the network moves: position, scale, rotation by default; opacity and SH off.
    pub heads: Heads,
    /// Stored time rows: `compact` (default) or `compat`, all rows as the base code keeps them.
    pub time_encoding: TimeEncoding,
    /// Starts from exactly no motion, default off for parity with the base code.
    pub zero_initial_heads: bool,
    /// Highest spherical-harmonics degree, 0 to 3, default 3.
    pub sh_degree: u8,
    /// Steps between degree increases, counted per stage, default 400; 0 starts at the highest degree.
    pub sh_interval: u32,
}

/// Learning rates. Those marked "x extent" are multiplied by the scene extent; pairs run log-linearly from
/// the first to the second value over `schedule_steps`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RatesConfig {
    /// Steps over which scheduled rates run from first to last, counted from the start of a reconstruction
    /// stage. Default 0: fine plus instance steps.
    pub schedule_steps: u32,
    /// True when the schedule restarts with the instance stage, default no: it continues (A29).
    pub restart_in_instance_stage: bool,
    /// Centres, x extent, default [1.6e-4, 1.6e-6].
    pub means: [f32; 2],
    /// Log-scales, default 5e-3.
    pub log_scales: f32,
    /// Quaternions, default 1e-3.
    pub quaternions: f32,
    /// Opacity logits, default 5e-2.
    pub opacity: f32,
    /// Spherical harmonics of degree 0, default 2.5e-3.
    pub sh_base: f32,
    /// Spherical harmonics of degrees 1 to 3, default 1.25e-4.
    pub sh_rest: f32,
    /// Hexplane features, default [1e-2, 5e-4]; [1.6e-3, 1.6e-4] x extent in `paper`.
    pub planes: [f32; 2],
    /// Network weights, default [2e-3, 1e-4]; [1.6e-4, 1.6e-5] x extent in `paper`.
    pub mlp: [f32; 2],
    /// Multiplies the rates of planes and network by the extent, as the base code does. Default off: a short
    /// run needs higher rates than a long one to learn motion, and the same ones in scenes of any size.
    pub network_follows_extent: bool,
    /// Occupancy logits, default 1e-2.
    pub occupancy: f32,
    /// Log-calibrations, default 1e-2.
    pub calibration: f32,
}

/// Variants of Adam (beta 0.9 and 0.999, epsilon 1e-15, no weight decay).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdamConfig {
    /// Rows not visible in any view of a step keep still instead of moving by their momentum, default off.
    pub visible_rows_only: bool,
}

/// Weights of the loss terms; the colour term is the mean absolute difference.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossConfig {
    /// Share of the structural dissimilarity in the colour loss, [0, 1], default 0.1; 0 in `paper`.
    pub lambda_dssim: f32,
    /// Weight of the instance loss, default 0.01; 0.005 in the `paper` preset on Neu3D captures.
    pub lambda_instance: f32,
    /// Weight of the second difference of the spatial planes, default 1e-4.
    pub plane_smoothness: f32,
    /// Weight of the second difference of the time planes, default 1e-2; 1e-3 in layouts of rigs, whose times have
    /// an image of every camera.
    pub time_smoothness: f32,
    /// Weight of the distance of the time planes from 1, default 1e-4.
    pub time_sparsity: f32,
}

/// Motion that masks tell. One moving camera leaves the depth of moving objects open, and colours alone are
/// then explained by Gaussians that come and go at other depths. With guidance, objects that travel are left
/// out of the coarse stage, start the fine stage with Gaussians of their own, and follow a path estimated from
/// masks and contacts; everything else is held in place. Without masks neither acts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// Weight of the distance of travelling objects from their path, relative to the extent; default 10; 0 for
    /// no guidance, as in `paper`.
    pub guidance: f32,
    /// Share of `guidance` that is left at the end of the fine stage, default 0.1.
    pub guidance_end: f32,
    /// Weight of the displacement of what neither travels nor deforms, relative to the extent; default 1.
    pub stillness: f32,
    /// Steps that teach the deformation the paths, and how objects deform, before the fine stage, default 300.
    pub rehearsal: u32,
    /// True where objects that are rigid move by a trained pose per time instead of the network; needs `guidance`;
    /// default true.
    pub rigid: bool,
    /// True where parts of objects that turn on a hinge or slide, and blades of scissors, are looked for, which takes some
    /// seconds per object; needs `rigid`. A ball that turns on a stand is looked for whatever this says. Default true;
    /// false in `draft` and `paper`.
    pub parts: bool,
    /// Motion of objects, by label, that need not be found: `rigid` or `free`. Default: none is told.
    pub of: BTreeMap<String, ObjectMotion>,
    /// Gaussians that a travelling object starts with, default 300.
    pub gaussians: u32,
    /// Training frames in which more than half of the instances, two or more, are this many times farther than
    /// usual from where the other frames see them have a wrong camera or wrong masks: they are named and left out.
    /// Default 20; 0 keeps every frame, as in `paper`.
    pub misfit: f32,
    /// True where masks that show something else than their object, by their colours and by their places in the frames
    /// before and after, are put right: exchanged where two show each other, else taken away, and so are blobs apart from
    /// them. Default true; false in `paper`.
    pub switches: bool,
    /// True where outlines of masks are moved to where the colours change, if many of them are clearly beside it, as
    /// those of trackers are. Default true; false in `paper`.
    pub edges: bool,
}

/// Cloning, splitting and pruning (methods reference 1.5). Steps count from the start of each stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DensifyConfig {
    /// Rule by which Gaussians are added and removed, default `error`.
    pub rule: DensifyRule,
    /// By `error`: training views that each addition looks at, default 8.
    pub views: u32,
    /// By `error`: share of the steps up to `until` over which the set grows to `max_gaussians`, default 0.5.
    pub full_at: f32,
    /// By `error`: share of a full set that each addition replaces, default 0.1.
    pub turnover: f32,
    /// First step after which Gaussians are added, default 300.
    pub from: u32,
    /// Statistics are kept and Gaussians added before this step, default 4000; 0 never.
    pub until: u32,
    /// Steps between additions, default 100.
    pub every: u32,
    /// By `gradient`: mean screen gradient (normalised device coordinates) from which a Gaussian is cloned or split,
    /// default 2e-4.
    pub gradient_threshold: f32,
    /// By `gradient`: largest scale, as a fraction of the extent, that is cloned rather than split, default 0.01.
    pub split_scale: f32,
    /// No additions beyond this many Gaussians, default 20 000; those with the largest gradient or error go first. What
    /// travelling objects start with comes on top, see `motion.gaussians`, until additions by `error` take it in.
    pub max_gaussians: u32,
    /// Pixels of detail in a training image for each Gaussian: where images show more than `max_gaussians` can, as those
    /// of grass and gravel do, the set may have as many as twice that. Default 2.5; 4 in `draft`; 0 where `max_gaussians`
    /// is set, and in `paper`: never more.
    pub detail: f32,
    /// Steps between prunings, default 100; 0 never.
    pub prune_every: u32,
    /// Pruning only above this many Gaussians, default 0; 200 000 in the base code.
    pub prune_min_n: u32,
    /// Gaussians of less opacity are pruned, default 0.005.
    pub prune_opacity: f32,
    /// Screen radius above which Gaussians are pruned once opacities were reset, pixels, default 20.
    pub prune_radius_px: f32,
    /// Scale above which Gaussians are pruned once opacities were reset, fraction of the extent, default 0.1.
    pub prune_scale: f32,
    /// Steps between opacity resets (before `until`), default 0: never.
    pub opacity_reset_every: u32,
    /// Opacity that a reset caps at, default 0.01.
    pub opacity_reset_to: f32,
}

/// Identity estimation (methods reference 5).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IdentityConfig {
    /// Every how many training frames are counted, default 1.
    pub stride: u32,
    /// Entries below this probability are dropped and the row renormalised, default 1e-4.
    pub truncation: f32,
    /// Mass, in pixels, below which a Gaussian counts as unseen, default 1e-3.
    pub min_mass: f32,
    /// Seen neighbours that an unseen Gaussian takes its row from, default 8.
    pub neighbours: u32,
    /// Distance, as a fraction of the extent, beyond which neighbours do not count, default 0.05.
    pub neighbour_distance: f32,
    /// Occupancy of unseen Gaussians without neighbours, default 0.005.
    pub unseen_occupancy: f32,
    /// Rounds of expectation maximisation, after the instance stage, for how much of each Gaussian is an instance's
    /// rather than of the unlabelled rest, default 4; occupancies are multiplied by it. 0, as in `paper`, leaves what was
    /// counted, and occupancies as they are.
    pub share_rounds: u32,
    /// Estimates again every so many steps of the instance stage, folding calibration in; default 0: once
    /// (A16).
    pub refresh_every: u32,
}

/// Instance stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InstanceConfig {
    /// Source of the initial occupancy, `constant` (default) or `copy_opacity` (A5).
    pub occupancy_start: OccupancyStart,
    /// Initial occupancy, (0, 1), default 0.02 (A5).
    pub occupancy: f32,
    /// Occupancy is kept within these limits, default [0.005, 0.999].
    pub occupancy_limits: [f32; 2],
    /// Log-calibrations are kept within plus and minus this, default 10.
    pub calibration_limit: f32,
    /// Loss normalisation, `none` (default) or `coverage` (A3).
    pub normalisation: Normalisation,
    /// Geometry that the instance loss trains, `full`, `means_only` or `off` (A6); default `off`, `full` in the
    /// preset `paper`.
    pub geometry: InstanceGeometry,
    /// True when the colour loss goes on, default yes (A15).
    pub color_loss: bool,
    /// Parts of the method switched off, default none.
    pub ablate: BTreeSet<Ablation>,
}

/// Head that the instance stage trains: the paper's, or that of a system it is compared with (methods reference 8).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HeadConfig {
    /// Its name: `cif` (default), `dr-splat`, `gaussian-grouping`, `sa4d`, `vlgs`, `trace3d` or `4d-langsplat`.
    pub name: HeadName,
    /// With `dr-splat`: contributors of a pixel that count, of the first 100. Default 0, as many as in its published
    /// command: 45.
    pub contributors: u32,
    /// With `sa4d`: the only camera whose frames train, as its released code has it on Neu3D (`cam16`). Default: none,
    /// all cameras train.
    pub camera: String,
    /// With `4d-langsplat`: the folder of feature maps that it learns, `FRAME.npy` for every training frame, floats of
    /// `[height, width, 3]`; see [`cif_dataset::feature_maps`]. Default: none.
    pub maps: String,
}

/// Instance-guided resampling (methods reference 6). Steps count from the start of the instance stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ResampleConfig {
    /// First event, default 100.
    pub from: u32,
    /// Last event, default 800 (A7: none at the end of the stage).
    pub until: u32,
    /// Steps between events, default 100.
    pub every: u32,
    /// Relocated Gaussians per event, as a fraction of all, default 0.01.
    pub rate: f32,
    /// Floor of occupancy x identity, (0, 1], default 1e-3 (A11).
    pub gamma_floor: f32,
    /// Candidates of weak draws, `members` (default) or `literal` (A10).
    pub weak_set: WeakSet,
    /// Strength by whose inverse candidates are drawn, `visibility` (default) or `occupancy` (as in `paper`).
    pub weakness: Weakness,
    /// Largest share of the candidates of an instance that one event relocates, (0, 1], default 0.5. The paper states
    /// no limit: with 1 (as in `paper`) only one member of the instance is sure to stay, so that there is something to
    /// copy.
    pub weak_share: f32,
    /// Relocations beyond that share, `drop` (default) or `share` (to the other instances, as in `paper`).
    pub excess: Excess,
    /// Scale correction, `off` (default) or `mcmc` (A13).
    pub scale_correction: ScaleCorrection,
    /// Shares of the instances, `equal` (default), `gamma` or `pixels` (A8).
    pub label_shares: LabelShares,
    /// Standard deviation of a replica's offset, in standard deviations of its source, default 0.5 (A12).
    pub offset: f32,
}

/// Effects that a run may leave out where the capture does not call for them. By default nothing is left out; `cif
/// plan` shows what a capture calls for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EffectsConfig {
    /// True when anything moves, default yes; without, a capture of several times is trained as if it had one.
    pub motion: bool,
    /// True when instances are trained where there are masks, default yes.
    pub instances: bool,
    /// Steps between tests for Gaussians that stand still, which then skip the deformation network; default 0:
    /// every Gaussian goes through it.
    pub still_every: u32,
    /// Share of the fine steps before the first test, default 0.15; where all cameras stay in place, their images
    /// tell at once.
    pub still_from: f32,
    /// Latest fine step of the first test where masks tell which objects travel, default 350. In a stage 15 times as
    /// long, everything else is taken to stand still on it if that hardly shows.
    pub still_told: u32,
    /// Displacement from its mean, as a fraction of the extent, up to which a Gaussian may be taken to stand
    /// still, default 0.002. Less counts, down to a quarter, where that much shows.
    pub still_displacement: f32,
    /// Change of log-scales, of the unit quaternion, of the opacity logit and of the colour coefficients up to
    /// which, likewise, a Gaussian may be taken to stand still, default 0.2.
    pub still_shape: f32,
    /// Share of the Gaussians that stand still which go through the network all the same from one test to the
    /// next, others each time: what they learn shows where more must move. Default 0.03.
    pub still_awake: f32,
    /// Loss, dB on held-out pixels of training views, up to which a test takes Gaussians to stand still, default
    /// 0.02.
    pub still_loss: f32,
    /// Gain, dB on held-out pixels of training views, that a degree of spherical harmonics must bring at half of
    /// the fine stage; else it is taken back. Until then the next degree waits while the last one brings no gain
    /// at all. Default 0: degrees come by steps alone, and stay.
    pub sh_gain: f32,
    /// Gain, likewise, that the motion of scales, rotations, opacities and colours must each bring at half of the
    /// fine stage; else it is removed. Default 0: all stay.
    pub head_gain: f32,
    /// True when exports hold hulls of instances for simulators unless told otherwise, default yes.
    pub physics: bool,
    /// True when an exposure and a white balance are learnt for every camera, default no.
    pub exposure: bool,
    /// True when they are learnt for every training image instead, and change evenly from one to the next, default no.
    pub exposure_in_time: bool,
}

/// Reports, evaluations and checkpoints on the way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReportConfig {
    /// Steps between step events, default 10.
    pub step_every: u32,
    /// Steps between evaluations on held-out frames, default 0: never.
    pub evaluate_every: u32,
    /// Held-out frames per evaluation, evenly spread, default 8.
    pub evaluate_frames: u32,
    /// Frames that points of the run's curve are measured on, default 4; 0 records no curve. Results do not
    /// depend on it.
    pub curve_frames: u32,
    /// Training frames, evenly spread, that are withheld from training and that the curve is measured on,
    /// default 0: the curve is measured on held-out frames of the capture, or on training frames where it has
    /// none.
    pub withhold: u32,
    /// Steps between requests to save a checkpoint, default 0: never.
    pub checkpoint_every: u32,
    /// Seconds between requests to save a checkpoint, default 300; there is one at the end of each stage as well. At
    /// least a hundred times what saving takes lies between two by time. 0: neither. Results do not depend on it.
    pub checkpoint_seconds: u32,
}

impl DensifyConfig {
    /// Steps of a stage, of so many, after which the set is full, where Gaussians are added by `error`.
    pub(crate) fn full_after(&self, steps: u32) -> f64 {
        f64::from(self.full_at) * f64::from(self.until.min(steps))
    }
}

impl TrainConfig {
    /// Colour that transparent pixels of images are laid over, display-referred RGB in [0, 1].
    #[must_use]
    pub fn laid_over(&self) -> [f32; 3] {
        self.background.unwrap_or([1.0; 3])
    }

    /// Steps of the fine stage.
    #[must_use]
    pub fn fine_iterations(&self) -> u32 {
        if self.stages.fine_includes_coarse {
            self.stages.fine.saturating_sub(self.stages.coarse)
        } else {
            self.stages.fine
        }
    }

    /// True when an ablation is on.
    #[must_use]
    pub fn ablates(&self, ablation: Ablation) -> bool {
        self.instance.ablate.contains(&ablation)
    }

    /// True when occupancies are parameters of their own that are trained.
    pub(crate) fn trains_occupancy(&self) -> bool {
        !self.ablates(Ablation::ConstantOccupancy) && !self.ablates(Ablation::OpacityOccupancy)
    }
}

#[cfg(test)]
mod tests;
