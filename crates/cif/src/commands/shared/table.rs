//! Tables of reports.

/// A plain table with a heading. On a terminal its cells fold to the width; elsewhere every row is a line.
pub(in crate::commands) fn table<'a>(heading: impl IntoIterator<Item = &'a str>) -> comfy_table::Table {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::NOTHING).set_header(heading);
    table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    table
}

/// A number with some digits behind the point, or `n/a`.
pub(in crate::commands) fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("n/a".to_owned(), |value| format!("{value:.digits$}"))
}
