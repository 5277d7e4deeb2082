//! Tables as text: Markdown and LaTeX with means, CSV and JSON with every run.

use std::fmt::Write;

use serde_json::json;

use super::{MEASURES, Subject, cells};

/// Text for LaTeX.
pub(in super::super) fn latex_text(text: &str) -> String {
    let text = text.replace('\\', "\\textbackslash{}");
    let text = ['%', '_', '&', '#', '$', '{', '}'].into_iter().fold(text, |text, sign| {
        // A backslash that was replaced has braces of its own.
        if matches!(sign, '{' | '}') { text } else { text.replace(sign, &format!("\\{sign}")) }
    });
    text.replace(" ± ", " $\\pm$ ").replace('–', "--")
}

/// Text for CSV, which may hold anything.
pub(in super::super) fn csv_text(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

/// A number for CSV, nothing where there is none.
pub(in super::super) fn csv_number(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

impl Subject<'_> {
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
        let mut text = String::new();
        for table in self.tables() {
            let _ = writeln!(text, "% {}", table.caption);
            let _ = writeln!(text, "\\begin{{tabular}}{{l{}l}}\n\\toprule", "r".repeat(MEASURES.len()));
            let headings: Vec<String> = MEASURES.iter().map(|measure| latex_text(measure.name)).collect();
            let _ = writeln!(
                text,
                "{} & {} & {} \\\\\n\\midrule",
                latex_text(&table.caption),
                headings.join(" & "),
                latex_text(&self.published_heading())
            );
            for line in &table.lines {
                let cells: Vec<String> =
                    cells(line)
                        .into_iter()
                        .map(|(text, best)| {
                            if best {
                                format!("\\textbf{{{}}}", latex_text(&text))
                            } else {
                                latex_text(&text)
                            }
                        })
                        .collect();
                let published = latex_text(&line.published);
                let _ =
                    writeln!(text, "{} & {} & {published} \\\\", latex_text(&line.title), cells.join(" & "));
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
        for row in self.rows {
            let capture = csv_text(&row.capture);
            let scores =
                [row.macc_pix, row.macc_inst, row.miou, row.psnr, row.ssim].map(csv_number).join(",");
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
