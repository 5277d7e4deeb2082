//! Tables as Markdown and LaTeX.

use std::fmt::Write;

/// A table whose columns are texts, numbers and what was published.
pub(super) struct TextTable {
    pub(super) caption: String,
    /// Headings of columns of text behind that of titles, of those of numbers, and of the published one.
    pub(super) texts: Vec<&'static str>,
    pub(super) numbers: Vec<String>,
    pub(super) published: String,
    pub(super) lines: Vec<TextLine>,
}

/// A line of such a table, without markup.
pub(super) struct TextLine {
    /// Title, and further texts.
    pub(super) texts: Vec<String>,
    /// Numbers as text, and whether each is the best of its column.
    pub(super) numbers: Vec<(String, bool)>,
    pub(super) published: String,
}

/// Tables and notes as Markdown.
pub(super) fn markdown(tables: &[TextTable], notes: &[String]) -> String {
    let mut text = String::new();
    for TextTable { caption, texts, numbers, published, lines } in tables {
        let _ = writeln!(text, "**{caption}**\n");
        let headings: Vec<&str> = texts
            .iter()
            .copied()
            .chain(numbers.iter().map(String::as_str))
            .chain([published.as_str()])
            .collect();
        let _ = writeln!(text, "| | {} |", headings.join(" | "));
        let (left, right) = ("|---".repeat(1 + texts.len()), "|---:".repeat(numbers.len()));
        let _ = writeln!(text, "{left}{right}|---|");
        for line in lines {
            let number =
                |(text, best): &(String, bool)| if *best { format!("**{text}**") } else { text.clone() };
            let mut cells = line.texts.clone();
            cells.extend(line.numbers.iter().map(number));
            cells.push(line.published.clone());
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        }
        text.push('\n');
    }
    for note in notes {
        let _ = writeln!(text, "{note}\n");
    }
    text
}

/// Tables and notes as LaTeX, for the package `booktabs`.
pub(super) fn latex(tables: &[TextTable], notes: &[String]) -> String {
    let mut text = String::new();
    for TextTable { caption, texts, numbers, published, lines } in tables {
        let _ = writeln!(text, "% {caption}");
        let (left, right) = ("l".repeat(1 + texts.len()), "r".repeat(numbers.len()));
        let _ = writeln!(text, "\\begin{{tabular}}{{{left}{right}l}}\n\\toprule");
        let mut headings = vec![latex_text(caption)];
        headings.extend(texts.iter().map(|heading| latex_text(heading)));
        headings.extend(numbers.iter().map(|heading| latex_text(heading)));
        headings.push(latex_text(published));
        let _ = writeln!(text, "{} \\\\\n\\midrule", headings.join(" & "));
        for line in lines {
            let number = |(text, best): &(String, bool)| {
                let text = latex_text(text);
                if *best { format!("\\textbf{{{text}}}") } else { text }
            };
            let mut cells: Vec<String> = line.texts.iter().map(|text| latex_text(text)).collect();
            cells.extend(line.numbers.iter().map(number));
            cells.push(latex_text(&line.published));
            let _ = writeln!(text, "{} \\\\", cells.join(" & "));
        }
        text.push_str("\\bottomrule\n\\end{tabular}\n\n");
    }
    for note in notes {
        let _ = writeln!(text, "% {note}");
    }
    text
}

/// Text for LaTeX.
fn latex_text(text: &str) -> String {
    let text = text.replace('\\', "\\textbackslash{}");
    let text = ['%', '_', '&', '#', '$', '{', '}'].into_iter().fold(text, |text, sign| {
        // A backslash that was replaced has braces of its own.
        if matches!(sign, '{' | '}') { text } else { text.replace(sign, &format!("\\{sign}")) }
    });
    text.replace(" ± ", " $\\pm$ ").replace('–', "--")
}

/// Text for CSV, which may hold anything.
pub(super) fn csv_text(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

/// A number for CSV, nothing where there is none.
pub(super) fn csv_number(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}
