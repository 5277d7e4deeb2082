//! Tables as text: Markdown and LaTeX with means, CSV and JSON with every run.

use std::fmt::Write;

use serde_json::json;

use super::super::text::{self, TextLine, TextTable, csv_number, csv_text};
use super::{Line, MEASURES, Subject, Table, cells};

impl Subject<'_> {
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
        let line = |line: &Line| TextLine {
            texts: vec![line.title.clone()],
            numbers: cells(line).into_iter().collect(),
            published: line.published.clone(),
        };
        let table = |table: Table| TextTable {
            texts: Vec::new(),
            numbers: MEASURES.iter().map(|measure| measure.name.to_owned()).collect(),
            published: self.published_heading(),
            lines: table.lines.iter().map(line).collect(),
            caption: table.caption,
        };
        self.tables().into_iter().map(table).collect()
    }

    /// Every run as CSV.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut text = String::from(
            "capture,head,seed,panoptic,iou,macc_pix,macc_inst,miou,psnr,ssim,gaussians,seconds\n",
        );
        for row in self.rows {
            let capture = csv_text(&row.capture);
            let panoptic = [row.panoptic, row.iou];
            let of_labelled = [row.macc_pix, row.macc_inst, row.miou];
            let scores = panoptic.into_iter().chain(of_labelled).chain([row.psnr, row.ssim]).map(csv_number);
            let scores = scores.collect::<Vec<_>>().join(",");
            let _ = writeln!(
                text,
                "{capture},{},{},{scores},{},{}",
                row.head, row.seed, row.gaussians, row.seconds
            );
        }
        text
    }

    /// Every run as JSON.
    #[must_use]
    pub fn json(&self) -> String {
        format!("{:#}\n", json!(self.rows))
    }
}
