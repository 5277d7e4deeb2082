//! Files that `cif capture` keeps where it writes no capture, and the commands that go on from there.

use std::path::Path;

use cif_capture::frames::Shot;
use cif_capture::source::Source;
use cif_capture::structure::{self, Order};
use cif_capture::unfinished::{Unfinished, keep as keep_unfinished};

use super::options::{Capture, LensesName, OrderName, UpName};
use super::posed::{self, Left};
use crate::commands::shared::command_line;
use crate::error::Error;

/// Keeps frames of videos, and poses that are `left`, and says how to go on with them and with the features
/// found so far, after `error`.
pub(super) fn keep(command: &Capture, sources: &[Source], shots: &[Shot], left: &Left, error: &Error) {
    let poses = left.unbelieved.as_ref().map(|posed| (&posed.poses, posed.from.as_str()));
    let kept = keep_unfinished(sources, shots, poses, &command.output).unwrap_or_else(|error| {
        crate::messages::warning!("frames and poses found so far could not be kept: {error}");
        None
    });
    if let Some(kept) = &kept {
        let what = match (kept.frames, kept.has_poses) {
            (0, _) => "the poses found".to_owned(),
            (frames, false) => format!("{frames} frames"),
            (frames, true) => format!("{frames} frames and the poses found"),
        };
        eprintln!("kept: {} has {what}", kept.place.display());
    }
    let features = structure::kept_beside(&command.output);
    let has_features = structure::has_kept(&features);
    if !has_features {
        // Its folder, which is empty.
        structure::remove_kept(&features);
    } else {
        eprintln!(
            "kept: {} has the features and matches; another run with -o {} continues from them",
            features.display(),
            command.output.display()
        );
    }
    let inputs = match &kept {
        Some(kept) => kept.inputs.clone(),
        None if has_features => command.inputs.clone(),
        None => return,
    };
    let fixed = posed::is_fixed(command, shots);
    let order = posed::order(command, shots, fixed);
    let times = kept.as_ref().and_then(|kept| kept.times.as_deref());
    let mut again = again(command, &inputs, times, order);
    if kept.is_none() {
        again.extend(choice_of_images(command));
    }
    let again = command_line(&again);
    let options = match error {
        Error::Interrupted { .. } => Vec::new(),
        _ if left.stands_still && command.inputs.len() > 1 => {
            vec!["--fixed (all cameras stand still)", "--moving (it moves all the same)"]
        }
        _ if left.stands_still => vec!["--moving (it moves all the same)"],
        _ => other_options(command),
    };
    if options.is_empty() {
        eprintln!("next:\n  {again}");
    } else {
        eprintln!("next, with other options for poses, which are {}:\n  {again}", options.join(", "));
    }
    if let Some(kept) = kept.filter(|kept| kept.has_poses) {
        let with_poses = command_line(&with_poses(command, &kept));
        eprintln!("or, with these poses all the same:\n  {with_poses}");
    }
}

/// Options for poses that the command was not given.
fn other_options(command: &Capture) -> Vec<&'static str> {
    let mut options = Vec::new();
    if command.masks.is_none() {
        options.push("--masks DIR (leaves out what moves)");
    }
    if command.focal.is_none() {
        options.push("--focal PIXELS");
    }
    if matches!(command.order, OrderName::Auto | OrderName::Sequence) {
        options.push("--order any (matches each image with each)");
    }
    if command.inputs.len() > 1 && matches!(command.lenses, LensesName::One) {
        options.push("--lenses each (every camera has its own)");
    }
    if !command.fixed && !command.moving {
        options.push("--fixed or --moving (whether the cameras stand still)");
    }
    options.push("--poses FROM (of another tool)");
    options
}

/// Options by which frames of videos are chosen, which those that were kept need no more.
fn choice_of_images(command: &Capture) -> Vec<String> {
    let mut words = Vec::new();
    let mut add = |name: &str, value: Option<String>| {
        words.extend(value.map(|value| [name.to_owned(), value]).into_iter().flatten());
    };
    add("--rate", command.rate.map(|rate| rate.to_string()));
    add("--from", command.from.map(|seconds| format!("{seconds}s")));
    add("--to", command.to.map(|seconds| format!("{seconds}s")));
    for (camera, seconds) in &command.offset {
        add("--offset", Some(format!("{camera}={seconds}")));
    }
    for (is_set, name) in [(command.sharpest, "--sharpest"), (command.nearest, "--nearest")] {
        words.extend(is_set.then(|| name.to_owned()));
    }
    words
}

/// The command that finds poses of what was kept.
fn again(command: &Capture, inputs: &[String], times: Option<&Path>, order: Order) -> Vec<String> {
    let mut words = beginning(command, inputs, times);
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
    let mut words = beginning(command, &kept.inputs, kept.times.as_deref());
    words.extend(["--poses".to_owned(), kept.place.display().to_string()]);
    words
}

/// Inputs, output and options that go with every method for poses.
fn beginning(command: &Capture, inputs: &[String], times: Option<&Path>) -> Vec<String> {
    let mut words = vec!["capture".to_owned()];
    words.extend(inputs.iter().cloned());
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
    let times = times.or(command.times.as_deref());
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

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::commands::{Arguments, Command};

    fn read(words: &[String]) -> Capture {
        let line = ["cif", "capture", "a.mp4", "-o", "c"].map(str::to_owned).into_iter();
        match Arguments::try_parse_from(line.chain(words.iter().cloned())).unwrap().command {
            Command::Capture(command) => command,
            _ => panic!("another command"),
        }
    }

    #[test]
    fn frames_are_chosen_again_by_the_same_words() {
        let words = ["--rate", "2.5", "--from", "1.5s", "--to", "20s", "--offset", "a=-0.5", "--sharpest"];
        let words = words.map(str::to_owned);
        assert_eq!(choice_of_images(&read(&words)), words);
        assert_eq!(choice_of_images(&read(&choice_of_images(&read(&words)))), words);
    }
}
