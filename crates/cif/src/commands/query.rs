//! `cif query`: where is an object, and what is at a place?

mod by_masks;
mod by_text;
mod trajectory;

use std::path::{Path, PathBuf};

use cif_field::Field;
use cif_geometry::Bounds;
use cif_scene::{ObjectMatch, ObjectQuery, ReadOptions, SceneOptions, When};
use clap::Args;
use glam::{DMat3, DQuat, DVec3};
use serde_json::json;

use super::scene;
use crate::error::Error;
use crate::formats::Content;

const HELP: &str = "\
Without conditions every object is listed; several conditions must all hold. Labels match the name,
class or unique name of an object; case does not matter, * stands for any characters and ? for one.
Boxes hold the splats to three standard deviations; volumes are those of the colliders, where there
are any, else of the boxes; speeds are world units per second. Stages of other programs need semantic
labels only.
Time in a stage or glTF file is its time code, which counts captured frames; in a .cif it runs from 0
(first captured time) to 1 (last).

  cif query table.usda --label 'red mug' --time 36
  cif query table.usda --taxonomy class --label mug --interval 0:20
  cif query table.cif --taxonomy wikidata_qcode=Q81727
  cif query table.glb --box -0.2,-0.2,0,0.2,0.2,0.3
  cif query table.cif --label '*box' --json
  cif query table.cif --point 0.1,0.2,0.05 --time 0.5

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
yours; --json tells the boxes, with the words that score above 0.45. Masks are kept in
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

/// Find objects by label, time, place, or masks; or tell what is at a place
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
    /// Time: time code of a stage, 0 to 1 in a .cif [default: the first]
    #[arg(long, value_name = "T", allow_hyphen_values = true)]
    time: Option<f64>,
    /// Interval of time: objects that are there at any time in it
    #[arg(long, value_name = "FROM:TO", conflicts_with = "time", allow_hyphen_values = true)]
    interval: Option<String>,
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
        default_missing_value = "-",
        conflicts_with_all = ["json", "time", "interval", "point", "region", "text", "masks", "prompt"]
    )]
    trajectory: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long, requires = "trajectory")]
    force: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    by_masks: by_masks::ByMasks,
}

pub(super) fn run(command: &Query) -> Result<(), Error> {
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
    let wanted = question(command, is_field)?;
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
    if command.json {
        println!("{:#}", json!(found));
    } else if found.is_empty() {
        println!("nothing is there in {place}");
    } else {
        print_table(&found);
    }
    Ok(())
}

/// Objects of the file that meet every condition.
fn search(command: &Query, wanted: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    match Content::of(&command.path)? {
        Content::Field => in_scene(&command.path, wanted),
        Content::Graph(format) => {
            let options = ReadOptions { follow_external: command.follow_external };
            format.search(&command.path, &wanted, options).map_err(Error::plain)
        }
    }
}

/// The conditions of the command line; times of a `.cif` are still normalised.
fn question(command: &Query, is_field: bool) -> Result<ObjectQuery, Error> {
    if is_field {
        scene::check_time(command.time)?;
    }
    let when = match (command.time, &command.interval) {
        (Some(time), _) if !time.is_finite() => {
            return Err(Error::usage("--time needs a finite number", "for example --time 12"));
        }
        (Some(time), _) => When::At(time),
        (None, Some(text)) => interval(text, is_field)?,
        (None, None) => When::Default,
    };
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
    Ok(ObjectQuery { label, taxonomy, when, point, region })
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

fn interval(text: &str, is_field: bool) -> Result<When, Error> {
    let ends: Option<(f64, f64)> = text
        .split_once(':')
        .and_then(|(from, to)| Some((from.trim().parse().ok()?, to.trim().parse().ok()?)));
    let example = if is_field { "--interval 0:0.5" } else { "--interval 0:20" };
    match ends {
        Some((from, to)) if from.is_finite() && to.is_finite() && from <= to => {
            if is_field {
                scene::check_time(Some(from))?;
                scene::check_time(Some(to))?;
            }
            Ok(When::Over(from, to))
        }
        _ => Err(Error::usage(
            format!("--interval {text}: two times are needed, the earlier one first"),
            format!("for example {example}"),
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

fn in_scene(path: &Path, mut wanted: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    let options = SceneOptions { proxy_points: 0, ..SceneOptions::default() };
    let graph = cif_scene::build(&scene::load(path)?, &options).map_err(Error::plain)?;
    let codes = &graph.time_codes;
    let code = |time| code_at(&codes.times, &codes.samples, time);
    wanted.when = match wanted.when {
        When::Default => When::Default,
        When::At(time) => When::At(code(time)),
        When::Over(from, to) => When::Over(code(from), code(to)),
    };
    cif_scene::search(&graph, &wanted, &path.display().to_string(), |name| format!("/World/{name}"))
        .map_err(Error::plain)
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
    let time = command.time.unwrap_or(0.0);
    let answers = field.query(&[scene::frame(&field)?.dataset_from_capture(place)], time);
    let answer = &answers[0];
    let named: Vec<_> = answer
        .identity
        .iter()
        .map(|(index, probability)| (&field.instances[usize::from(*index)], *probability))
        .collect();
    if command.json {
        let instances: Vec<_> = named
            .iter()
            .map(|(instance, probability)| {
                json!({ "id": instance.id, "label": instance.label, "probability": probability })
            })
            .collect();
        let report = json!({
            "at": place.to_array(), "time": time, "existence": answer.existence,
            "gaussians": answer.gaussians, "instances": instances,
        });
        println!("{report:#}");
        return Ok(());
    }
    println!("existence {:.4}, {} Gaussians", answer.existence, answer.gaussians);
    for (instance, probability) in named {
        println!("{:>8.4}  {} (id {})", probability, instance.label, instance.id);
    }
    Ok(())
}

fn print_table(found: &[ObjectMatch]) {
    let mut table = super::table([
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

    #[test]
    fn intervals_are_two_times_in_order() {
        assert_eq!(interval("2:7.5", false).unwrap(), When::Over(2.0, 7.5));
        assert_eq!(interval("-3:-3", false).unwrap(), When::Over(-3.0, -3.0));
        for text in ["7:2", "3", "a:b", "nan:1", "0:inf"] {
            assert!(interval(text, false).is_err(), "{text}");
        }
        assert!(interval("0:2", true).is_err(), "times of a .cif end at 1");
    }
}
