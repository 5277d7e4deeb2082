//! The frame of pages of measurements: they need no network and no other file.

use std::fmt::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::error::Error;

/// Style of all pages.
const STYLE: &str = include_str!("page.css");

/// Head of a page, as text.
pub(crate) struct Header<'a> {
    pub(crate) title: &'a str,
    pub(crate) heading: &'a str,
    pub(crate) description: &'a str,
    /// Sentence on the measurement; see [`measured_on`].
    pub(crate) how: String,
    pub(crate) command: &'a str,
    /// The missing part and how to get it; `None` on a whole page.
    pub(crate) missing: Option<String>,
}

/// Sentence on the threads and instructions that one process measured with.
pub(crate) fn measured_on(threads: usize, simd: &str) -> String {
    match threads {
        1 => format!("Measured on one thread with {simd}."),
        threads => format!("Measured on {threads} threads with {simd}."),
    }
}

/// Begins a page, up to where its header may go on with links; [`close`] ends it.
pub(crate) fn open(header: &Header<'_>) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<title>{}</title>\n<style>\n{STYLE}</style>\n\
         </head>\n<body>\n<header>\n<h1>{}</h1>\n<p>{}</p>\n<p class=\"how\">{} Made \
         by <code>{}</code>.</p>\n",
        escape(header.title),
        escape(header.heading),
        escape(header.description),
        escape(&header.how),
        escape(header.command),
    );
    if let Some(missing) = &header.missing {
        let _ = writeln!(page, "<p class=\"missing\">{}</p>", escape(missing));
    }
    page
}

/// Ends a page that [`open`] began and that went on with `<main>`; `footer` is text.
pub(crate) fn close(page: &mut String, footer: &str) {
    let _ = write!(page, "</main>\n<footer>{}</footer>\n</body>\n</html>\n", escape(footer));
}

/// Adds a table; headings and cells are HTML, every row with what its tag has besides its name.
pub(crate) fn table<'a>(
    page: &mut String,
    headings: impl IntoIterator<Item = &'a str>,
    rows: impl IntoIterator<Item = (&'static str, Vec<String>)>,
) {
    page.push_str("<div class=\"wide\"><table>\n<thead><tr>");
    for heading in headings {
        let _ = write!(page, "<th>{heading}</th>");
    }
    page.push_str("</tr></thead>\n<tbody>\n");
    for (attributes, cells) in rows {
        let _ = write!(page, "<tr{attributes}>");
        for cell in cells {
            let _ = write!(page, "<td>{cell}</td>");
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</tbody></table></div>\n");
}

/// Adds a plot, which is SVG, with its caption, which is text.
pub(crate) fn figure(page: &mut String, plot: &str, caption: &str) {
    let _ = writeln!(page, "<figure>{plot}<figcaption>{}</figcaption></figure>", escape(caption));
}

/// Text as it stands in HTML.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Adds a picture file with its caption.
pub(crate) fn picture(page: &mut String, path: &Path, caption: &str) -> Result<(), Error> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let caption = escape(caption);
    let _ = writeln!(
        page,
        "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>{caption}</figcaption></figure>",
        STANDARD.encode(bytes)
    );
    Ok(())
}

/// Adds a video file with its caption, which is text.
pub(crate) fn video(page: &mut String, path: &Path, caption: &str) -> Result<(), Error> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let _ = writeln!(
        page,
        "<figure><video controls loop muted src=\"data:video/mp4;base64,{}\"></video><figcaption>{}</figcaption></figure>",
        STANDARD.encode(bytes),
        escape(caption)
    );
    Ok(())
}
