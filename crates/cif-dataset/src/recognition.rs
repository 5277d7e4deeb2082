//! Which layout a folder has.

use std::path::Path;

use crate::files::listing;
use crate::{Error, Layout, formats};

impl Layout {
    fn fits(self, root: &Path) -> bool {
        let has = |name: &str| listing::is_there(&root.join(name));
        match self {
            Self::HyperNerf | Self::DynamicGaussians | Self::Nerfstudio => has(self.marker()),
            Self::Neu3d => has("poses_bounds.npy") && !Self::Llff.fits(root),
            Self::Llff => {
                has("poses_bounds.npy") && !formats::has_rig(root) && formats::has_image_folder(root)
            }
            Self::DNerf => has("transforms_train.json") || has("transforms_test.json"),
            Self::Colmap => formats::colmap_sparse_model(root).is_some(),
        }
    }

    /// True when a folder that fits holds more of the layout than the file that marks it.
    fn is_complete(self, root: &Path) -> bool {
        let has = |name: &str| root.join(name).exists();
        match self {
            Self::HyperNerf => has("metadata.json") && has("camera") && has("rgb"),
            Self::DynamicGaussians => has("ims"),
            Self::Neu3d => formats::has_rig(root),
            Self::DNerf => has("transforms_train.json"),
            Self::Colmap => has("images"),
            Self::Llff | Self::Nerfstudio => true,
        }
    }
}

/// Recognises the layout of a folder.
///
/// A COLMAP reconstruction next to another layout is what that layout was made from, and a file that marks a layout
/// without the rest of it is left over: the other layout wins, with a note. Any other two are an error.
///
/// # Errors
/// When the folder is missing, nothing fits, two layouts fit, or the forced one does not.
pub(crate) fn recognise(
    root: &Path,
    forced: Option<Layout>,
    notes: &mut Vec<String>,
) -> Result<Layout, Error> {
    if !root.exists() {
        return Err(Error::MissingFolder { path: root.to_owned() });
    }
    if !root.is_dir() {
        return Err(Error::NotAFolder { path: root.to_owned() });
    }
    if let Some(layout) = forced {
        if layout.fits(root) {
            return Ok(layout);
        }
        return Err(Error::MissingFile {
            path: root.to_owned(),
            fix: format!("the layout {layout} was asked for, which needs {} there", layout.marker()),
        });
    }
    let mut fitting: Vec<Layout> = Layout::ALL.into_iter().filter(|layout| layout.fits(root)).collect();
    let mut others = Vec::new();
    if fitting.iter().any(|layout| layout.is_complete(root)) {
        let (complete, rest): (Vec<_>, Vec<_>) =
            fitting.into_iter().partition(|layout| layout.is_complete(root));
        others.extend(rest.iter().map(|layout| format!("of {layout} there is only {}", layout.marker())));
        fitting = complete;
    }
    if fitting.len() > 1 && fitting.last() == Some(&Layout::Colmap) {
        fitting.pop();
        others.push("--layout colmap reads the COLMAP reconstruction beside it, without times".to_owned());
    }
    if let (&[layout], false) = (&fitting[..], others.is_empty()) {
        notes.push(format!(
            "{}: read as {layout} ({}); {}",
            root.display(),
            layout.marker(),
            others.join("; ")
        ));
    }
    match fitting[..] {
        [] => Err(Error::NoLayout { root: root.to_owned(), hint: hint(root) }),
        [layout] => Ok(layout),
        [first, second, ..] => Err(Error::TwoLayouts { root: root.to_owned(), first, second }),
    }
}

/// Names subfolders that would fit.
fn hint(root: &Path) -> String {
    let fitting: Vec<String> = listing::entries(root)
        .unwrap_or_default()
        .into_iter()
        .filter(|path| path.is_dir() && Layout::ALL.iter().any(|layout| layout.fits(path)))
        .take(3)
        .map(|path| path.display().to_string())
        .collect();
    if fitting.is_empty() { String::new() } else { format!("; did you mean {}?", fitting.join(" or ")) }
}
