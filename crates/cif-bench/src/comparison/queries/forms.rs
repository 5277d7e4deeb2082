//! Answers as text: Markdown and LaTeX with means, CSV and JSON with every answer.

use std::fmt::Write;

use serde_json::json;

use super::super::tables::{csv_number, csv_text, latex_text};
use super::{Cell, DIGITS, Line, Queries};

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
        let mut text = String::new();
        for table in self.tables() {
            let _ = writeln!(text, "**{}**\n", table.caption);
            let _ = writeln!(text, "| | by | {} | {PUBLISHED_HEADING} |", table.headings.join(" | "));
            let _ = writeln!(text, "|---|---{}|---|", "|---:".repeat(table.headings.len()));
            for Line { title, way, cells, published } in &table.lines {
                let cells = cells.iter().map(shown);
                let cells: Vec<String> =
                    cells.map(|(text, best)| if best { format!("**{text}**") } else { text }).collect();
                let _ = writeln!(text, "| {title} | {} | {} | {published} |", way.name(), cells.join(" | "));
            }
            text.push('\n');
        }
        for note in self.notes() {
            let _ = writeln!(text, "{note}\n");
        }
        text
    }

    /// The tables as LaTeX, for the package `booktabs`.
    #[must_use]
    pub fn latex(&self) -> String {
        let mut text = String::new();
        for table in self.tables() {
            let _ = writeln!(text, "% {}", table.caption);
            let columns = "r".repeat(table.headings.len());
            let _ = writeln!(text, "\\begin{{tabular}}{{ll{columns}l}}\n\\toprule");
            let headings: Vec<String> = table.headings.iter().map(|heading| latex_text(heading)).collect();
            let _ = writeln!(
                text,
                "{} & by & {} & {PUBLISHED_HEADING} \\\\\n\\midrule",
                latex_text(&table.caption),
                headings.join(" & ")
            );
            for Line { title, way, cells, published } in &table.lines {
                let cell = |(text, best): (String, bool)| match best {
                    true => format!("\\textbf{{{}}}", latex_text(&text)),
                    false => latex_text(&text),
                };
                let cells: Vec<String> = cells.iter().map(shown).map(cell).collect();
                let (title, published) = (latex_text(title), latex_text(published));
                let _ = writeln!(text, "{title} & {} & {} & {published} \\\\", way.name(), cells.join(" & "));
            }
            text.push_str("\\bottomrule\n\\end{tabular}\n\n");
        }
        for note in self.notes() {
            let _ = writeln!(text, "% {note}");
        }
        text
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
