//! `cif query`: where is an object, and what is at a place?

mod by_masks;
mod by_text;
mod trajectory;

use std::path::PathBuf;

use cif_field::Field;
use cif_geometry::Bounds;
use cif_scene::{ObjectMatch, ObjectQuery, ReadOptions, SceneOptions, When};
use clap::Args;
use glam::{DMat3, DQuat, DVec3};
use serde_json::json;

use super::shared::scene;
use crate::error::Error;
use crate::formats::Content;
use crate::moment::{Frames, Interval, Moment, note_fraction};
use crate::output::Outputs;
use crate::report::Report;

const HELP: &str = "\
Without conditions every object is listed; several conditions must all hold. Labels match the name,
class or unique name of an object; case does not matter, * stands for any characters and ? for one.
Boxes hold the splats to three standard deviations; volumes are those of the colliders, where there
are any, else of the boxes; speeds are world units per second. Stages of other programs need semantic
labels only.
Times are frames as captured, in a .cif as in what is exported of it: time codes of stages. With a suffix they are
seconds after the first frame or a share of the whole.

  cif query table.usda --label 'red mug' --time 36
  cif query table.cif --label 'red mug' --time 1.5s
  cif query table.usda --taxonomy class --label mug --interval 0:20
  cif query table.usda --label mug --interval 50%:100%
  cif query table.cif --taxonomy wikidata_qcode=Q81727
  cif query table.glb --box -0.2,-0.2,0,0.2,0.2,0.3
  cif query table.cif --label '*box' --json
  cif query table.cif --point 0.1,0.2,0.05 --time 50%

Paths: object, label and class; the frame (time code), the time from 0 to 1 and in seconds; the origin of
the object's frame (x, y, z; world units) and its rotation (quaternion qw, qx, qy, qz; from its own axes to
the world's, unturned at the first frame); visible, 0 while it is hidden. Parts go with the largest one,
and what bends has the path of the rigid body that fits it best.

  cif query table.cif --label 'red mug' --trajectory mug.csv
  cif query table.usda --trajectory

By words: with --models, the objects whose embeddings (cif embed) are nearest to the text; those with a
* are nearer to it than to texts of anything. Else those that have most of the words in their names.

  cif query table.usda --text 'something to drink from' --models models
  cif query table.usda --text 'red mug'

