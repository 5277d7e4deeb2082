//! Files that `cif capture` keeps where it writes no capture, and the commands that go on from there.

use cif_capture::frames::Shot;
use cif_capture::source::Source;
use cif_capture::structure::Order;
use cif_capture::unfinished::{Unfinished, keep as keep_unfinished};

use super::options::{LensesName, UpName};
use super::{Capture, Posed};
use crate::commands::command_line;

/// Keeps frames of videos, and poses that were not believed, and tells how to go on with them.
pub(super) fn keep(command: &Capture, sources: &[Source], shots: &[Shot], unbelieved: Option<&Posed>) {
    let poses = unbelieved.map(|posed| (&posed.poses, posed.from.as_str()));
    let kept = match keep_unfinished(sources, shots, poses, &command.output) {
        Ok(Some(kept)) => kept,
        Ok(None) => return,
        Err(error) => {
            eprintln!("warning: frames and poses found so far could not be kept: {error}");
            return;
        }
    };
    let what = match (kept.frames, kept.has_poses) {
        (0, _) => "the poses found".to_owned(),
        (frames, false) => format!("{frames} frames"),
        (frames, true) => format!("{frames} frames and the poses found"),
    };
    eprintln!("kept: {} has {what}", kept.place.display());
    let fixed = super::is_fixed(command, shots);
    let order = super::order(command, shots, fixed);
    eprintln!("next, with other options for poses:\n  {}", command_line(&again(command, &kept, order)));
    if kept.has_poses {
        eprintln!("or, with these poses all the same:\n  {}", command_line(&with_poses(command, &kept)));
    }
}

/// The command that finds poses of what was kept.
fn again(command: &Capture, kept: &Unfinished, order: Order) -> Vec<String> {
    let mut words = beginning(command, kept);
    let mut add = |name: &str, value: Option<String>| {
        words.extend(value.map(|value| [name.to_owned(), value]).into_iter().flatten())
    };
    // Frames that were kept are photographs, of which any two may overlap.
    add("--order", Some(if order == Order::Sequence { "sequence" } else { "any" }.to_owned()));
    add("--focal", command.focal.map(|focal| focal.to_string()));
    add("--lenses", matches!(command.lenses, LensesName::Each).then(|| "each".to_owned()));
    add("--poses", command.poses.as_ref().map(|path| path.display().to_string()));
    for (is_set, name) in [(command.fixed, "--fixed"), (command.moving, "--moving")] {
        words.extend(is_set.then(|| name.to_owned()));
    }
    words
}

/// The command that takes the poses that were kept.
fn with_poses(command: &Capture, kept: &Unfinished) -> Vec<String> {
    let mut words = beginning(command, kept);
    words.extend(["--poses".to_owned(), kept.place.display().to_string()]);
    words
}

/// Inputs, output and options that go with every way to poses.
fn beginning(command: &Capture, kept: &Unfinished) -> Vec<String> {
    let mut words = vec!["capture".to_owned()];
    words.extend(kept.inputs.iter().cloned());
    words.extend(["-o".to_owned(), command.output.display().to_string()]);
    let mut add = |name: &str, values: Vec<String>| {
        if !values.is_empty() {
            words.push(name.to_owned());
            words.extend(values);
        }
    };
    // Of photographs, which stay where they are; what was kept of videos is as it was chosen.
    add("--max-side", command.max_side.map(|side| side.to_string()).into_iter().collect());
    add("--count", command.count.map(|count| count.to_string()).into_iter().collect());
    let times = kept.times.as_ref().or(command.times.as_ref());
    add("--times", times.map(|path| path.display().to_string()).into_iter().collect());
    add("--masks", command.masks.as_ref().map(|path| path.display().to_string()).into_iter().collect());
    let ids = |ids: &Vec<u16>| ids.iter().map(u16::to_string).collect::<Vec<_>>().join(",");
    add("--moving-ids", command.moving_ids.as_ref().map(ids).into_iter().collect());
    add("--length", command.length.clone().unwrap_or_default());
    add("--measured", command.measured.clone().unwrap_or_default());
    add(
        "--up",
        match command.up {
            UpName::Cameras => Vec::new(),
            UpName::Unknown => vec!["unknown".to_owned()],
            UpName::Given([x, y, z]) => vec![format!("{x},{y},{z}")],
        },
    );
    words
}
