//! Pages as files that work from disk.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use cif_scene::files::{FileError, begins_with, existing_folder, target_of};
use cif_scene::{ExportOptions, ExportSummary, SceneGraph};
use flate2::Compression;
use flate2::write::GzEncoder;

use crate::assets::html;
use crate::describe::{InstanceColor, Page, describe};
use crate::error::WebError;

/// First line of our files; marks what may be replaced.
const MARK: &str = "<!doctype html>\n<!-- cif ";

/// Checks everything about an output that can be checked before the work starts.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), WebError> {
    existing_folder(path)?;
    let target = target_of(path, false)?;
    if target.exists() && !options.force && !begins_with(&target, MARK.as_bytes()) {
        return Err(FileError::Foreign { path: path.to_owned() }.into());
    }
    Ok(())
}

/// Writes a scene graph as one page that plays it.
///
/// # Errors
/// A missing folder, a file there that is not ours (without [`ExportOptions::force`]), disk full.
pub fn export(
    graph: &SceneGraph,
    path: &Path,
    options: ExportOptions,
    color: InstanceColor,
) -> Result<ExportSummary, WebError> {
    check_target(path, options)?;
    let title = path.file_stem().unwrap_or_default().to_string_lossy();
    let page = describe(graph, &title, &BTreeMap::new(), color);
    let write = |source| FileError::Write { path: path.to_owned(), source };
    let text = file(&page).map_err(write)?;
    cif_output::write(&target_of(path, false)?, text.as_bytes()).map_err(write)?;
    Ok(ExportSummary {
        path: path.to_owned(),
        files: vec![path.to_owned()],
        bytes: text.len() as u64,
        nodes: graph.nodes.len(),
        splats: graph.nodes.iter().map(|node| node.splats.len()).sum(),
        samples: graph.time_codes.samples.len(),
        not_held: Vec::new(),
        library: None,
        kept: Vec::new(),
    })
}

/// The whole file of a page.
///
/// # Errors
/// None but those of writers, which memory does not have.
pub fn file(page: &Page) -> io::Result<String> {
    let document = serde_json::to_string(&page.document)?;
    let mut packed = GzEncoder::new(Vec::new(), Compression::best());
    packed.write_all(&page.bytes)?;
    let bytes = BASE64_STANDARD.encode(packed.finish()?);
    // No text of a scene may end the element.
    let document = document.replace('<', "\\u003c");
    let data = format!(
        "<script type=\"application/json\" id=\"document\">{document}</script>\n\
         <script type=\"text/plain\" id=\"bytes\">{bytes}</script>"
    );
    let page = html(&page.document.title, &data).text;
    let body = page.strip_prefix("<!doctype html>\n").unwrap_or(&page);
    Ok(format!("{MARK}{} -->\n{body}", env!("CARGO_PKG_VERSION")))
}
