//! Means over seeds with their spread, the best of them marked.
//!
//! | file | answers |
//! |---|---|
//! | `forms` | tables as Markdown, CSV, JSON and LaTeX |
//! | `notes` | what readers have to know of the numbers, and what is missing |

mod forms;
mod notes;

use std::collections::BTreeSet;

pub(super) use self::notes::missing_note;
use super::published::{PUBLISHED, Published};
use super::record::Row;
use super::title;

/// Mean and sample standard deviation over seeds; the latter where there are several.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mean {
    /// Mean; `None` where nothing was measured.
    pub mean: Option<f64>,
    /// Standard deviation.
    pub spread: Option<f64>,
}

impl Mean {
    /// Of some values, of which those that are not there do not count.
    #[must_use]
    pub fn of(values: impl IntoIterator<Item = Option<f64>>) -> Self {
        let values: Vec<f64> = values.into_iter().flatten().collect();
        if values.is_empty() {
            return Self::default();
        }
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean) * (value - mean)).sum();
        let spread = (values.len() > 1).then(|| (squares / (count - 1.0)).sqrt());
        Self { mean: Some(mean), spread }
    }

    /// The mean, with the deviation behind `±` where there is one.
    pub(crate) fn text(self, digits: usize) -> String {
        match (self.mean, self.spread) {
            (None, _) => "–".to_owned(),
            (Some(mean), None) => format!("{mean:.digits$}"),
            (Some(mean), Some(spread)) => format!("{mean:.digits$} ± {spread:.digits$}"),
        }
    }
}

/// A measure of a table.
pub struct Measure {
    /// Heading.
    pub name: &'static str,
    /// Digits behind the point.
    digits: usize,
    /// Value of a row.
    of: fn(&Row) -> Option<f64>,
    /// Published value.
    published: fn(&Published) -> Option<f64>,
    /// True where the largest is marked as the best.
    has_best: bool,
}

/// Measures in the order of columns.
pub const MEASURES: [Measure; 9] = [
    Measure { name: "PQ %", digits: 2, of: |row| row.panoptic, published: |_| None, has_best: true },
    Measure { name: "IoU %", digits: 2, of: |row| row.iou, published: |_| None, has_best: true },
    Measure {
        name: "mAcc-pix %",
        digits: 2,
        of: |row| row.macc_pix,
        published: |p| Some(p.macc_pix),
        has_best: true,
    },
    Measure {
        name: "mAcc-inst %",
        digits: 2,
        of: |row| row.macc_inst,
        published: |p| Some(p.macc_inst),
        has_best: true,
    },
    Measure { name: "mIoU %", digits: 2, of: |row| row.miou, published: |p| Some(p.miou), has_best: true },
    Measure { name: "PSNR dB", digits: 2, of: |row| row.psnr, published: |p| p.psnr, has_best: true },
    Measure { name: "SSIM", digits: 4, of: |row| row.ssim, published: |_| None, has_best: true },
    Measure {
        name: "Gaussians",
        digits: 0,
        of: |row| Some(row.gaussians as f64),
        published: |_| None,
        has_best: false,
    },
    Measure { name: "seconds", digits: 1, of: |row| Some(row.seconds), published: |_| None, has_best: false },
];

/// Scores of a head or an ablation.
pub struct Line {
    /// Name in tables of numbers.
    pub name: String,
    /// Name for readers.
    pub title: String,
    /// By [`MEASURES`].
    pub means: Vec<Mean>,
    /// True where no other line has a larger mean.
    pub best: Vec<bool>,
    /// Published numbers, in words.
    pub published: String,
}

/// A table of one capture, or of the average over all.
pub struct Table {
    /// Caption.
    pub caption: String,
    /// Lines.
    pub lines: Vec<Line>,
}

/// Subject of the tables of a comparison.
pub struct Subject<'a> {
    /// Rows of all runs.
    pub rows: &'a [Row],
    /// Names in the order of lines.
    pub names: &'a [String],
    /// The only camera that SA4D trained on; empty for all.
    pub camera: &'a str,
    /// True for ablations.
    pub ablation: bool,
    /// Runs that are not done yet, also those of other tables.
    pub missing: &'a [Missing],
}

/// A run that is not done yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    /// Name of the capture.
    pub capture: String,
    /// The head, or the ablation.
    pub head: String,
    /// Seed.
    pub seed: u64,
}

