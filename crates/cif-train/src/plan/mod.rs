//! Which effects a capture calls for, found before anything is trained.
//!
//! | file | answers |
//! |---|---|
//! | this | which effects there are, what is decided of each, and which settings that means |
//! | `evidence` | what the capture shows |
//! | `choice` | what the user says instead |
//!
//! A new effect needs a kind here, its evidence, its decision and its settings; an effect that changes nothing
//! has no place in the list.

mod choice;
mod evidence;

use cif_dataset::Dataset;
use cif_field::TimeEncoding;
use serde::ser::{Serialize, Serializer};

pub use choice::{Basis, EffectChoice};

use self::evidence::Evidence;
use crate::config::{ObjectMotion, TrainConfig};
use crate::error::TrainError;
use crate::phases::Phases;
use crate::trainer::automatic_time_nodes;

/// Steps between tests for Gaussians that stand still.
const STILL_EVERY: u32 = 500;

/// Gain that a degree of spherical harmonics must bring, dB.
const SH_GAIN: f32 = 0.01;

/// Gain that an optional output of the deformation must bring, dB. Little, as it costs little where most stands
/// still, and what moves covers few pixels.
const HEAD_GAIN: f32 = 0.005;

/// Share of changed pixels up to which a fixed camera sees nothing move.
const STATIC_CHANGE: f64 = 5e-4;

/// Angle between views up to which colour cannot be told to depend on the view, degrees.
const FEW_DIRECTIONS: f64 = 4.0;

/// Ratio of footprints from which the low-pass filter of the nearest views would hide detail, or that of the
/// farthest would thicken it.
const FOOTPRINTS: f64 = 4.0;

/// Factor between cameras in how bright they record the same points from which they disagree.
const DISAGREEMENT: f64 = 1.1;

/// Weights of motion guidance where it is switched on.
const GUIDANCE: f32 = 10.0;
const STILLNESS: f32 = 1.0;

/// An effect that a capture may or may not call for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EffectKind {
    /// The deformation network.
    Motion,
    /// Its outputs beside the centres: scales, rotations, opacities, colours.
    Shape,
    /// Nodes of the time planes.
    TimePlanes,
    /// Spherical harmonics above degree 0.
    ViewDependence,
    /// Identities, occupancy, calibration, resampling.
    Instances,
    /// Instances that are not there all the time: opacities that change.
    Appearing,
    /// Paths of travelling objects from their masks.
    Guidance,
    /// Objects that move as a whole, or have a part on a joint: poses instead of the network.
    Objects,
    /// Exposure and white balance per camera.
    Exposure,
    /// Compensation of opacity for the low-pass filter.
    Antialiasing,
    /// Removal of lens distortion.
    Lens,
    /// Colour behind everything.
    Background,
    /// Hulls of instances for simulators, in exports.
    Physics,
}

impl EffectKind {
    /// Those that `--effects` switches.
    pub const SWITCHED: [Self; 10] = [
        Self::Motion,
        Self::Shape,
        Self::ViewDependence,
        Self::Instances,
        Self::Appearing,
        Self::Guidance,
        Self::Objects,
        Self::Exposure,
        Self::Antialiasing,
        Self::Physics,
    ];

    /// Name, as in `--effects` and in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Motion => "motion",
            Self::Shape => "shape",
            Self::TimePlanes => "time-planes",
            Self::ViewDependence => "view-dependence",
            Self::Instances => "instances",
            Self::Appearing => "appearing",
            Self::Guidance => "guidance",
            Self::Objects => "objects",
            Self::Exposure => "exposure",
            Self::Antialiasing => "antialiasing",
            Self::Lens => "lens",
            Self::Background => "background",
            Self::Physics => "physics",
        }
    }
}

impl Serialize for EffectKind {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// Decision on an effect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Throughout.
    On,
    /// Not at all.
    Off,
    /// As far as the words say.
    Value(String),
}

impl std::fmt::Display for Decision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::On => f.write_str("on"),
            Self::Off => f.write_str("off"),
            Self::Value(words) => f.write_str(words),
        }
    }
}

