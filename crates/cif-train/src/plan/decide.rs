//! Decisions on effects, by what a capture shows and what the user says instead.

use cif_field::TimeEncoding;
use cif_geometry::spherical_harmonics::coefficient_count;

use super::choice::{Basis, EffectChoice};
use super::effect::{Decision, Effect, EffectKind, Extent};
use super::evidence::Evidence;
use crate::config::{ObjectMotion, TrainConfig};
use crate::trainer::automatic_time_nodes;
use crate::working_size;

/// Share of changed pixels up to which a fixed camera sees nothing move.
const STATIC_CHANGE: f64 = 5e-4;

/// Angle between views up to which colour cannot be shown to depend on the view, degrees.
const FEW_DIRECTIONS: f64 = 4.0;

/// Highest degree of spherical harmonics whose coefficients, `(degree + 1)^2` per channel, as many places determine.
pub(super) fn determined_degree(places: usize) -> u8 {
    (1..=3).take_while(|degree| coefficient_count(*degree) <= places).last().unwrap_or(0)
}

/// Ratio of footprints from which the low-pass filter of the nearest views would hide detail, or that of the
/// farthest would thicken it.
const FOOTPRINTS: f64 = 4.0;

/// Factor between cameras, or times of one, in how bright they record the same points from which they disagree: of
/// 11 rendered captures without a drift up to 1.06, of three with the drift of a phone 1.17 and more.
const DISAGREEMENT: f64 = 1.1;

/// An effect before it is decided on.
struct Case {
    kind: EffectKind,
    /// Extent that the capture calls for, and that the preset has.
    auto: Extent,
    full: Extent,
    /// Extent in words, where it is used only as far as needed.
    words: String,
    evidence: String,
    cost: String,
}

/// Decisions on the effects of a capture, in the order of [`EffectKind`].
pub(super) fn decide(found: &Evidence, config: &TrainConfig, choice: &EffectChoice) -> Vec<Effect> {
    let plan = Plan { found, config, choice };
    let motion = plan.motion();
    let moves = motion.decision != Decision::Off;
    let has_masks = found.masked > 0 && found.instances > 0;
    let mut effects = vec![motion];
    if moves {
        effects.extend(plan.shape());
        effects.push(plan.time_planes());
    }
    effects.push(plan.image_size());
    effects.extend(plan.view_dependence());
    let instances = plan.instances(has_masks);
    let has_instances = instances.decision != Decision::Off;
    effects.push(instances);
    if moves && has_masks {
        effects.push(plan.appearing());
        let guidance = plan.guidance();
        let is_guided = guidance.decision != Decision::Off;
        effects.push(guidance);
        effects.extend(is_guided.then(|| plan.objects()));
    }
    effects.extend(plan.exposure());
    effects.extend(plan.exposure_in_time());
    effects.push(plan.antialiasing());
    effects.extend(plan.lens());
    effects.push(plan.background());
    if has_masks && has_instances {
        effects.push(plan.physics(moves));
    }
    effects
}

/// Evidence and settings that decisions are made from.
struct Plan<'a> {
    found: &'a Evidence,
    config: &'a TrainConfig,
    choice: &'a EffectChoice,
}

