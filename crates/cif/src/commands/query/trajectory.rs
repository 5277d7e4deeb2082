//! `cif query --trajectory`: paths of objects as CSV.

use std::fmt::Write as _;
use std::path::Path;

use cif_scene::{ObjectQuery, ReadOptions, SceneGraph, SceneOptions, Trajectory, trajectories};

use super::options::Query;
use crate::commands::shared::scene;
use crate::error::Error;
use crate::formats::{self, Content};
use crate::messages::outcome;
use crate::output::{self, Outputs};

/// Columns of the table.
const COLUMNS: &str = "object,label,class,frame,time,seconds,x,y,z,qw,qx,qy,qz,visible";

pub(super) fn run(command: &Query, file: &Path, query: &ObjectQuery) -> Result<(), Error> {
    let to_stdout = output::is_stdout(file);
    if !to_stdout {
        if file.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("csv")) {
            return Err(Error::usage(
                format!("--trajectory {}: paths are written as CSV", file.display()),
                "end the name in .csv, or leave it away to write to stdout",
            ));
        }
        let mut outputs = Outputs::new(command.force);
        outputs.reads(&command.path)?;
        outputs.text(file)?;
    }
    let place = command.path.display().to_string();
    let paths = trajectories(&graph(command)?, query, &place).map_err(Error::plain)?;
    let table = csv(&paths);
    if to_stdout {
        print!("{table}");
        return Ok(());
    }
    output::write_file(file, table.as_bytes())?;
    outcome!("wrote {}: {} objects, {} rows", file.display(), paths.len(), table.lines().count() - 1);
    Ok(())
}

fn graph(command: &Query) -> Result<SceneGraph, Error> {
    match Content::of(&command.path)? {
        Content::Field => {
            // Stand-ins and colliders have no path of their own.
            let options = SceneOptions { proxy_points: 0, hulls_per_instance: 0, ..SceneOptions::default() };
            cif_scene::build(&scene::load(&command.path)?, &options).map_err(Error::plain)
        }
        Content::Graph(_) => {
            formats::read_all(&command.path, ReadOptions { follow_external: command.follow_external })
        }
    }
}

fn csv(paths: &[Trajectory]) -> String {
    let mut table = format!("{COLUMNS}\n");
    for Trajectory { class, instance, label, samples } in paths {
        let names = [instance, label, class].map(|name| quoted(name)).join(",");
        for sample in samples {
            let [x, y, z] = sample.translation;
            let [qw, qx, qy, qz] = sample.rotation;
            let numbers = [sample.time_code, sample.time, sample.seconds, x, y, z, qw, qx, qy, qz];
            let numbers = numbers.map(|number| number.to_string()).join(",");
            // Writing to a string does not fail.
            let _ = writeln!(table, "{names},{numbers},{}", u8::from(sample.visible));
        }
    }
    table
}

/// A cell of text, in quotes where it needs them (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains(['"', ',', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cif_scene::TrajectorySample;

    #[test]
    fn a_row_per_frame_with_names_that_may_hold_anything() {
        let sample = TrajectorySample {
            time_code: 12.0,
            time: 0.25,
            seconds: 0.5,
            translation: [-0.1, 2.0, 1e-9],
            rotation: [1.0, 0.0, 0.0, 0.0],
            visible: false,
        };
        let path = Trajectory {
            class: "mug".to_owned(),
            instance: "red_mug_001".to_owned(),
            label: "mug, \"red\"".to_owned(),
            samples: vec![sample, TrajectorySample { visible: true, ..sample }],
        };
        let expected = "red_mug_001,\"mug, \"\"red\"\"\",mug,12,0.25,0.5,-0.1,2,0.000000001,1,0,0,0";
        assert_eq!(csv(&[path]), format!("{COLUMNS}\n{expected},0\n{expected},1\n"));
        assert_eq!(COLUMNS.split(',').count(), 14);
    }
}
