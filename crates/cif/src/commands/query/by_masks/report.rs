//! The answer to a question by masks, as people or programs read it.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::commands::query::mask_options::Protocol;
use crate::commands::query::options::Query;
use crate::error::Error;
use crate::mask_query::{Agreement, Found, Selection, Vote};
use crate::report::JsonReport;
use cif_vision::grounding::FoundBox;

/// Answer to a question by masks.
pub(super) struct Answer {
    pub(super) found: Found,
    /// Boxes of the prompt in the pictures that chose, by frame.
    pub(super) boxes: BTreeMap<String, Vec<FoundBox>>,
    pub(super) scores: Option<Agreement>,
}

/// Prints or writes what was found, and how well it agrees with the masks of held-out frames.
pub(super) fn give(command: &Query, answer: &Answer) -> Result<(), Error> {
    command.report.give(|| report(command, answer), || print(command, answer))
}

/// Instances that 2D masks show.
#[derive(Serialize)]
struct MaskReport<'a> {
    /// Instances that any mask shows, by their votes, the highest first.
    instances: &'a [Vote],
    /// Gaussians that make up the answer.
    gaussians: usize,
    /// Rule by which they were selected.
    select: Selection,
    /// Frames that voted.
    frames: usize,
    /// Rule of the vote: `reproject` or `grouping`.
    protocol: &'static str,
    /// The prompt; absent where masks were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    prompt: Option<&'a str>,
    /// Boxes that the detector found, by the name of the frame; absent without a detector of `--models`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    boxes: &'a BTreeMap<String, Vec<FoundBox>>,
    /// Agreement with masks of held-out frames; absent where they were not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    eval: Option<&'a Agreement>,
}

impl JsonReport for MaskReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif query --prompt", "cif query --masks"];
}

fn report<'a>(command: &'a Query, answer: &'a Answer) -> MaskReport<'a> {
    let Answer { found, boxes, scores } = answer;
    let options = &command.by_masks;
    MaskReport {
        instances: &found.votes,
        gaussians: found.rows.len(),
        select: Selection::from(options.select),
        frames: found.frames,
        protocol: options.protocol.name(),
        prompt: options.prompt.as_deref(),
        boxes,
        eval: scores.as_ref(),
    }
}

fn print(command: &Query, answer: &Answer) {
    let Answer { found, boxes, scores } = answer;
    let options = &command.by_masks;
    if !boxes.is_empty() {
        let shown = boxes.values().filter(|boxes| !boxes.is_empty()).count();
        println!("the prompt is in {shown} of {} pictures", boxes.len());
    }
    let asked = match options.protocol {
        Protocol::Reproject => format!("{} training frames", found.frames),
        Protocol::Grouping => "the first view".to_owned(),
    };
    if found.votes.iter().all(|vote| !vote.chosen) {
        println!("no instance lies inside the masks of {asked}");
    }
    let mut table = crate::commands::shared::table(["", "id", "label", "class", "inside"]);
    for vote in &found.votes {
        table.add_row([
            if vote.chosen { "*".to_owned() } else { String::new() },
            vote.id.to_string(),
            vote.label.clone(),
            vote.category.clone(),
            format!("{:.3}", vote.score),
        ]);
    }
    println!("{table}");
    println!("* chosen, by {asked}; {} Gaussians", found.rows.len());
    if let Some(scores) = scores {
        let number = |value: Option<f64>| value.map_or("n/a".to_owned(), |value| format!("{value:.2}"));
        println!(
            "held-out frames: mAcc {}, mIoU {} over {} ({} more where nothing was found)",
            number(scores.macc),
            number(scores.miou),
            scores.frames,
            scores.empty_frames
        );
    }
}
