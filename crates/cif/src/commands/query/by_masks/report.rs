//! The answer to a question by masks, as people or programs read it.

use serde_json::{Value, json};

use super::{Answer, Protocol, Query};
use crate::error::Error;
use crate::mask_query::Selection;

/// Prints or writes what was found, and how well it agrees with the masks of held-out frames.
pub(super) fn give(command: &Query, answer: &Answer) -> Result<(), Error> {
    command.report.give(|| as_json(command, answer), || print(command, answer))
}

fn as_json(command: &Query, answer: &Answer) -> Value {
    let Answer { found, boxes, scores } = answer;
    let options = &command.by_masks;
    let mut report = json!({
        "instances": found.votes,
        "gaussians": found.rows.len(),
        "select": Selection::from(options.select),
        "frames": found.frames,
        "protocol": options.protocol.name(),
    });
    if let Some(prompt) = &options.prompt {
        report["prompt"] = json!(prompt);
    }
    if !boxes.is_empty() {
        report["boxes"] = json!(boxes);
    }
    if let Some(scores) = scores {
        report["eval"] = json!(scores);
    }
    report
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
