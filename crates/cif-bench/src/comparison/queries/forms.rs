//! Answers as text: Markdown and LaTeX with means, CSV and JSON with every answer.

use std::fmt::Write;

use serde_json::json;

use super::super::text::{self, TextLine, TextTable, csv_number, csv_text};
use super::{Cell, DIGITS, Line, Queries, Table};

/// Heading of the column of published numbers.
pub(in super::super) const PUBLISHED_HEADING: &str = "published mAcc / mIoU, other masks";

/// Text of a cell, and whether it is the best.
pub(in super::super) fn shown(cell: &Cell) -> (String, bool) {
    (cell.0.text(DIGITS), cell.1)
}

impl Queries {
    /// The tables as Markdown.
    #[must_use]
    pub fn markdown(&self) -> String {
        text::markdown(&self.texts(), &self.notes())
    }

    /// The tables as LaTeX, for the package `booktabs`.
    #[must_use]
    pub fn latex(&self) -> String {
        text::latex(&self.texts(), &self.notes())
    }

    fn texts(&self) -> Vec<TextTable> {
        let line = |Line { title, rule, cells, published }: Line| TextLine {
            texts: vec![title, rule.name().to_owned()],
            numbers: cells.iter().map(shown).collect(),
            published,
        };
        let table = |table: Table| TextTable {
            caption: table.caption,
            texts: vec!["by"],
            numbers: table.headings,
            published: PUBLISHED_HEADING.to_owned(),
            lines: table.lines.into_iter().map(line).collect(),
        };
        self.tables().into_iter().map(table).collect()
    }

    /// Every answer as CSV.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut text = String::from("capture,head,seed,question,by,macc,miou,frames,empty_frames,chosen\n");
        for answer in &self.answers {
            let chosen: Vec<String> = answer.chosen.iter().map(u16::to_string).collect();
            let _ = writeln!(
                text,
                "{},{},{},{},{},{},{},{},{},{}",
                csv_text(&answer.capture),
                answer.head,
                answer.seed,
                csv_text(&answer.question),
                answer.by.name(),
                csv_number(answer.macc),
                csv_number(answer.miou),
                answer.frames,
                answer.empty_frames,
                chosen.join(" ")
            );
        }
        text
    }

    /// Every answer as JSON.
    #[must_use]
    pub fn json(&self) -> String {
        format!("{:#}\n", json!(self.answers))
    }
}
