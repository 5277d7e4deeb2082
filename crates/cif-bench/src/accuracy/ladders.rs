//! The ladders. A rung changes settings of one base, or what is done with the scene that the base trains.

use cif_render::quality::DRAFT;
use cif_scene::Tolerance;

/// Work of a rung: training, storing, rendering or export.
#[derive(Clone, Debug, PartialEq)]
pub enum Work {
    /// Trains with settings, each `key=value`, over those of the base; none is the base itself.
    Train(Vec<String>),
    /// Trains with another preset.
    Preset {
        /// Its name.
        name: &'static str,
        /// Steps of all stages, with everything that counts in steps, as a share of those of the preset.
        share: f64,
        /// Settings over it, each `key=value`.
        settings: Vec<String>,
    },
    /// Renders the base with the reference, in `f64` or `f32`.
    Reference {
        /// In 64 bits rather than 32.
        double: bool,
    },
    /// Stores parts of the base in 16 bits.
    Store {
        /// Planes and network of the deformation.
        planes: bool,
        /// Everything of the Gaussians but their centres.
        splats: bool,
        /// Their centres.
        centres: bool,
    },
    /// Renders the base with less.
    Render {
        /// Factor by which images are smaller.
        reduction: u32,
        /// Highest degree of colours; none for that of the scene.
        sh_degree: Option<u8>,
        /// Gaussians below are left out.
        min_opacity: f32,
    },
    /// Exports the base inside a tolerance.
    Export(Tolerance),
}

/// One setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Rung {
    /// File name, unique in a report.
    pub id: String,
    /// As tables and plots call it.
    pub label: String,
    /// Work that it does.
    pub work: Work,
}

/// Rungs that change one thing.
#[derive(Clone, Debug, PartialEq)]
pub struct Ladder {
    /// As `--ladders` calls it.
    pub name: &'static str,
    /// Heading.
    pub title: &'static str,
    /// Settings that are changed and kept, in a sentence or two.
    pub about: &'static str,
    /// Ascending cost, as far as that is known before.
    pub rungs: Vec<Rung>,
}

/// Identifier of the rung that trains the base.
pub const BASE: &str = "base";

/// Names of all ladders, in the order of the report.
pub const NAMES: [&str; 13] = [
    "presets",
    PAPER,
    "iterations",
    "resolution",
    "gaussians",
    "deformation",
    "sh",
    "instance",
    "speedups",
    "precision",
    "storage",
    "render",
    "export",
];

/// The ladder of the configuration of the paper, which takes so long that it has to be asked for.
pub const PAPER: &str = "paper";

/// The configuration of the paper as a rung: how much of it there is time for.
#[derive(Clone, Debug, PartialEq)]
pub struct Paper {
    /// Share of its steps, (0, 1].
    pub share: f64,
    /// Settings over it, each `key=value`.
    pub settings: Vec<String>,
}

/// Settings of the base over `draft` in a quick report: enough to show every effect, small enough for minutes.
pub const QUICK_BASE: [&str; 15] = [
    "stages.coarse=60",
    "stages.fine=600",
    "stages.instance=200",
    "model.max_initial_points=2500",
    "model.spatial_resolution=[32,32,32]",
    "model.sh_interval=60",
    "densify.from=60",
    "densify.until=400",
    "densify.every=40",
    "densify.prune_every=40",
    "densify.max_gaussians=3000",
    "resample.from=20",
    "resample.every=20",
    "resample.until=160",
    "report.curve_frames=4",
];

/// Settings of the base that rungs multiply.
#[derive(Clone, Debug, PartialEq)]
pub struct Base {
    /// Fewer rungs.
    pub quick: bool,
    /// Steps: coarse, fine, instance.
    pub steps: [u32; 3],
    /// Last densification, last resampling.
    pub until: [u32; 2],
    /// Most Gaussians.
    pub gaussians: u32,
    /// Most initial points.
    pub points: u32,
    /// Nodes of the planes along x.
    pub nodes: u32,
    /// Network width.
    pub width: u32,
    /// Spherical-harmonics degree.
    pub sh_degree: u8,
    /// Image reduction.
    pub downscale: u32,
    /// The capture moves.
    pub is_dynamic: bool,
    /// The capture has masks.
    pub has_instances: bool,
    /// The instance loss moves Gaussians.
    pub instances_move_geometry: bool,
    /// The configuration of the paper, where it is asked for.
    pub paper: Option<Paper>,
}

fn train(id: &str, label: impl Into<String>, settings: &[String]) -> Rung {
    let work = Work::Train(settings.to_vec());
    Rung { id: if settings.is_empty() { BASE.to_owned() } else { id.to_owned() }, label: label.into(), work }
}