impl Serialize for Decision {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// An effect, and what is to be done about it.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Effect {
    /// Which.
    pub effect: EffectKind,
    /// Decision.
    pub decision: Decision,
    /// Why.
    pub evidence: String,
    /// Cost in time and memory where the effect is on throughout.
    pub cost: String,
    /// Flag that overrides the decision; empty where none can.
    pub flag: String,
}

/// All effects of a capture. Serialises as `{"effects": [{effect, decision, evidence, cost, flag}, ...]}`.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct EffectPlan {
    /// In the order of [`EffectKind`].
    pub effects: Vec<Effect>,
}

/// Extent to which an effect is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Extent {
    /// Not at all.
    Off,
    /// Only where it shows that it helps.
    Needed,
    /// Throughout, as the preset says.
    Full,
}

impl EffectPlan {
    /// Looks at a capture; `config` are the settings that it would be trained with.
    ///
    /// # Errors
    /// When a mask or an image that must be looked at cannot be read.
    pub fn new(dataset: &Dataset, config: &TrainConfig, choice: &EffectChoice) -> Result<Self, TrainError> {
        Self::watched(dataset, config, choice, &Phases::default())
    }

    /// The same in the phase [`Phase::Plan`](crate::Phase::Plan) of a run.
    ///
    /// # Errors
    /// As [`Self::new`], and [`TrainError::Stopped`] when a stop is requested.
    pub fn watched(
        dataset: &Dataset,
        config: &TrainConfig,
        choice: &EffectChoice,
        phases: &Phases,
    ) -> Result<Self, TrainError> {
        let evidence = Evidence::of(dataset, phases)?;
        Ok(Self { effects: decide(&evidence, config, choice) })
    }

    /// Decision on an effect.
    #[must_use]
    pub fn decision(&self, kind: EffectKind) -> Option<&Decision> {
        self.effects.iter().find(|effect| effect.effect == kind).map(|effect| &effect.decision)
    }

    /// Lays the decisions over settings.
    pub fn apply(&self, config: &mut TrainConfig) {
        for effect in &self.effects {
            let extent = match &effect.decision {
                Decision::Off => Extent::Off,
                Decision::On => Extent::Full,
                Decision::Value(_) => Extent::Needed,
            };
            set(effect.effect, extent, config);
        }
    }
}

/// The settings that an effect means.
fn set(kind: EffectKind, extent: Extent, config: &mut TrainConfig) {
    let only_if = |condition: bool, value: f32| if condition { value } else { 0.0 };
    let needed = extent == Extent::Needed;
    match kind {
        EffectKind::Motion => {
            config.effects.motion = extent != Extent::Off;
            config.effects.still_every = if needed { STILL_EVERY } else { 0 };
        }
        EffectKind::Shape => {
            config.effects.head_gain = only_if(needed, HEAD_GAIN);
            if extent == Extent::Off {
                let heads = &mut config.model.heads;
                (heads.scale, heads.rotation, heads.opacity, heads.sh) = (false, false, false, false);
            }
        }
        EffectKind::ViewDependence => {
            config.effects.sh_gain = only_if(needed, SH_GAIN);
            if extent == Extent::Off {
                config.model.sh_degree = 0;
            }
        }
        EffectKind::Instances => config.effects.instances = extent != Extent::Off,
        EffectKind::Guidance => {
            if extent == Extent::Off {
                (config.motion.guidance, config.motion.stillness) = (0.0, 0.0);
            } else if (config.motion.guidance, config.motion.stillness) == (0.0, 0.0) {
                (config.motion.guidance, config.motion.stillness) = (GUIDANCE, STILLNESS);
            }
        }
        EffectKind::Objects => {
            config.motion.rigid = extent != Extent::Off;
            config.motion.parts &= config.motion.rigid;
        }
        // Off, it leaves a preset that moves opacities as it is; `shape` judges these.
        EffectKind::Appearing => config.model.heads.opacity |= extent != Extent::Off,
        EffectKind::Exposure => config.effects.exposure = extent != Extent::Off,
        EffectKind::Physics => config.effects.physics = extent != Extent::Off,
        EffectKind::Antialiasing => config.antialiased = extent != Extent::Off,
        // Told, and set elsewhere: by the number of times, by the capture, by the background.
        EffectKind::TimePlanes | EffectKind::Lens | EffectKind::Background => {}
    }
}