impl Plan<'_> {
    /// Decides on an effect: as the user says of it, else as the basis of the choice does.
    fn decided(&self, case: Case) -> Effect {
        let Case { kind, auto, full, words, evidence, cost } = case;
        let extent = match self.choice.switched.get(&kind) {
            Some(true) => Extent::Full,
            Some(false) => Extent::Off,
            None => match self.choice.basis {
                Basis::All => full,
                Basis::Auto => auto,
                Basis::None => Extent::Off,
            },
        };
        let decision = match extent {
            Extent::Off => Decision::Off,
            Extent::Full => Decision::On,
            Extent::Needed => Decision::Value(words),
        };
        let sign = if extent == Extent::Off { '+' } else { '-' };
        let flag = match extent {
            Extent::Needed => format!("--effects +{0} or -{0}", kind.name()),
            _ => format!("--effects {sign}{}", kind.name()),
        };
        Effect { effect: kind, decision, evidence, cost, flag }
    }

    fn motion(&self) -> Effect {
        let found = self.found;
        let (moves, evidence) = motion(found);
        let has_times = found.times > 1;
        let megabytes = deformation_megabytes(self.config, found);
        let mut effect = self.decided(Case {
            kind: EffectKind::Motion,
            auto: if moves { Extent::Needed } else { Extent::Off },
            full: if has_times { Extent::Full } else { Extent::Off },
            words: "where it is".to_owned(),
            evidence,
            cost: if has_times {
                format!("more than half of a step, {megabytes:.0} MB; in time only for what moves")
            } else {
                "none".to_owned()
            },
        });
        if !has_times {
            // Nothing can be switched on.
            (effect.decision, effect.flag) = (Decision::Off, String::new());
        }
        effect
    }

    /// Nothing where the preset has no outputs other than the centres.
    fn shape(&self) -> Option<Effect> {
        let heads = self.config.model.heads;
        let optional: Vec<&str> = [
            (heads.scale, "scales"),
            (heads.rotation, "rotations"),
            (heads.opacity, "opacities"),
            (heads.sh, "colours"),
        ]
        .into_iter()
        .filter_map(|(on, name)| on.then_some(name))
        .collect();
        let case = || Case {
            kind: EffectKind::Shape,
            auto: Extent::Needed,
            full: Extent::Full,
            words: format!("{} while they help", optional.join(", ")),
            evidence: "judged in training, on pixels that are held out".to_owned(),
            cost: "two layers of the network each".to_owned(),
        };
        (!optional.is_empty()).then(|| self.decided(case()))
    }

    fn time_planes(&self) -> Effect {
        let nodes = time_nodes(self.config, self.found);
        Effect {
            effect: EffectKind::TimePlanes,
            decision: Decision::Value(format!("{nodes} nodes")),
            evidence: format!("{} times{}", self.found.times, speed(self.found)),
            cost: format!("{:.1} MB", time_plane_megabytes(self.config, nodes)),
            flag: "--set model.time_resolution=N".to_owned(),
        }
    }

    fn image_size(&self) -> Effect {
        let ([width, height], stages) = (self.found.image_size, &self.config.stages);
        let reduction = working_size::of_size([width, height], self.config);
        let [small, low] = working_size::reduced_size([width, height], reduction);
        let per_gaussian =
            f64::from(width) * f64::from(height) / f64::from(self.config.densify.max_gaussians);
        Effect {
            effect: EffectKind::ImageSize,
            decision: Decision::Value(match reduction {
                1 => "whole".to_owned(),
                _ => format!(
                    "{small} x {low}, and whole in the last {:.0} % of the fine steps",
                    100.0 * stages.whole_size
                ),
            }),
            evidence: format!("{width} x {height} pixels, {per_gaussian:.1} for each Gaussian of a full set"),
            cost: "the time of a step grows with its pixels, most where images are large".to_owned(),
            flag: "--set stages.reduction=N".to_owned(),
        }
    }

    /// Nothing where the preset has no degree above 0.
    fn view_dependence(&self) -> Option<Effect> {
        let Evidence { view_angle: angle, places, .. } = *self.found;
        let asked = self.config.model.sh_degree;
        let degree = asked.min(determined_degree(places));
        let few = angle < FEW_DIRECTIONS || degree == 0;
        let case = || Case {
            kind: EffectKind::ViewDependence,
            auto: if few { Extent::Off } else { Extent::Needed },
            full: Extent::Full,
            words: format!("up to degree {degree} while it helps"),
            evidence: if few {
                format!("views differ by {angle:.1} degrees at most, from {places} places")
            } else {
                format!(
                    "views from {places} places differ by up to {angle:.0} degrees; degrees are judged in training, on \
                     pixels that are held out"
                )
            },
            cost: "720 bytes per Gaussian at degree 3, with gradients and moments".to_owned(),
        };
        (asked > 0).then(|| self.decided(case()))
    }

    fn instances(&self, has_masks: bool) -> Effect {
        let found = self.found;
        let extent = if has_masks { Extent::Full } else { Extent::Off };
        let mut effect = self.decided(Case {
            kind: EffectKind::Instances,
            auto: extent,
            full: extent,
            words: String::new(),
            evidence: if has_masks {
                format!(
                    "{} of {} training frames have masks, of {} instances",
                    found.masked, found.frames, found.instances
                )
            } else {
                "no masks".to_owned()
            },
            cost: format!("{} steps, each about an eighth longer than without", self.config.stages.instance),
        });
        if !has_masks {
            // Nothing can be switched on.
            effect.decision = Decision::Off;
            effect.flag = "--masks NAME".to_owned();
        }
        effect
    }

    fn appearing(&self) -> Effect {
        let appearing = &self.found.appearing;
        let preset = if self.config.model.heads.opacity { Extent::Full } else { Extent::Off };
        self.decided(Case {
            kind: EffectKind::Appearing,
            auto: if appearing.is_empty() { preset } else { Extent::Full },
            full: preset,
            words: String::new(),
            evidence: if appearing.is_empty() {
                "by their masks, none appears or vanishes inside the view".to_owned()
            } else {
                format!("these appear or vanish inside the view: {}", appearing.join(", "))
            },
            cost: "opacities that change: two layers of the network".to_owned(),
        })
    }

    fn guidance(&self) -> Effect {
        let motion = &self.config.motion;
        let holds = motion.guidance > 0.0 || motion.stillness > 0.0;
        let preset = if holds { Extent::Full } else { Extent::Off };
        self.decided(Case {
            kind: EffectKind::Guidance,
            auto: preset,
            full: preset,
            words: String::new(),
            evidence: match (&self.found.travelling[..], self.found.moving_cameras) {
                ([], _) => "no instance travels by its masks: everything is held in place".to_owned(),
                (labels, 1) if self.found.fixed_cameras == 0 => {
                    format!("one moving camera, and these travel: {}", labels.join(", "))
                }
                (labels, _) => format!("several cameras see what travels: {}", labels.join(", ")),
            },
            cost: format!("{} steps before the fine stage", motion.rehearsal),
        })
    }

    fn objects(&self) -> Effect {
        let preset = if self.config.motion.rigid { Extent::Needed } else { Extent::Off };
        let (words, evidence) = objects(self.found, self.config);
        let cost = "a fit per object before the fine stage; then poses instead of the network".to_owned();
        let kind = EffectKind::Objects;
        let mut effect = self.decided(Case { kind, auto: preset, full: preset, words, evidence, cost });
        if effect.decision != Decision::Off {
            effect.flag = "--motion-of 'LABEL=free' or '=rigid', or --effects -objects".to_owned();
        }
        effect
    }

    /// Nothing where cameras cannot be compared.
    fn exposure(&self) -> Option<Effect> {
        let found = self.found.exposures.filter(|found| found.cameras > 1)?;
        Some(self.exposed(
            EffectKind::Exposure,
            found.between_cameras,
            self.config.effects.exposure,
            &format!("of {} cameras, two differ by", found.cameras),
            "camera",
        ))
    }

    fn exposure_in_time(&self) -> Option<Effect> {
        let factor = self.found.exposures?.in_time?;
        Some(self.exposed(
            EffectKind::ExposureInTime,
            factor,
            self.config.effects.exposure_in_time,
            "two images of a camera differ by",
            "training image",
        ))
    }

    /// Exposures, by a factor in how bright the same points are recorded.
    fn exposed(&self, kind: EffectKind, factor: f64, is_preset: bool, who: &str, each: &str) -> Effect {
        let preset = if is_preset { Extent::Full } else { Extent::Off };
        self.decided(Case {
            kind,
            auto: if factor >= DISAGREEMENT { Extent::Full } else { preset },
            full: preset,
            words: String::new(),
            evidence: format!(
                "{who} {:.0} % in how bright they record the same points",
                100.0 * (factor - 1.0)
            ),
            cost: format!("6 numbers per {each}"),
        })
    }

    fn antialiasing(&self) -> Effect {
        let preset = if self.config.antialiased { Extent::Full } else { Extent::Off };
        let ratio = self.found.footprint_ratio;
        self.decided(Case {
            kind: EffectKind::Antialiasing,
            auto: if ratio >= FOOTPRINTS { Extent::Full } else { preset },
            full: preset,
            words: String::new(),
            evidence: format!("views differ {ratio:.1} times in pixels per metre"),
            cost: "none; viewers of exported files do not compensate".to_owned(),
        })
    }

    fn lens(&self) -> Option<Effect> {
        let found = self.found;
        (found.lenses > 0).then(|| Effect {
            effect: EffectKind::Lens,
            decision: Decision::On,
            evidence: format!("{} of {} training frames have distortion", found.lenses, found.frames),
            cost: "when images are read".to_owned(),
            flag: String::new(),
        })
    }

    fn background(&self) -> Effect {
        let given = |[red, green, blue]: [f32; 3]| format!("{red} {green} {blue}");
        Effect {
            effect: EffectKind::Background,
            decision: Decision::Value(self.config.background.map_or("automatic".to_owned(), given)),
            evidence: match self.config.background {
                None if self.found.has_alpha => "images have alpha: white, where some of it is transparent",
                Some(_) if self.found.has_alpha => "images have alpha and are laid over it",
                None => "images are opaque: the mean colour at their borders, or that of a backdrop",
                Some(_) => "images are opaque: it shows only where no Gaussian is",
            }
            .to_owned(),
            cost: "none".to_owned(),
            flag: "--set background=[R,G,B]".to_owned(),
        }
    }

    fn physics(&self, moves: bool) -> Effect {
        self.decided(Case {
            kind: EffectKind::Physics,
            auto: if moves { Extent::Full } else { Extent::Off },
            full: Extent::Full,
            words: String::new(),
            evidence: match &self.found.travelling[..] {
                _ if !moves => "nothing moves, so that there is nothing to simulate".to_owned(),
                [] => "instances may move, though none travels by its masks".to_owned(),
                labels => format!("these travel: {}", labels.join(", ")),
            },
            cost: "none in training; in exports one hull per instance".to_owned(),
        })
    }
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
pub(super) fn objects(found: &Evidence, config: &TrainConfig) -> (String, String) {
    let declared = &config.motion.of;
    let undeclared: Vec<&str> =
        found.travelling.iter().map(String::as_str).filter(|label| !declared.contains_key(*label)).collect();
    let mut words = Vec::new();
    if !undeclared.is_empty() {
        words.push(format!("rigid, if pixels left out agree, else free: {}", undeclared.join(", ")));
    }
    // What is declared is not judged.
    for (name, motion) in [("rigid", ObjectMotion::Rigid), ("free", ObjectMotion::Free)] {
        let labels: Vec<String> = (declared.iter().filter(|(_, declared)| **declared == motion))
            .map(|(label, _)| format!("{label} (told)"))
            .collect();
        if !labels.is_empty() {
            words.push(format!("{name}: {}", labels.join(", ")));
        }
    }
    let rest = found.instances.saturating_sub(undeclared.len() + declared.len());
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

/// Nodes of the time planes.
fn time_nodes(config: &TrainConfig, found: &Evidence) -> u32 {
    match config.model.time_resolution {
        0 => automatic_time_nodes(found.times, found.frames),
        nodes => nodes,
    }
}

/// Memory of the deformation with gradients and moments, megabytes.
fn deformation_megabytes(config: &TrainConfig, found: &Evidence) -> f64 {
    let nodes = time_nodes(config, found);
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
