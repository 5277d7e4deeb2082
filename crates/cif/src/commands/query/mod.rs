//! `cif query`: where is an object, and what is at a place?

mod by_masks;
mod by_text;
mod find;
mod mask_options;
mod options;
mod trajectory;

use cif_field::Field;
use cif_scene::ObjectMatch;
use glam::{DMat3, DQuat, DVec3};
use serde::Serialize;

use self::find::{point, question, search};
pub(super) use self::options::Query;
use super::shared::scene;
use crate::error::Error;
use crate::formats::Content;
use crate::output::Outputs;
use crate::report::JsonReport;

/// Objects that meet every condition of a query.
#[derive(Serialize)]
#[serde(transparent)]
struct Matches<'a>(&'a [ObjectMatch]);

impl JsonReport for Matches<'_> {
    const COMMANDS: &'static [&'static str] =
        &["cif query --label", "cif query --point in a stage", "cif query --box"];
}

/// The field at a point.
#[derive(Serialize)]
struct PointReport<'a> {
    /// The point, capture coordinates.
    at: [f64; 3],
    /// Time, in [0, 1].
    time: f64,
    /// Probability that something is there, in [0, 1].
    existence: f64,
    /// Gaussians that reach the point.
    gaussians: u32,
    /// Instances that it may belong to, the most probable first.
    instances: Vec<PossibleInstance<'a>>,
}

/// An instance that a point may belong to.
#[derive(Serialize)]
struct PossibleInstance<'a> {
    /// Mask id.
    id: u16,
    /// Label.
    label: &'a str,
    /// Probability, in [0, 1].
    probability: f64,
}

impl JsonReport for PointReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif query --point in a .cif"];
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
    let query = question(command)?;
    if let Some(file) = &command.trajectory {
        return trajectory::run(command, file, &query);
    }
    if let (true, Some(place)) = (is_field, query.point) {
        let others = query.label.is_some() || query.region.is_some();
        if others || command.interval.is_some() || command.text.is_some() {
            return Err(Error::usage(
                "--point in a .cif asks the field itself, without other conditions than --time",
                "leave --label, --text, --box and --interval out, or query an exported stage",
            ));
        }
        return at(command, place);
    }
    if let Some(text) = &command.text {
        return by_text::run(command, text, query);
    }
    let place = command.path.display().to_string();
    let found = search(command, query)?;
    command.report.give(
        || Matches(&found),
        || match found.as_slice() {
            [] => println!("{place} has no such object"),
            found => print_table(found),
        },
    )
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
    let report = || PointReport {
        at: place.to_array(),
        time,
        existence: answer.existence,
        gaussians: answer.gaussians,
        instances: named
            .iter()
            .map(|(instance, probability)| PossibleInstance {
                id: instance.id,
                label: &instance.label,
                probability: *probability,
            })
            .collect(),
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