fn rung(id: &str, label: &str, work: Work) -> Rung {
    Rung { id: id.to_owned(), label: label.to_owned(), work }
}

/// All ladders that say something of such a base; those that train come first.
#[must_use]
pub fn ladders(base: &Base) -> Vec<Ladder> {
    NAMES.iter().map(|name| ladder(name, base)).filter(|ladder| ladder.rungs.len() > 1).collect()
}

/// Title, description and rungs of a ladder.
type Parts = (&'static str, &'static str, Vec<Rung>);

fn ladder(name: &'static str, base: &Base) -> Ladder {
    let (title, about, rungs) = match name {
        "presets" => presets(base),
        PAPER => paper(base),
        "iterations" => iterations(base),
        "resolution" => resolution(base),
        "gaussians" => gaussians(base),
        "deformation" => deformation(base),
        "sh" => sh(base),
        "instance" => instance(base),
        "speedups" => speedups(base),
        "precision" => precision(),
        "storage" => storage(),
        "render" => render(),
        _ => export(),
    };
    Ladder { name, title, about, rungs }
}

/// The factors of a ladder; fewer in a quick report.
fn factors(base: &Base, all: &[f64], few: &[f64]) -> Vec<f64> {
    if base.quick { few.to_vec() } else { all.to_vec() }
}

/// A setting of the base times a factor; at least 1.
fn scaled(value: u32, factor: f64) -> u32 {
    (f64::from(value) * factor).round().max(1.0) as u32
}

/// Named settings.
fn presets(base: &Base) -> Parts {
    let whole = |name| Work::Preset { name, share: 1.0, settings: Vec::new() };
    let named = |name: &'static str| rung(&format!("preset-{name}"), name, whole(name));
    let rungs = if base.quick {
        vec![train("", "quick base", &[]), named("draft")]
    } else {
        vec![named("draft"), named("standard"), named("best")]
    };
    ("Presets", "Named settings, all of them at once.", rungs)
}

/// The configuration of the paper.
fn paper(base: &Base) -> Parts {
    let rungs = base.paper.as_ref().map_or_else(Vec::new, |Paper { share, settings }| {
        let percent = format!("{:.3}", 100.0 * share);
        let percent = percent.trim_end_matches('0').trim_end_matches('.');
        let label = match *share < 1.0 {
            true => format!("paper, {percent} % of its steps"),
            false => "paper".to_owned(),
        };
        let work = Work::Preset { name: PAPER, share: *share, settings: settings.clone() };
        vec![train("", "base", &[]), rung(PAPER, &label, work)]
    });
    (
        "The paper's configuration",
        "The preset `paper` for the layout of the capture: batch, planes, network, losses, densification and rates \
         as published. Where its row says so, it has a share of the published steps, with everything that counts in \
         steps shortened alike, or the settings named there; without, it is whole.",
        rungs,
    )
}

/// Steps of all stages.
fn iterations(base: &Base) -> Parts {
    (
        "Iterations",
        "Steps of all stages, with everything that counts in steps stretched alike.",
        factors(base, &[0.25, 0.5, 1.0, 2.0], &[0.5, 1.0, 2.0])
            .into_iter()
            .map(|factor| {
                let [coarse, fine, instance] = base.steps.map(|steps| scaled(steps, factor));
                let [densify, resample] = base.until.map(|step| scaled(step, factor));
                let settings: Vec<String> = [
                    format!("stages.coarse={coarse}"),
                    format!("stages.fine={fine}"),
                    format!("stages.instance={instance}"),
                    format!("densify.until={densify}"),
                    format!("resample.until={resample}"),
                ]
                .into();
                let label = format!("{} steps", coarse + fine + instance);
                let settings = if factor == 1.0 { &[][..] } else { &settings };
                train(&format!("iterations-{factor}"), label, settings)
            })
            .collect(),
    )
}

/// Size of the training images.
fn resolution(base: &Base) -> Parts {
    (
        "Resolution",
        "Training images reduced; scored on the images of the base all the same.",
        factors(base, &[4.0, 2.0, 1.0], &[2.0, 1.0])
            .into_iter()
            .map(|factor| {
                let downscale = scaled(base.downscale, factor);
                let settings = [format!("downscale={downscale}")];
                let label = if factor == 1.0 { "full".to_owned() } else { format!("1/{factor}") };
                let settings = if factor == 1.0 { &[][..] } else { &settings };
                train(&format!("resolution-{factor}"), label, settings)
            })
            .collect(),
    )
}