fn in_words(published: &Published) -> String {
    let numbers: Vec<String> =
        MEASURES.iter().filter_map(|m| (m.published)(published).map(|value| format!("{value:.2}"))).collect();
    numbers.join(" / ")
}

fn captures(rows: &[Row]) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for row in rows {
        if !found.contains(&row.capture.as_str()) {
            found.push(&row.capture);
        }
    }
    found
}

impl Subject<'_> {
    /// A table per capture, and their average where there are several.
    #[must_use]
    pub fn tables(&self) -> Vec<Table> {
        let captures = captures(self.rows);
        let mut tables: Vec<Table> = captures.iter().map(|capture| self.table(&[*capture])).collect();
        if captures.len() > 1 {
            tables.push(self.table(&captures));
        }
        tables
    }

    /// Means over seeds of the means over some captures. A seed that lacks a capture does not count.
    fn table(&self, captures: &[&str]) -> Table {
        let is_average = captures.len() > 1;
        let mut lines: Vec<Line> = Vec::new();
        for name in self.names {
            let of_name: Vec<&Row> = self.rows.iter().filter(|row| row.head == *name).collect();
            let seeds: BTreeSet<u64> = of_name.iter().map(|row| row.seed).collect();
            let of_seed = |seed: u64, of: fn(&Row) -> Option<f64>| -> Option<f64> {
                let values: Option<Vec<f64>> = captures
                    .iter()
                    .map(|capture| {
                        let row = of_name.iter().find(|row| row.seed == seed && row.capture == *capture)?;
                        of(row)
                    })
                    .collect();
                values.map(|values| values.iter().sum::<f64>() / values.len() as f64)
            };
            let mean = |measure: &Measure| Mean::of(seeds.iter().map(|seed| of_seed(*seed, measure.of)));
            let means: Vec<Mean> = MEASURES.iter().map(mean).collect();
            if means.iter().all(|mean| mean.mean.is_none()) {
                continue;
            }
            let published = match (self.ablation, is_average) {
                (true, _) => PUBLISHED
                    .ablation
                    .rows
                    .get(name)
                    .map(|of| format!("{} ({})", in_words(of), PUBLISHED.ablation.scene)),
                (false, false) => PUBLISHED.of_capture(captures[0], name).map(|of| in_words(&of)),
                (false, true) => None,
            };
            let of_data_sets = || -> Option<String> {
                let of = |(set, heads): (&String, &std::collections::BTreeMap<String, Published>)| {
                    heads.get(name).map(|published| format!("{} ({set})", in_words(published)))
                };
                let found: Vec<String> = PUBLISHED.means.iter().filter_map(of).collect();
                (!self.ablation && !found.is_empty()).then(|| found.join("; "))
            };
            lines.push(Line {
                name: name.clone(),
                title: title(name, self.camera),
                best: vec![false; means.len()],
                means,
                published: published.or_else(of_data_sets).unwrap_or_else(|| "–".to_owned()),
            });
        }
        for (k, measure) in MEASURES.iter().enumerate().filter(|(_, measure)| measure.has_best) {
            // Equal as they are shown is equal.
            let shown = |line: &Line| {
                line.means[k].mean.map(|mean| (mean * 10f64.powi(measure.digits as i32)).round())
            };
            let most = lines.iter().filter_map(shown).fold(f64::NEG_INFINITY, f64::max);
            for line in &mut lines {
                line.best[k] = shown(line) == Some(most);
            }
        }
        let caption = match is_average {
            true => format!("average of {}", captures.join(", ")),
            false => captures[0].to_owned(),
        };
        Table { caption, lines }
    }

    /// Heading of the column of published numbers.
    pub(super) fn published_heading(&self) -> String {
        let measures: Vec<&str> = MEASURES
            .iter()
            .filter(|measure| {
                let some = PUBLISHED.ablation.rows.values().next();
                let has = some.is_some_and(|published| (measure.published)(published).is_some());
                has && (self.ablation || measure.name != "PSNR dB")
            })
            .map(|measure| measure.name)
            .collect();
        format!("published {}, other masks", measures.join(" / "))
    }
}

/// Cells of a line: what they say, and the best of their column.
pub(super) fn cells(line: &Line) -> Vec<(String, bool)> {
    let of = |((mean, measure), best): ((&Mean, &Measure), &bool)| (mean.text(measure.digits), *best);
    line.means.iter().zip(&MEASURES).zip(&line.best).map(of).collect()
}

#[cfg(test)]
mod tests;