fn decide(found: &Evidence, config: &TrainConfig, choice: &EffectChoice) -> Vec<Effect> {
    let deformation_mb = deformation_megabytes(config, found);
    let effect =
        |kind: EffectKind, auto: Extent, full: Extent, words: &str, evidence: String, cost: String| {
            let extent = match choice.switched.get(&kind) {
                Some(true) => Extent::Full,
                Some(false) => Extent::Off,
                None => match choice.basis {
                    Basis::All => full,
                    Basis::Auto => auto,
                    Basis::None => Extent::Off,
                },
            };
            let decision = match extent {
                Extent::Off => Decision::Off,
                Extent::Full => Decision::On,
                Extent::Needed => Decision::Value(words.to_owned()),
            };
            let sign = if extent == Extent::Off { '+' } else { '-' };
            let flag = match extent {
                Extent::Needed => format!("--effects +{0} or -{0}", kind.name()),
                _ => format!("--effects {sign}{}", kind.name()),
            };
            Effect { effect: kind, decision, evidence, cost, flag }
        };
    let mut effects = Vec::new();

    let (moves, why) = motion(found);
    let full_motion = if found.times > 1 { Extent::Full } else { Extent::Off };
    let cost = if found.times > 1 {
        format!("more than half of a step, {deformation_mb:.0} MB; in time only for what moves")
    } else {
        "none".to_owned()
    };
    effects.push(effect(
        EffectKind::Motion,
        if moves { Extent::Needed } else { Extent::Off },
        full_motion,
        "where it is",
        why.clone(),
        cost,
    ));
    if found.times < 2 {
        // Nothing can be switched on.
        (effects[0].decision, effects[0].flag) = (Decision::Off, String::new());
    }
    let moves_now = effects[0].decision != Decision::Off;

    let heads = config.model.heads;
    let optional: Vec<&str> = [
        (heads.scale, "scales"),
        (heads.rotation, "rotations"),
        (heads.opacity, "opacities"),
        (heads.sh, "colours"),
    ]
    .into_iter()
    .filter_map(|(on, name)| on.then_some(name))
    .collect();
    if moves_now && !optional.is_empty() {
        effects.push(effect(
            EffectKind::Shape,
            Extent::Needed,
            Extent::Full,
            &format!("{} while they help", optional.join(", ")),
            "judged in training, on pixels that are held out".to_owned(),
            "two layers of the network each".to_owned(),
        ));
    }
    if moves_now {
        let nodes = match config.model.time_resolution {
            0 => automatic_time_nodes(found.times, found.frames),
            nodes => nodes,
        };
        effects.push(Effect {
            effect: EffectKind::TimePlanes,
            decision: Decision::Value(format!("{nodes} nodes")),
            evidence: format!("{} times{}", found.times, speed(found)),
            cost: format!("{:.1} MB", time_plane_megabytes(config, nodes)),
            flag: "--set model.time_resolution=N".to_owned(),
        });
    }

    let degree = config.model.sh_degree;
    if degree > 0 {
        let few = found.view_angle < FEW_DIRECTIONS;
        effects.push(effect(
            EffectKind::ViewDependence,
            if few { Extent::Off } else { Extent::Needed },
            Extent::Full,
            &format!("up to degree {degree} while it helps"),
            if few {
                format!("views differ by {:.1} degrees at most", found.view_angle)
            } else {
                format!(
                    "views differ by up to {:.0} degrees; degrees are judged in training, on pixels that are \
                     held out",
                    found.view_angle
                )
            },
            "720 bytes per Gaussian at degree 3, with gradients and moments".to_owned(),
        ));
    }

    let has_masks = found.masked > 0 && found.instances > 0;
    let extent = if has_masks { Extent::Full } else { Extent::Off };
    let mut instances = effect(
        EffectKind::Instances,
        extent,
        extent,
        "",
        if has_masks {
            format!(
                "{} of {} training frames have masks, of {} instances",
                found.masked, found.frames, found.instances
            )
        } else {
            "no masks".to_owned()
        },
        format!("{} steps, each about an eighth longer than without", config.stages.instance),
    );
    if !has_masks {
        // Nothing can be switched on.
        instances.decision = Decision::Off;
        instances.flag = "--masks NAME".to_owned();
    }
    effects.push(instances);

    if moves_now && has_masks {
        let preset = if heads.opacity { Extent::Full } else { Extent::Off };
        effects.push(effect(
            EffectKind::Appearing,
            if found.appearing.is_empty() { preset } else { Extent::Full },
            preset,
            "",
            if found.appearing.is_empty() {
                "by their masks, none appears or vanishes inside the view".to_owned()
            } else {
                format!("these appear or vanish inside the view: {}", found.appearing.join(", "))
            },
            "opacities that change: two layers of the network".to_owned(),
        ));
        let holds = config.motion.guidance > 0.0 || config.motion.stillness > 0.0;
        let preset = if holds { Extent::Full } else { Extent::Off };
        effects.push(effect(
            EffectKind::Guidance,
            preset,
            preset,
            "",
            match (&found.travelling[..], found.moving_cameras) {
                ([], _) => "no instance travels by its masks: everything is held in place".to_owned(),
                (labels, 1) if found.fixed_cameras == 0 => {
                    format!("one moving camera, and these travel: {}", labels.join(", "))
                }
                (labels, _) => format!("several cameras see what travels: {}", labels.join(", ")),
            },
            format!("{} steps before the fine stage", config.motion.rehearsal),
        ));
        if effects.last().is_some_and(|guidance| guidance.decision != Decision::Off) {
            let preset = if config.motion.rigid { Extent::Needed } else { Extent::Off };
            let (words, why) = objects(found, config);
            let cost = "a fit per object before the fine stage; then poses instead of the network";
            effects.push(effect(EffectKind::Objects, preset, preset, &words, why, cost.to_owned()));
            if let Some(objects) = effects.last_mut().filter(|effect| effect.decision != Decision::Off) {
                objects.flag = "--motion-of 'LABEL=free' or '=rigid', or --effects -objects".to_owned();
            }
        }
    }

    if let Some((cameras, factor)) = found.exposures {
        let preset = if config.effects.exposure { Extent::Full } else { Extent::Off };
        effects.push(effect(
            EffectKind::Exposure,
            if factor >= DISAGREEMENT { Extent::Full } else { preset },
            preset,
            "",
            format!(
                "of {cameras} cameras, two differ by {:.0} % in how bright they record the same points",
                100.0 * (factor - 1.0)
            ),
            "6 numbers per camera".to_owned(),
        ));
    }

    let preset = if config.antialiased { Extent::Full } else { Extent::Off };
    effects.push(effect(
        EffectKind::Antialiasing,
        if found.footprint_ratio >= FOOTPRINTS { Extent::Full } else { preset },
        preset,
        "",
        format!("views differ {:.1} times in pixels per metre", found.footprint_ratio),
        "none; viewers of exported files do not compensate".to_owned(),
    ));
    if found.lenses > 0 {
        effects.push(Effect {
            effect: EffectKind::Lens,
            decision: Decision::On,
            evidence: format!("{} of {} training frames have distortion", found.lenses, found.frames),
            cost: "when images are read".to_owned(),
            flag: String::new(),
        });
    }
    let [red, green, blue] = config.background;
    effects.push(Effect {
        effect: EffectKind::Background,
        decision: Decision::Value(format!("{red} {green} {blue}")),
        evidence: if found.has_alpha {
            "images have alpha and are laid over it".to_owned()
        } else {
            "images are opaque: it shows only where no Gaussian is".to_owned()
        },
        cost: "none".to_owned(),
        flag: "--set background=[R,G,B]".to_owned(),
    });
    if has_masks && effects.iter().any(|e| e.effect == EffectKind::Instances && e.decision != Decision::Off) {
        effects.push(effect(
            EffectKind::Physics,
            if moves_now { Extent::Full } else { Extent::Off },
            Extent::Full,
            "",
            match &found.travelling[..] {
                _ if !moves_now => "nothing moves, so that there is nothing to simulate".to_owned(),
                [] => "instances may move, though none travels by its masks".to_owned(),
                labels => format!("these travel: {}", labels.join(", ")),
            },
            "none in training; in exports one hull per instance".to_owned(),
        ));
    }
    effects
}

