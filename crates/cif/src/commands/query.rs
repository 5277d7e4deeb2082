//! `cif query`: where is an object, and what is at a place?

use std::path::{Path, PathBuf};

use cif_field::Field;
use cif_scene::{LabelMatch, LabelQuery, SceneOptions};
use clap::{ArgGroup, Args};
use serde_json::json;

use super::scene;
use crate::error::Error;

/// Find objects by label, or tell what is at a place
#[derive(Debug, Args)]
#[command(
    group = ArgGroup::new("question").required(true).args(["label", "at"]),
    after_help = "\
Labels match the name, class or unique name of an object; case does not matter, * and ? are
wildcards. Boxes hold the splats to three standard deviations.
Time in a stage is its time code, which counts captured frames; in a .cif it runs from 0 (first
captured time) to 1 (last).

  cif query table.usda --label 'red mug' --time 36
  cif query table.cif --label '*box' --json
  cif query table.cif --at 0.1,0.2,0.05 --time 0.5"
)]
pub(super) struct Query {
    /// Exported stage (.usda, .usdc, .usdz) or trained scene (.cif)
    #[arg(value_name = "STAGE|SCENE.cif")]
    path: PathBuf,
    /// Label to look for
    #[arg(long, value_name = "GLOB")]
    label: Option<String>,
    /// Place in the world; needs a .cif
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', num_args = 1, allow_hyphen_values = true)]
    at: Option<Vec<f64>>,
    /// Time: time code of a stage, 0 to 1 in a .cif [default: the first]
    #[arg(long, value_name = "T", allow_hyphen_values = true)]
    time: Option<f64>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(command: &Query) -> Result<(), Error> {
    if scene::is_scene(&command.path) {
        scene::check_time(command.time)?;
    }
    if let Some(place) = &command.at {
        return at(command, place);
    }
    let pattern = command.label.clone().unwrap_or_default();
    let matches = if scene::is_scene(&command.path) {
        in_scene(&command.path, pattern, command.time)?
    } else {
        let query = LabelQuery { pattern, time_code: command.time };
        cif_usd::query(&command.path, &query).map_err(Error::plain)?
    };
    if command.json {
        println!("{:#}", json!(matches));
    } else {
        matches.iter().for_each(print_match);
    }
    Ok(())
}

fn in_scene(path: &Path, pattern: String, time: Option<f64>) -> Result<Vec<LabelMatch>, Error> {
    let field = scene::load(path)?;
    let options = SceneOptions { proxy_points: 0, ..SceneOptions::default() };
    let graph = cif_scene::build(&field, &options).map_err(Error::plain)?;
    let codes = &graph.time_codes;
    let time_code = time.map(|time| code_at(&codes.times, &codes.samples, time));
    cif_scene::query(&graph, &LabelQuery { pattern, time_code }, &path.display().to_string())
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

fn at(command: &Query, place: &[f64]) -> Result<(), Error> {
    let &[x, y, z] = place else {
        return Err(Error::usage(
            format!("--at has {} numbers", place.len()),
            "give three, separated by commas: --at 0.1,0.2,0.05",
        ));
    };
    if ![x, y, z].iter().all(|value| value.is_finite()) {
        return Err(Error::usage("--at needs finite numbers", "for example --at 0.1,0.2,0.05"));
    }
    if !scene::is_scene(&command.path) {
        return Err(Error::usage(
            format!("--at needs a trained scene (.cif), and {} is none", command.path.display()),
            "a stage knows its objects by label: --label",
        ));
    }
    let field: Field = scene::load(&command.path)?;
    let time = command.time.unwrap_or(0.0);
    let answers = field.query(&[glam::DVec3::new(x, y, z)], time);
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
            "at": [x, y, z], "time": time, "existence": answer.existence,
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

fn print_match(found: &LabelMatch) {
    println!(
        "{}  label '{}'  class '{}'  instance '{}'",
        found.path, found.label, found.class, found.instance
    );
    for row in &found.transform {
        println!("  [{:>10.5} {:>10.5} {:>10.5} {:>10.5}]", row[0], row[1], row[2], row[3]);
    }
    match (&found.low, &found.high) {
        (Some(low), Some(high)) => println!("  box {} to {}", point(low), point(high)),
        _ => println!("  no extent"),
    }
}

fn point(p: &[f64; 3]) -> String {
    format!("({:.4}, {:.4}, {:.4})", p[0], p[1], p[2])
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
