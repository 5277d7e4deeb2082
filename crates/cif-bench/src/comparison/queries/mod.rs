//! Questions in words: how well the masks that scenes answer with agree with those of the instances that are
//! the answer.
//!
//! | file | answers |
//! |---|---|
//! | `forms` | tables as Markdown, CSV, JSON and LaTeX |
//! | `notes` | what readers have to know of the numbers, and what is missing |
//!
//! Scores are those of the paper's table of queries: in every held-out frame that shows the answer, the percent of all
//! pixels that agree (mAcc) and the intersection over union (mIoU); means over frames. Source: methods reference 9.

mod forms;
mod notes;

use std::collections::BTreeSet;

use cif_dataset::MadeFrom;
use serde::{Deserialize, Serialize};

pub(super) use self::forms::{PUBLISHED_HEADING, shown};
use super::published::{PUBLISHED, PublishedAnswer};
use super::tables::{Mean, Missing};
use super::title;
use crate::records::Measurement;

/// Rule by which a scene answers a question.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// The instances that have the most words of the question in their labels, classes and taxonomies.
    Labels,
    /// Those inside the masks that models make of the question on training frames.
    Reproject,
    /// Those inside the mask that models make of it on the first held-out view as it is rendered.
    Grouping,
    /// The pixels whose features are relevant for it.
    Relevance,
}

impl Rule {
    /// All of them, in the order of tables.
    pub const ALL: [Self; 4] = [Self::Labels, Self::Reproject, Self::Grouping, Self::Relevance];

    /// As in tables of numbers.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Labels => "labels",
            Self::Reproject => "reproject",
            Self::Grouping => "grouping",
            Self::Relevance => "relevance",
        }
    }
}

/// Answer of a scene to a question, compared with the truth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// Name of the capture.
    pub capture: String,
    /// The head.
    pub head: String,
    /// Seed.
    pub seed: u64,
    /// The question.
    pub question: String,
    /// Rule by which it was answered.
    pub by: Rule,
    /// Percent of pixels that agree; `None` where no held-out frame shows the answer.
    pub macc: Option<f64>,
    /// Mean intersection over union, percent.
    pub miou: Option<f64>,
    /// Held-out frames that show the answer.
    pub frames: usize,
    /// Held-out frames with a mask that do not, which do not count.
    pub empty_frames: usize,
    /// Ids of the instances that were chosen; empty where none was, and with [`Rule::Relevance`], which asks pixels.
    pub chosen: Vec<u16>,
}

/// The answers of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answers {
    /// Everything that they depend on: another value makes them void.
    pub fingerprint: MadeFrom,
    /// By question, then by rule.
    pub answers: Vec<Answer>,
}

impl Measurement for Answers {
    const FOLDER: &'static str = "answers";

    fn fingerprint(&self) -> &MadeFrom {
        &self.fingerprint
    }

    fn files(&self, _: &str) -> Vec<String> {
        Vec::new()
    }
}

/// Questions of a comparison, and the answers so far.
#[derive(Clone, Debug, Default)]
pub struct Queries {
    /// Questions by capture, in the order of tables.
    pub questions: Vec<(String, Vec<String>)>,
    /// Answers of all scenes.
    pub answers: Vec<Answer>,
    /// Heads in the order of lines.
    pub heads: Vec<String>,
    /// The only camera that SA4D trained on; empty for all.
    pub camera: String,
    /// True when models were given.
    pub has_models: bool,
    /// Captures whose questions 4D LangSplat was not asked, with the reason.
    pub without_maps: Vec<String>,
    /// Scenes that have not answered yet.
    pub missing: Vec<Missing>,
}

/// A number of a line, and whether it is the best of its column among lines of the same rule.
pub(super) type Cell = (Mean, bool);

/// Scores of a head by one rule.
pub(super) struct Line {
    pub(super) title: String,
    pub(super) rule: Rule,
    /// mAcc and mIoU of every question, then of all.
    pub(super) cells: Vec<Cell>,
    /// Published numbers, in words.
    pub(super) published: String,
}

/// A table of one capture, or of the average over all.
pub(super) struct Table {
    pub(super) caption: String,
    /// Headings of the cells.
    pub(super) headings: Vec<String>,
    pub(super) lines: Vec<Line>,
}

/// Digits behind the point.
pub(super) const DIGITS: usize = 2;

impl Queries {
    /// A table per capture, and their average where there are several.
    pub(super) fn tables(&self) -> Vec<Table> {
        let asked: Vec<(&str, &[String])> =
            self.questions.iter().map(|(capture, questions)| (&capture[..], &questions[..])).collect();
        let mut tables: Vec<Table> = asked.iter().map(|one| self.table(&[*one])).collect();
        if asked.len() > 1 {
            tables.push(self.table(&asked));
        }
        tables
    }