/// True when anything may move, and the reason.
fn motion(found: &Evidence) -> (bool, String) {
    if found.times < 2 {
        return (false, "a single time".to_owned());
    }
    match found.change {
        Some(change) if change <= STATIC_CHANGE => {
            (false, format!("{} times, but fixed cameras see nothing change", found.times))
        }
        Some(change) => (
            true,
            format!("{} times; up to {:.1} % of a fixed camera's pixels change", found.times, 100.0 * change),
        ),
        None if !found.travelling.is_empty() => (
            true,
            format!("{} times; by their masks these travel: {}", found.times, found.travelling.join(", ")),
        ),
        None => (true, format!("{} times; the cameras move, so that training must tell", found.times)),
    }
}

/// The motion that is tried for every instance, and why: training decides between poses and the network.
fn objects(found: &Evidence, config: &TrainConfig) -> (String, String) {
    let told = &config.motion.of;
    let untold: Vec<&str> =
        found.travelling.iter().map(String::as_str).filter(|label| !told.contains_key(*label)).collect();
    let mut words = Vec::new();
    if !untold.is_empty() {
        words.push(format!("rigid, if pixels left out agree, else free: {}", untold.join(", ")));
    }
    // What is told is not judged.
    for (name, motion) in [("rigid", ObjectMotion::Rigid), ("free", ObjectMotion::Free)] {
        let labels: Vec<String> = (told.iter().filter(|(_, told)| **told == motion))
            .map(|(label, _)| format!("{label} (told)"))
            .collect();
        if !labels.is_empty() {
            words.push(format!("{name}: {}", labels.join(", ")));
        }
    }
    let rest = found.instances.saturating_sub(untold.len() + told.len());
    let joints = if config.motion.parts { ", unless a joint or a turn in place is found" } else { "" };
    if rest > 0 {
        words.push(format!("static: the other {rest}{joints}"));
    }
    let why = match &found.travelling[..] {
        [] => "by their masks, none travels".to_owned(),
        labels => format!("by their masks these travel: {}", labels.join(", ")),
    };
    (words.join("; "), why)
}

