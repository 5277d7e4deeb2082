//! Which layout a folder has.

use std::fmt;
use std::path::Path;

use crate::files::listing;
use crate::formats::colmap_sparse_folder;
use crate::{Error, Layout};

impl Layout {
    /// Every layout that can be read.
    pub const ALL: [Self; 5] = [Self::HyperNerf, Self::Neu3d, Self::DNerf, Self::Nerfstudio, Self::Colmap];

    /// Name as the command line spells it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::HyperNerf => "hyper-nerf",
            Self::Neu3d => "neu3d",
            Self::DNerf => "d-nerf",
            Self::Nerfstudio => "nerfstudio",
            Self::Colmap => "colmap",
        }
    }

    /// File or folder that marks a folder as this layout.
    #[must_use]
    pub fn marker(self) -> &'static str {
        match self {
            Self::HyperNerf => "dataset.json",
            Self::Neu3d => "poses_bounds.npy",
            Self::DNerf => "transforms_train.json or transforms_test.json",
            Self::Nerfstudio => "transforms.json",
            Self::Colmap => "sparse/0",
        }
    }

    fn fits(self, root: &Path) -> bool {
        match self {
            Self::HyperNerf | Self::Neu3d | Self::Nerfstudio => listing::is_there(&root.join(self.marker())),
            Self::DNerf => ["transforms_train.json", "transforms_test.json"]
                .iter()
                .any(|name| listing::is_there(&root.join(name))),
            Self::Colmap => colmap_sparse_folder(root).is_some(),
        }
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// Recognises the layout of a folder.
///
/// A COLMAP reconstruction beside another layout is what that layout was made from: the other one wins, with a
/// warning. Any other two are an error.
///
/// # Errors
/// When the folder is missing, nothing fits, two layouts fit, or the forced one does not.
pub(crate) fn recognise(
    root: &Path,
    forced: Option<Layout>,
    warnings: &mut Vec<String>,
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
    if fitting.len() > 1 && fitting.last() == Some(&Layout::Colmap) {
        fitting.pop();
        if fitting.len() == 1 {
            warnings.push(format!(
                "{}: read as {} ({}); the COLMAP reconstruction beside it is not used (--layout colmap reads it)",
                root.display(),
                fitting[0],
                fitting[0].marker()
            ));
        }
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