    /// Of a capture every question and their mean; of several captures the mean of all questions.
    fn table(&self, asked: &[(&str, &[String])]) -> Table {
        let all: Vec<(&str, &str)> =
            asked.iter().flat_map(|(capture, of)| of.iter().map(|text| (*capture, &text[..]))).collect();
        let mut columns: Vec<&[(&str, &str)]> = Vec::new();
        let mut headings = Vec::new();
        if let [(capture, questions)] = asked {
            debug_assert_eq!(all.len(), questions.len(), "{capture}");
            columns.extend(all.chunks(1));
            headings.extend(questions.iter().map(|text| format!("'{text}'")));
        }
        columns.push(&all);
        headings.push("mean".to_owned());
        let mut lines = Vec::new();
        for rule in Rule::ALL {
            for head in &self.heads {
                let means: Vec<Mean> = columns
                    .iter()
                    .flat_map(|questions| {
                        let of = |score: fn(&Answer) -> Option<f64>| self.mean(head, rule, questions, score);
                        [of(|answer| answer.macc), of(|answer| answer.miou)]
                    })
                    .collect();
                if means.iter().any(|mean| mean.mean.is_some()) {
                    lines.push(Line {
                        title: title(head, &self.camera),
                        rule,
                        cells: means.into_iter().map(|mean| (mean, false)).collect(),
                        published: published(asked, head, rule),
                    });
                }
            }
        }
        mark_best(&mut lines);
        let captures: Vec<&str> = asked.iter().map(|(capture, _)| *capture).collect();
        let caption = match captures[..] {
            [capture] => capture.to_owned(),
            _ => format!("all questions of {}", captures.join(", ")),
        };
        let headings =
            headings.iter().flat_map(|of| [format!("{of} mAcc %"), format!("{of} mIoU %")]).collect();
        Table { caption, headings, lines }
    }

    /// Mean over seeds of the mean over questions. Questions whose answer no held-out frame shows do not count, nor do
    /// seeds that have not answered all.
    fn mean(
        &self,
        head: &str,
        rule: Rule,
        questions: &[(&str, &str)],
        score: fn(&Answer) -> Option<f64>,
    ) -> Mean {
        let of: Vec<&Answer> =
            self.answers.iter().filter(|answer| answer.head == head && answer.by == rule).collect();
        let seeds: BTreeSet<u64> = of.iter().map(|answer| answer.seed).collect();
        Mean::of(seeds.into_iter().map(|seed| {
            let answered: Option<Vec<Option<f64>>> = questions
                .iter()
                .map(|question| {
                    let is_it = |answer: &&&Answer| {
                        answer.seed == seed && (&answer.capture[..], &answer.question[..]) == *question
                    };
                    of.iter().find(is_it).map(|answer| score(answer))
                })
                .collect();
            Mean::of(answered?).mean
        }))
    }
}

/// Marks the largest number of every column among several lines of the same rule. Equal as they are shown is equal.
fn mark_best(lines: &mut [Line]) {
    let rounded = |cell: &Cell| cell.0.mean.map(|mean| (mean * 10f64.powi(DIGITS as i32)).round());
    for of_rule in lines.chunk_by_mut(|a, b| a.rule == b.rule).filter(|lines| lines.len() > 1) {
        for column in 0..of_rule[0].cells.len() {
            let most = of_rule.iter().filter_map(|line| rounded(&line.cells[column]));
            let most = most.fold(f64::NEG_INFINITY, f64::max);
            for line in &mut *of_rule {
                line.cells[column].1 = rounded(&line.cells[column]) == Some(most);
            }
        }
    }
}

/// Published numbers of a head: those of the scene that a capture is called after, else their means. They were
/// taken with a detector's help, so that they are not shown with answers by labels.
fn published(asked: &[(&str, &[String])], head: &str, rule: Rule) -> String {
    if rule == Rule::Labels {
        return "–".to_owned();
    }
    let words = |of: &PublishedAnswer| format!("{:.2} / {:.2}", of.macc, of.miou);
    let of_scene = match asked {
        [(capture, _)] => PUBLISHED.queries_of_capture(capture),
        _ => None,
    };
    if let Some(questions) = of_scene {
        let found: Vec<String> = questions
            .iter()
            .filter_map(|(text, heads)| Some(format!("'{text}' {}", words(heads.get(head)?))))
            .collect();
        if !found.is_empty() {
            return found.join("; ");
        }
    }
    let mean = PUBLISHED.query_means.get(head);
    mean.map_or_else(|| "–".to_owned(), |of| format!("{} (mean of four questions, HyperNeRF)", words(of)))
}

#[cfg(test)]
mod tests;