/// Number of Gaussians.
fn gaussians(base: &Base) -> Parts {
    (
        "Gaussians",
        "The most Gaussians that densification may add up to, and no more points to begin with.",
        factors(base, &[0.25, 0.5, 1.0, 2.0], &[0.5, 1.0, 2.0])
            .into_iter()
            .map(|factor| {
                let most = scaled(base.gaussians, factor);
                let settings = [
                    format!("densify.max_gaussians={most}"),
                    format!("model.max_initial_points={}", base.points.min(most)),
                ];
                let settings = if factor == 1.0 { &[][..] } else { &settings };
                train(&format!("gaussians-{factor}"), most.to_string(), settings)
            })
            .collect(),
    )
}

/// Size of the deformation.
fn deformation(base: &Base) -> Parts {
    let nodes = |count: u32| format!("model.spatial_resolution=[{count},{count},{count}]");
    let half = base.nodes / 2;
    let width = |width: u32| format!("model.width={width}");
    let mut rungs = vec![
        train(
            "deformation-none",
            "none",
            &[
                format!("stages.coarse={}", base.steps[0] + base.steps[1]),
                "stages.fine=0".to_owned(),
                format!("rates.schedule_steps={}", base.steps.iter().sum::<u32>()),
            ],
        ),
        train(
            "deformation-small",
            format!("planes {half}, width {}", base.width / 2),
            &[nodes(half), width(base.width / 2)],
        ),
        train("deformation-planes-half", format!("planes {half}"), &[nodes(half)]),
    ];
    if !base.quick {
        rungs.push(train("deformation-channels", "8 channels", &["model.channels=8".to_owned()]));
    }
    rungs.push(train("", format!("planes {}, width {}", base.nodes, base.width), &[]));
    rungs.push(train("deformation-wide", format!("width {}", base.width * 2), &[width(base.width * 2)]));
    (
        "Deformation",
        "Nodes of the feature planes and width of the network that move Gaussians.",
        if base.is_dynamic { rungs } else { Vec::new() },
    )
}

/// Degree of the colours.
fn sh(base: &Base) -> Parts {
    (
        "View-dependent colour",
        "Highest degree of the spherical harmonics.",
        (0..=base.sh_degree)
            .filter(|degree| !base.quick || [0, 1, base.sh_degree].contains(degree))
            .map(|degree| {
                let settings = [format!("model.sh_degree={degree}")];
                let settings = if degree == base.sh_degree { &[][..] } else { &settings };
                train(&format!("sh-{degree}"), format!("degree {degree}"), settings)
            })
            .collect(),
    )
}

/// Steps of the instance stage.
fn instance(base: &Base) -> Parts {
    (
        "Instance stage",
        "Steps with instances, after one and the same reconstruction.",
        if base.has_instances {
            factors(base, &[0.2, 0.5, 1.0, 2.0], &[0.25, 1.0, 2.0])
                .into_iter()
                .map(|factor| {
                    let steps = scaled(base.steps[2], factor);
                    let until = scaled(base.until[1], factor);
                    let settings = [format!("stages.instance={steps}"), format!("resample.until={until}")];
                    let settings = if factor == 1.0 { &[][..] } else { &settings };
                    train(&format!("instance-{factor}"), format!("{steps} steps"), settings)
                })
                .collect()
        } else {
            Vec::new()
        },
    )
}

/// Approximations.
fn speedups(base: &Base) -> Parts {
    ("Approximations", "Settings that save or cost time in training, one by one.", {
        let mut rungs = vec![train("", "none", &[])];
        let one = |id: &str, label: &str, setting: &str| train(id, label, &[setting.to_owned()]);
        if base.has_instances {
            rungs.push(one("speedup-stride", "identities from every 4th frame", "identity.stride=4"));
            rungs.push(if base.instances_move_geometry {
                one("geometry-off", "instances leave geometry alone", "instance.geometry=off")
            } else {
                one("geometry-full", "instances move geometry", "instance.geometry=full")
            });
        }
        rungs.push(one("speedup-visible", "only visible rows move", "adam.visible_rows_only=true"));
        rungs
    })
}

/// Precision of rendering.
fn precision() -> Parts {
    (
        "Precision",
        "One held-out frame of the base, rendered by the fast path in 32 bits and by the readable \
         reference in 32 and 64 bits. The residual is the largest difference of a colour to 64 bits.",
        vec![
            rung(
                "precision-fast",
                "fast path, f32",
                Work::Render { reduction: 1, sh_degree: None, min_opacity: 0.0 },
            ),
            rung("precision-f32", "reference, f32", Work::Reference { double: false }),
            rung("precision-f64", "reference, f64", Work::Reference { double: true }),
        ],
    )
}