/// Number of travelling instances, in words; empty where none travels.
fn speed(found: &Evidence) -> String {
    match found.travelling.len() {
        0 => String::new(),
        count => format!(", {count} of {} instances travel", found.instances),
    }
}

/// Memory of the deformation with gradients and moments, megabytes.
fn deformation_megabytes(config: &TrainConfig, found: &Evidence) -> f64 {
    let nodes = match config.model.time_resolution {
        0 => automatic_time_nodes(found.times, found.frames),
        nodes => nodes,
    };
    let model = &config.model;
    let spatial: f64 = model
        .multipliers
        .iter()
        .map(|factor| {
            let [x, y, z] = model.spatial_resolution.map(|nodes| f64::from(nodes * factor));
            (x * y + x * z + y * z) * f64::from(model.channels)
        })
        .sum();
    TENSORS * 4.0 * spatial / 1e6 + time_plane_megabytes(config, nodes)
}

/// Values, gradients and two moments.
const TENSORS: f64 = 4.0;

fn time_plane_megabytes(config: &TrainConfig, nodes: u32) -> f64 {
    let model = &config.model;
    let rows = match model.time_encoding {
        TimeEncoding::Compact => nodes - nodes.saturating_sub(1) / 2,
        TimeEncoding::Compat => nodes,
    };
    let columns: f64 = model
        .multipliers
        .iter()
        .map(|factor| model.spatial_resolution.iter().map(|nodes| f64::from(nodes * factor)).sum::<f64>())
        .sum();
    TENSORS * 4.0 * columns * f64::from(rows) * f64::from(model.channels) / 1e6
}

#[cfg(test)]
mod tests;
