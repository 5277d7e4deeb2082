//! The conditions of a query, and the objects that meet them.

use cif_geometry::Bounds;
use cif_scene::{ObjectMatch, ObjectQuery, ReadOptions, SceneOptions, When};
use glam::DVec3;

use super::options::Query;
use crate::commands::shared::scene;
use crate::error::Error;
use crate::formats::Content;
use crate::moment::{Frames, note_fraction};

/// Objects of the file that meet every condition.
pub(super) fn search(command: &Query, mut query: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    match Content::of(&command.path)? {
        Content::Field => in_scene(command, query),
        Content::Graph(format) => {
            let options = ReadOptions { follow_external: command.follow_external };
            if command.time.is_some() || command.interval.is_some() {
                let range = format.code_range(&command.path, options).map_err(Error::plain)?;
                query.when = when(command, &Frames::new(range, &command.path.display().to_string()))?;
            }
            format.search(&command.path, &query, options).map_err(Error::plain)
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
pub(super) fn question(command: &Query) -> Result<ObjectQuery, Error> {
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

fn in_scene(command: &Query, mut query: ObjectQuery) -> Result<Vec<ObjectMatch>, Error> {
    let place = command.path.display().to_string();
    let field = scene::load(&command.path)?;
    let options = SceneOptions { proxy_points: 0, ..SceneOptions::default() };
    let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
    query.when = when(command, &Frames::new(graph.time_codes.range(), &place))?;
    cif_scene::search(&graph, &query, &place, |name| format!("/World/{name}")).map_err(Error::plain)
}

/// Coordinates in tables.
pub(super) fn point(p: &[f64; 3]) -> String {
    format!("{:.4}, {:.4}, {:.4}", p[0], p[1], p[2])
}