By masks: DIR holds what a 2D detector found on frames of the capture, as PNG files (black = not
found) named FRAME.png, FRAME_*.png or FRAME/*.png. Instances are chosen that lie mostly inside the
masks of training frames; --eval renders them from held-out frames and compares with the masks there.

  cif query table.cif --masks found --capture captures/table --eval

By a prompt: Grounding DINO finds boxes (scores above 0.3) and SAM the masks in them, both ONNX models of
yours; --json lists the boxes, with the words that score above 0.45. Masks are kept in
CAPTURE/.cif-cache. Or a command of your own makes them.

  cif query table.cif --prompt 'steel jug' --capture captures/table --models models
  cif query table.cif --prompt 'steel jug' --capture captures/table --models models \\
      --protocol grouping --eval
  cif query table.cif --prompt 'steel jug' --capture captures/table \\
      --detector 'python detect.py --text {prompt} --in {frames} --out {masks}'

Models are run by ONNX Runtime (pip install 'cif4d[vision]', or ORT_DYLIB_PATH); nothing is downloaded.
Their folder has a file such as this, with the names of your exports:

";

fn help() -> String {
    format!("{HELP}{}", cif_vision::models::EXAMPLE)
}

/// Find objects by label, time, place, or masks; or show what is at a place
#[derive(Debug, Args)]
#[command(after_help = help())]
pub(super) struct Query {
    /// Trained scene (.cif), or a file of any format that cif export writes
    #[arg(value_name = "FILE")]
    path: PathBuf,
    /// Label to look for
    #[arg(long, value_name = "PATTERN")]
    label: Option<String>,
    /// Labels that count: class (classes and human labels), instance (unique names), or another taxonomy of the
    /// instances; NAME=PATTERN also gives the label to look for
    #[arg(long, value_name = "NAME[=PATTERN]")]
    taxonomy: Option<String>,
    /// Place in the world: what is there, with its probability in a .cif
    #[arg(
        long,
        alias = "at",
        value_name = "X,Y,Z",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    point: Option<Vec<f64>>,
    /// Box in the world that objects touch, by two opposite corners
    #[arg(
        long = "box",
        value_name = "X,Y,Z,X,Y,Z",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    region: Option<Vec<f64>>,
    /// Time: a frame (36), seconds (1.5s) or a share (50%) [default: the first frame]
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    time: Option<Moment>,
    /// Interval of time: objects that are there at any time in it
    #[arg(long, value_name = "FROM:TO", conflicts_with = "time", allow_hyphen_values = true)]
    interval: Option<Interval>,
    /// Words that describe what to look for: by embeddings, where the file has some (cif embed) and --models are
    /// given, else by the words of labels, classes and taxonomies
    #[arg(long, value_name = "TEXT", conflicts_with_all = ["label", "taxonomy", "masks"])]
    text: Option<String>,
    /// Folder of ONNX models with a models.toml, which answer --prompt and --text
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Read layers that a stage brings in from outside its folder
    #[arg(long)]
    follow_external: bool,
    /// Write the path of every object found, a row per captured frame, as CSV [default: to stdout]
    #[arg(
        long,
        value_name = "FILE.csv",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "-",
        conflicts_with_all = ["json", "time", "interval", "point", "region", "text", "masks", "prompt"]
    )]
    trajectory: Option<PathBuf>,
    #[command(flatten)]
    pub(super) report: Report,
    /// Replace an existing file of --json or --trajectory
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    by_masks: by_masks::ByMasks,
}

impl Query {
    /// True where paths go into a file.
    pub(super) fn writes_trajectory(&self) -> bool {
        self.trajectory.as_deref().is_some_and(|file| !crate::output::is_stdout(file))
    }
}

pub(super) fn run(command: &Query) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.path)?;
    command.report.check(&mut outputs)?;
    if command.by_masks.is_asked() {
        return by_masks::run(command);
    }
    if command.models.is_some() && command.text.is_none() {
        return Err(Error::usage(
            "--models answers --prompt and --text",
            "add --text TEXT, or --prompt TEXT --capture CAPTURE",
        ));
    }
    let is_field = matches!(Content::of(&command.path)?, Content::Field);
    let wanted = question(command)?;
    if let Some(file) = &command.trajectory {
        return trajectory::run(command, file, &wanted);
    }
    if let (true, Some(place)) = (is_field, wanted.point) {
        let others = wanted.label.is_some() || wanted.region.is_some();
        if others || command.interval.is_some() || command.text.is_some() {
            return Err(Error::usage(
                "--point in a .cif asks the field itself, without other conditions than --time",
                "leave --label, --text, --box and --interval out, or query an exported stage",
            ));
        }
        return at(command, place);
    }
    if let Some(text) = &command.text {
        return by_text::run(command, text, wanted);
    }
    let place = command.path.display().to_string();
    let found = search(command, wanted)?;
    command.report.give(
        || json!(found),
        || match found.as_slice() {
            [] => println!("nothing is there in {place}"),
            found => print_table(found),
        },
    )
}

/// Objects of the file that meet every condition.
fn search(command: &Query, mut wanted: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    match Content::of(&command.path)? {
        Content::Field => in_scene(command, wanted),
        Content::Graph(format) => {
            let options = ReadOptions { follow_external: command.follow_external };
            if command.time.is_some() || command.interval.is_some() {
                let range = format.code_range(&command.path, options).map_err(Error::plain)?;
                wanted.when = when(command, &Frames::new(range, &command.path.display().to_string()))?;
            }
            format.search(&command.path, &wanted, options).map_err(Error::plain)
        }
    }
}

/// Time or interval of the command line, in the time codes of what is asked.
fn when(command: &Query, frames: &Frames<'_>) -> Result<When, Error> {
    Ok(match (command.time, command.interval) {
        (Some(time), _) => {
            note_fraction("--time", time);
            When::At(frames.code("--time", time)?)
        }
        (None, Some(interval)) => {
            let (from, to) = frames.interval("--interval", interval)?;
            When::Over(from, to)
        }
        (None, None) => When::Default,
    })
}

/// The conditions of the command line but that of time, for which the file has to be read.
fn question(command: &Query) -> Result<ObjectQuery, Error> {
    let point = command.point.as_deref().map(|numbers| corner("--point", numbers)).transpose()?;
    let region = match command.region.as_deref() {
        None => None,
        Some(&[ax, ay, az, bx, by, bz]) => {
            let (a, b) = (corner("--box", &[ax, ay, az])?, corner("--box", &[bx, by, bz])?);
            Some(Bounds { low: a.min(b), high: a.max(b) })
        }
        Some(numbers) => {
            return Err(Error::usage(
                format!("--box has {} numbers", numbers.len()),
                "give six, two opposite corners: --box -0.1,-0.1,0,0.1,0.1,0.2",
            ));
        }
    };
    let (taxonomy, label) = labels(command)?;
    Ok(ObjectQuery { label, taxonomy, when: When::Default, point, region })
}

/// Taxonomy and label that are looked for.
fn labels(command: &Query) -> Result<(Option<String>, Option<String>), Error> {
    match command.taxonomy.as_deref().and_then(|text| text.split_once('=')) {
        None => Ok((command.taxonomy.clone(), command.label.clone())),
        Some((taxonomy, pattern))
            if command.label.is_none() && !taxonomy.is_empty() && !pattern.is_empty() =>
        {
            Ok((Some(taxonomy.to_owned()), Some(pattern.to_owned())))
        }
        Some(_) => Err(Error::usage(
            "--taxonomy NAME=PATTERN needs both names, and takes the place of --label",
            "for example --taxonomy wikidata_qcode=Q81727",
        )),
    }
}

fn corner(option: &str, numbers: &[f64]) -> Result<DVec3, Error> {
    let &[x, y, z] = numbers else {
        return Err(Error::usage(
            format!("{option} has {} numbers", numbers.len()),
            format!("give three, separated by commas: {option} 0.1,0.2,0.05"),
        ));
    };
    if [x, y, z].iter().all(|value| value.is_finite()) {
        Ok(DVec3::new(x, y, z))
    } else {
        Err(Error::usage(
            format!("{option} needs finite numbers"),
            format!("for example {option} 0.1,0.2,0.05"),
        ))
    }
}

fn in_scene(command: &Query, mut wanted: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    let place = command.path.display().to_string();
    let field = scene::load(&command.path)?;
    let options = SceneOptions { proxy_points: 0, ..SceneOptions::default() };
    let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
    wanted.when = when(command, &Frames::new(graph.time_codes.range(), &place))?;
    cif_scene::search(&graph, &wanted, &place, |name| format!("/World/{name}")).map_err(Error::plain)
}

/// Time code of a normalised time: linear between captured times, which need not be evenly spaced.
pub(super) fn code_at(times: &[f64], codes: &[f64], time: f64) -> f64 {
    let after = times.partition_point(|captured| *captured <= time);
    if after == 0 {
        return codes.first().copied().unwrap_or(0.0);
    }
    if after == times.len() {
        return codes[after - 1];
    }
    let fraction = (time - times[after - 1]) / (times[after] - times[after - 1]);
    codes[after - 1] + fraction * (codes[after] - codes[after - 1])
}

fn at(command: &Query, place: DVec3) -> Result<(), Error> {
    let field: Field = scene::load(&command.path)?;
    let place_of_file = command.path.display().to_string();
    let time = match command.time {
        Some(moment) => scene::time(&field, &place_of_file, "--time", moment)?,
        None => 0.0,
    };
    let answers = field.query(&[scene::frame(&field)?.dataset_from_capture(place)], time);
    let answer = &answers[0];
    let named: Vec<_> = answer
        .identity
        .iter()
        .map(|(index, probability)| (&field.instances[usize::from(*index)], *probability))
        .collect();
    let report = || {
        let instances: Vec<_> = named
            .iter()
            .map(|(instance, probability)| {
                json!({ "id": instance.id, "label": instance.label, "probability": probability })
            })
            .collect();
        json!({
            "at": place.to_array(), "time": time, "existence": answer.existence,
            "gaussians": answer.gaussians, "instances": instances,
        })
    };
    command.report.give(report, || {
        println!("existence {:.4}, {} Gaussians", answer.existence, answer.gaussians);
        for (instance, probability) in &named {
            println!("{:>8.4}  {} (id {})", probability, instance.label, instance.id);
        }
    })
}

fn print_table(found: &[ObjectMatch]) {
    let mut table = crate::commands::shared::table([
        "object",
        "label",
        "class",
        "position",
        "rotation w,x,y,z",
        "box from",
        "box to",
        "volume",
        "speed",
    ]);
    for object in found {
        let one = &object.found;
        let rows = &one.transform;
        let axis = |column: usize| DVec3::new(rows[0][column], rows[1][column], rows[2][column]);
        let turn = [0, 1, 2].map(axis).map(|axis| axis.try_normalize().unwrap_or(DVec3::ZERO));
        let rotation = DQuat::from_mat3(&DMat3::from_cols(turn[0], turn[1], turn[2]));
        let corner = |corner: &Option<[f64; 3]>| corner.as_ref().map_or("no extent".to_owned(), point);
        table.add_row([
            one.path.clone(),
            one.label.clone(),
            one.class.clone(),
            point(&axis(3).to_array()),
            if rotation.is_finite() {
                format!("{:.3}, {:.3}, {:.3}, {:.3}", rotation.w, rotation.x, rotation.y, rotation.z)
            } else {
                "none".to_owned()
            },
            corner(&one.low),
            corner(&one.high),
            object.volume.map_or("n/a".to_owned(), |volume| format!("{volume:.3e}")),
            format!("{:.4}", object.speed),
        ]);
    }
    println!("{table}");
}

fn point(p: &[f64; 3]) -> String {
    format!("{:.4}, {:.4}, {:.4}", p[0], p[1], p[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_between_captured_ones_are_interpolated() {
        let (times, codes) = ([0.0, 0.25, 1.0], [0.0, 1.0, 2.0]);
        for (time, code) in [(0.0, 0.0), (0.125, 0.5), (0.25, 1.0), (0.625, 1.5), (1.0, 2.0)] {
            assert_eq!(code_at(&times, &codes, time), code);
        }
        assert_eq!(code_at(&[0.5], &[3.0], 0.0), 3.0);
        assert_eq!(code_at(&[0.5], &[3.0], 1.0), 3.0);
    }
}
