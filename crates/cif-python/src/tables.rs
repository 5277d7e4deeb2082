//! Small tables that notebooks show.

use cif::pictures::instance_color;
use cif_field::{Field, Identities};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Text inside HTML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// A table; cells are HTML.
fn table(caption: &str, heading: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut html = format!("<table><caption>{}</caption>", escaped(caption));
    let line = |cells: &[String], tag: &str| {
        let cells: String = cells.iter().map(|cell| format!("<{tag}>{cell}</{tag}>")).collect();
        format!("<tr>{cells}</tr>")
    };
    if !heading.is_empty() {
        html += &line(&heading.iter().map(|&cell| cell.to_owned()).collect::<Vec<_>>(), "th");
    }
    for row in rows {
        html += &line(&row, "td");
    }
    html + "</table>"
}

/// Per instance, the Gaussians that are most probably its own.
fn counts(identities: &Identities, instances: usize) -> Vec<usize> {
    let probabilities = identities.probabilities();
    let mut counts = vec![0; instances];
    for row in 0..identities.len() {
        let best = identities.range(row).max_by(|a, b| probabilities[*a].total_cmp(&probabilities[*b]));
        if let Some(entry) = best {
            counts[usize::from(identities.labels[entry])] += 1;
        }
    }
    counts
}

/// The instances of a field, in the colours that pictures show them in.
pub(crate) fn of_field(field: &Field) -> String {
    let counts = field.identities.as_ref().map(|identities| counts(identities, field.instances.len()));
    let rows = field.instances.iter().enumerate().map(|(index, instance)| {
        let [red, green, blue] = instance_color(instance.id);
        vec![
            format!("<span style=\"color: rgb({red}, {green}, {blue})\">&#9632;</span> {}", instance.id),
            escaped(&instance.label),
            escaped(&instance.category),
            counts.as_ref().map_or_else(String::new, |counts| counts[index].to_string()),
        ]
    });
    let (times, views) = (field.timeline.times.len(), field.cameras.len());
    let caption = format!("{} Gaussians, {times} times, {views} views", field.len());
    table(&caption, &["id", "label", "class", "Gaussians"], rows)
}

/// The counts of a capture.
pub(crate) fn of_summary(caption: &str, summary: &Bound<'_, PyDict>) -> PyResult<String> {
    let cell = |value: &Bound<'_, PyAny>| PyResult::Ok(escaped(value.str()?.to_str()?));
    let rows: Vec<Vec<String>> =
        summary.iter().map(|(name, value)| Ok(vec![cell(&name)?, cell(&value)?])).collect::<PyResult<_>>()?;
    Ok(table(caption, &[], rows))
}
