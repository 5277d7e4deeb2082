//! Means over seeds with their spread, the best of them marked, as Markdown, CSV, JSON and LaTeX.

use std::collections::BTreeSet;
use std::fmt::Write;

use serde_json::json;

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

    fn text(self, digits: usize) -> String {
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
pub const MEASURES: [Measure; 7] = [
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

    /// The tables as Markdown.
    #[must_use]
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        for table in self.tables() {
            let _ = writeln!(text, "**{}**\n", table.caption);
            let headings: Vec<&str> = MEASURES.iter().map(|measure| measure.name).collect();
            let _ = writeln!(text, "| | {} | {} |", headings.join(" | "), self.published_heading());
            let _ = writeln!(text, "|---{}|---|", "|---:".repeat(MEASURES.len()));
            for line in &table.lines {
                let cells: Vec<String> = cells(line)
                    .into_iter()
                    .map(|(text, best)| if best { format!("**{text}**") } else { text })
                    .collect();
                let _ = writeln!(text, "| {} | {} | {} |", line.title, cells.join(" | "), line.published);
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
        let plain = |text: &str| {
            let text = text.replace('\\', "\\textbackslash{}");
            let text = ['%', '_', '&', '#', '$', '{', '}'].into_iter().fold(text, |text, sign| {
                // A backslash that was replaced has braces of its own.
                if matches!(sign, '{' | '}') { text } else { text.replace(sign, &format!("\\{sign}")) }
            });
            text.replace(" ± ", " $\\pm$ ").replace('–', "--")
        };
        let mut text = String::new();
        for table in self.tables() {
            let _ = writeln!(text, "% {}", table.caption);
            let _ = writeln!(text, "\\begin{{tabular}}{{l{}l}}\n\\toprule", "r".repeat(MEASURES.len()));
            let headings: Vec<String> = MEASURES.iter().map(|measure| plain(measure.name)).collect();
            let _ = writeln!(
                text,
                "{} & {} & {} \\\\\n\\midrule",
                plain(&table.caption),
                headings.join(" & "),
                plain(&self.published_heading())
            );
            for line in &table.lines {
                let cells: Vec<String> = cells(line)
                    .into_iter()
                    .map(
                        |(text, best)| {
                            if best { format!("\\textbf{{{}}}", plain(&text)) } else { plain(&text) }
                        },
                    )
                    .collect();
                let published = plain(&line.published);
                let _ = writeln!(text, "{} & {} & {published} \\\\", plain(&line.title), cells.join(" & "));
            }
            text.push_str("\\bottomrule\n\\end{tabular}\n\n");
        }
        for note in self.notes() {
            let _ = writeln!(text, "% {note}");
        }
        text
    }

    /// Every run as CSV.
    #[must_use]
    pub fn csv(&self) -> String {
        let mut text =
            String::from("capture,head,seed,macc_pix,macc_inst,miou,psnr,ssim,gaussians,seconds\n");
        let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
        for row in self.rows {
            let capture = format!("\"{}\"", row.capture.replace('"', "\"\""));
            let scores = [row.macc_pix, row.macc_inst, row.miou, row.psnr, row.ssim].map(number).join(",");
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

    /// Notes for readers of the tables.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        let mut notes = vec![
            "Means over the held-out frames, and over seeds with the sample standard deviation; the best of a column is \
             marked. Seconds are processor time, all threads together, on top of the one reconstruction that all rows \
             share."
                .to_owned(),
            format!(
                "Published numbers ({}, {}, arXiv {}) were taken against other masks and cannot be compared with ours; \
                 they tell the order of systems there. {}",
                PUBLISHED.source.title, PUBLISHED.source.venue, PUBLISHED.source.arxiv, PUBLISHED.note
            ),
        ];
        let has = |name: &str| self.names.iter().any(|other| other == name);
        if has("vlgs") {
            notes.push(
                "VLGS is a re-implementation: there is no public code. Its paper gives the channels (3 + 3), attention \
                 with a residual, the opacity of its own and the weight 1.2 of blended cameras; token width, starts, \
                 learning rates and the range of blending are ours, as the numbers of its authors' comparison are theirs."
                    .to_owned(),
            );
        }
        if has("sa4d") {
            notes.push(match self.camera {
                "" => "SA4D is trained on all cameras; its released code trains on one on Neu3D (cam16), as \
                       --set head.camera=cam16 does."
                    .to_owned(),
                camera => format!("SA4D is trained on the camera {camera} alone."),
            });
        }
        if has("trace3d") {
            notes.push(
                "Trace3D splits and deletes Gaussians and trains colours meanwhile, so that its PSNR and its number of \
                 Gaussians differ; all other heads leave the reconstruction as it is, but for CIF, which trains it on."
                    .to_owned(),
            );
        }
        notes
    }
}

/// Cells of a line: what they say, and the best of their column.
pub(super) fn cells(line: &Line) -> Vec<(String, bool)> {
    let of = |((mean, measure), best): ((&Mean, &Measure), &bool)| (mean.text(measure.digits), *best);
    line.means.iter().zip(&MEASURES).zip(&line.best).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(capture: &str, head: &str, seed: u64, miou: f64) -> Row {
        Row {
            capture: capture.into(),
            head: head.into(),
            seed,
            macc_pix: Some(90.0),
            miou: Some(miou),
            gaussians: 1_000,
            seconds: 12.5,
            ..Row::default()
        }
    }

    fn rows() -> Vec<Row> {
        vec![
            row("americano", "cif", 0, 80.0),
            row("americano", "cif", 1, 84.0),
            row("a_b", "cif", 0, 60.0),
            row("a_b", "cif", 1, 60.0),
            row("americano", "vlgs", 0, 90.0),
            row("americano", "vlgs", 1, 70.0),
            row("a_b", "vlgs", 0, 50.0),
        ]
    }

    #[test]
    fn means_are_over_captures_first_and_spreads_over_seeds() {
        let (rows, names) = (rows(), ["cif", "vlgs", "sa4d"].map(str::to_owned));
        let subject = Subject { rows: &rows, names: &names, camera: "", ablation: false };
        let tables = subject.tables();
        assert_eq!(
            tables.iter().map(|t| &t.caption[..]).collect::<Vec<_>>(),
            ["americano", "a_b", "average of americano, a_b"]
        );
        let miou = |table: usize, line: usize| tables[table].lines[line].means[2];
        assert_eq!(miou(0, 0), Mean { mean: Some(82.0), spread: Some(8f64.sqrt()) });
        assert_eq!(miou(0, 1).mean, Some(80.0));
        assert_eq!((miou(2, 0).mean, miou(2, 1)), (Some(71.0), Mean { mean: Some(70.0), spread: None }));
        let best = |table: usize| tables[table].lines.iter().map(|line| line.best[2]).collect::<Vec<_>>();
        assert_eq!((best(0), best(2)), (vec![true, false], vec![true, false]));
        assert_eq!(tables[0].lines[0].best[0], tables[0].lines[1].best[0], "equals are both the best");
        assert_eq!(tables[0].lines.len(), 2, "what was not run has no line");
        assert_eq!(tables[0].lines[1].published, "97.56 / 86.38 / 82.50");
        assert_eq!(
            tables[1].lines[1].published,
            "94.31 / 73.91 / 68.05 (HyperNeRF); 90.25 / 90.69 / 82.50 (Neu3D)"
        );
    }

    #[test]
    fn every_form_has_every_run() {
        let (rows, names) = (rows(), ["cif", "vlgs"].map(str::to_owned));
        let subject = Subject { rows: &rows, names: &names, camera: "", ablation: false };
        let markdown = subject.markdown();
        assert!(
            markdown.contains("| CIF | 90.00 ± 0.00 |") || markdown.contains("| CIF | **90.00 ± 0.00** |")
        );
        assert!(markdown.contains("VLGS (re-implementation)") && markdown.contains("no public code"));
        assert!(markdown.contains("published mAcc-pix % / mAcc-inst % / mIoU %, other masks"));
        let latex = subject.latex();
        assert!(latex.contains("a\\_b") && latex.contains("82.00 $\\pm$ 2.83") && !latex.contains(" % "));
        assert_eq!(subject.csv().lines().count(), rows.len() + 1);
        let json: serde_json::Value = serde_json::from_str(&subject.json()).unwrap();
        let keys = [
            "capture",
            "head",
            "seed",
            "macc_pix",
            "macc_inst",
            "miou",
            "psnr",
            "ssim",
            "gaussians",
            "seconds",
        ];
        for row in json.as_array().unwrap() {
            assert_eq!(row.as_object().unwrap().len(), keys.len());
            assert!(keys.iter().all(|key| row.get(key).is_some()));
        }
        let ablation =
            Subject { ablation: true, names: &["v".to_owned()], rows: &[row("x", "v", 0, 1.0)], camera: "" };
        assert!(ablation.markdown().contains("97.93 / 90.40 / 86.03 / 32.42 (split-cookie)"));
    }
}