/// Precision of stored parameters.
fn storage() -> Parts {
    (
        "Storage",
        "Parameters of the base rounded to 16-bit floats, then scored; bytes are those of the parameters.",
        vec![
            rung("storage-all", "all in f16", Work::Store { planes: true, splats: true, centres: true }),
            rung(
                "storage-but-centres",
                "all but centres in f16",
                Work::Store { planes: true, splats: true, centres: false },
            ),
            rung(
                "storage-planes",
                "deformation in f16",
                Work::Store { planes: true, splats: false, centres: false },
            ),
            rung("storage-f32", "all in f32", Work::Store { planes: false, splats: false, centres: false }),
        ],
    )
}

/// Quality of rendering.
fn render() -> Parts {
    (
        "Rendering",
        "Held-out frames of the base rendered with less. The residual is the largest difference of a \
         colour to the final quality; seconds are those of a frame.",
        vec![
            rung(
                "render-half",
                "half size",
                Work::Render { reduction: 2, sh_degree: None, min_opacity: 0.0 },
            ),
            rung(
                "render-draft",
                "draft: opacity from 0.3",
                Work::Render { reduction: 1, sh_degree: None, min_opacity: DRAFT.min_opacity },
            ),
            rung(
                "render-opaque",
                "opacity from 0.1",
                Work::Render { reduction: 1, sh_degree: None, min_opacity: 0.1 },
            ),
            rung(
                "render-degree",
                "degree 1",
                Work::Render { reduction: 1, sh_degree: Some(1), min_opacity: 0.0 },
            ),
            rung("render-final", "final", Work::Render { reduction: 1, sh_degree: None, min_opacity: 0.0 }),
        ],
    )
}

/// Tolerance of exported motion.
fn export() -> Parts {
    (
        "Export tolerance",
        "Motion of objects in a glTF file inside a tolerance, percent of each object's size. The residual is \
         the largest decisive one, world units; bytes are those of the file, seconds those of building and \
         writing it.",
        [10.0, 3.0, 1.0, 0.3]
            .into_iter()
            .map(|percent| {
                rung(
                    &format!("export-{percent}"),
                    &format!("{percent} %"),
                    Work::Export(Tolerance::Percent(percent)),
                )
            })
            .collect(),
    )
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn base(quick: bool) -> Base {
        Base {
            quick,
            steps: [300, 7_000, 1_500],
            until: [4_000, 1_250],
            gaussians: 12_000,
            points: 20_000,
            nodes: 64,
            width: 64,
            sh_degree: 3,
            downscale: 1,
            is_dynamic: true,
            has_instances: true,
            instances_move_geometry: false,
            paper: None,
        }
    }

    #[test]
    fn every_ladder_has_rungs_and_equal_files_do_equal_work() {
        for quick in [true, false] {
            let paper = Some(Paper { share: 0.125, settings: vec!["downscale=1".to_owned()] });
            let all = ladders(&Base { paper, ..base(quick) });
            assert_eq!(all.iter().map(|ladder| ladder.name).collect::<Vec<_>>(), NAMES);
            let mut work: BTreeMap<String, Work> = BTreeMap::new();
            for rung in all.iter().flat_map(|ladder| &ladder.rungs) {
                let first = work.entry(rung.id.clone()).or_insert_with(|| rung.work.clone());
                assert_eq!(*first, rung.work, "{}", rung.id);
            }
            assert_eq!(work[BASE], Work::Train(Vec::new()));
        }
    }

    #[test]
    fn the_configuration_of_the_paper_is_a_rung_where_it_is_asked_for() {
        assert!(ladders(&base(false)).iter().all(|ladder| ladder.name != PAPER));
        let with = |share| Base { paper: Some(Paper { share, settings: Vec::new() }), ..base(false) };
        let rungs =
            |share| ladders(&with(share)).into_iter().find(|ladder| ladder.name == PAPER).unwrap().rungs;
        assert_eq!(rungs(0.125)[1].label, "paper, 12.5 % of its steps");
        assert_eq!((&rungs(1.0)[1].label[..], &rungs(1.0)[0].id[..]), ("paper", BASE));
        let work = Work::Preset { name: "paper", share: 0.125, settings: Vec::new() };
        assert_eq!(rungs(0.125)[1].work, work);
    }

    #[test]
    fn a_still_capture_without_masks_has_fewer_ladders() {
        let still = Base { is_dynamic: false, has_instances: false, ..base(true) };
        let names: Vec<&str> = ladders(&still).iter().map(|ladder| ladder.name).collect();
        assert!(!names.contains(&"deformation") && !names.contains(&"instance"), "{names:?}");
    }
}
