//! Text of the page of a comparison.

use std::path::PathBuf;

use cif_bench::comparison::page::{Comparison, Video};
use cif_dataset::Split;
use cif_train::{HeadName, Trainer};

use super::capture::Capture;
use super::options::{BenchCompare, Iterations};
use super::runs::{Bench, empty};

/// Description of a comparison for its page.
pub(super) fn describe(
    command: &BenchCompare,
    captures: &[Capture],
    heads: &[HeadName],
    bench: &Bench,
    videos: Vec<Video>,
) -> Comparison {
    let of_captures: Vec<String> = captures
        .iter()
        .map(|capture| {
            let count = |split| capture.dataset.frames.iter().filter(|frame| frame.split == split).count();
            format!(
                "{}: {} training frames, {} held out, {} instances, {} steps of reconstruction",
                capture.name,
                count(Split::Train),
                count(Split::Val),
                capture.dataset.instances.len(),
                capture.config.stages.coarse + capture.config.fine_iterations()
            )
        })
        .collect();
    let steps = match command.iterations {
        Iterations::Published => "as many steps as its publication has".to_owned(),
        Iterations::Steps(steps) => format!("{steps} steps"),
    };
    let seeds = match command.seeds {
        1 => "one seed".to_owned(),
        seeds => format!("{seeds} seeds"),
    };
    let folder = |path: &PathBuf| {
        path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
    };
    let mut line = format!(
        "cif bench compare {} -o {} --seeds {}",
        command.captures.iter().map(folder).collect::<Vec<_>>().join(" "),
        folder(&command.output),
        command.seeds
    );
    line += &match command.iterations {
        Iterations::Published => " --iterations published".to_owned(),
        Iterations::Steps(steps) => format!(" --iterations {steps}"),
    };
    if let Some(preset) = &command.preset {
        line += &format!(" --preset {preset}");
    }
    if !command.heads.is_empty() {
        let names: Vec<&str> = command.heads.iter().map(|argument| argument.head().name()).collect();
        line += &format!(" --heads {}", names.join(","));
    }
    let options = [("masks", &command.capture_options.masks), ("score-masks", &command.score_masks)];
    for (name, value) in options {
        if let Some(value) = value {
            line += &format!(" --{name} {}", folder(value));
        }
    }
    if command.ablations {
        line += " --ablations";
    }
    if command.video {
        line += " --video";
    }
    for assignment in &command.set {
        line += &format!(" --set {assignment}");
    }
    if let Some(queries) = &command.queries {
        line += &format!(" --queries {}", folder(queries));
    }
    if let Some(models) = &command.models {
        line += &format!(" --models {}", folder(models));
    }
    Comparison {
        description: format!("{}. Every head trains {steps}; {seeds}.", of_captures.join("; ")),
        command: line,
        threads: rayon::current_num_threads(),
        simd: Trainer::vector_instructions(),
        missing: bench.missing.clone(),
        videos,
        heads: heads.iter().filter(|head| head.tells_labels()).map(|head| head.name().to_owned()).collect(),
        ablations: command.ablations,
        camera: captures.first().map(|capture| capture.config.head.camera.clone()).unwrap_or_default(),
        queries: None,
        empty: empty(),
    }
}
