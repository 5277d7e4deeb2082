//! Scenes of any format as scene graphs.

use std::path::Path;

use cif_field::Field;
use cif_scene::{SceneGraph, SceneOptions};

use crate::error::Error;

/// What a file name says about its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `.cif`: a field.
    Field,
    /// `.usda`, `.usdc`, `.usdz`, `.usd`.
    Usd,
    /// `.glb`, `.gltf`.
    Gltf,
    /// `.ply`.
    Ply,
}

/// Endings that can be read, for messages.
const ENDINGS: &str = ".usda, .usdc, .usdz (USD), .glb, .gltf (glTF) or .ply (splats)";

impl Format {
    /// The format that the ending of a name tells.
    ///
    /// # Errors
    /// When no reader knows the ending.
    pub fn of(path: &Path) -> Result<Self, Error> {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        match ending.as_str() {
            "cif" => Ok(Self::Field),
            "usd" | "usda" | "usdc" | "usdz" => Ok(Self::Usd),
            "glb" | "gltf" => Ok(Self::Gltf),
            "ply" => Ok(Self::Ply),
            _ => Err(Error::usage(
                format!(
                    "{}: the ending of the name tells the format, and this one is not known",
                    path.display()
                ),
                format!("give a file that ends in {ENDINGS}"),
            )),
        }
    }
}

/// Reads a file of an exchange format as the graph that it holds.
///
/// # Errors
/// When the file is missing or broken, is a `.cif`, or its ending is not known.
pub fn read(path: &Path) -> Result<SceneGraph, Error> {
    read_following(path, false)
}

/// As [`read`]; with `follow_external` stages may bring in layers from outside their folder.
///
/// # Errors
/// As [`read`].
pub fn read_following(path: &Path, follow_external: bool) -> Result<SceneGraph, Error> {
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a file is expected here", path.display()),
            format!("give a file that ends in {ENDINGS}"),
        ));
    }
    match Format::of(path)? {
        Format::Usd => {
            let options = cif_usd::ReadOptions { follow_external };
            cif_usd::read_scene_with(path, options).map_err(Error::plain)
        }
        Format::Gltf => cif_gltf::read_scene(path).map_err(Error::plain),
        Format::Ply => cif_ply::read(path).map_err(Error::plain),
        Format::Field => Err(Error::usage(
            format!("{} is a scene of cif already", path.display()),
            format!("give a file that ends in {ENDINGS}"),
        )),
    }
}

/// Reads two files of any format to be compared. A `.cif` beside a file that was exported becomes the graph that
/// it would be exported as with the same options.
///
/// # Errors
/// As [`read`], and when a scene cannot be loaded or has nothing to show.
pub fn read_both(first: &Path, second: &Path) -> Result<[SceneGraph; 2], Error> {
    enum Read {
        Graph(Box<SceneGraph>),
        Field(Box<Field>),
    }
    let read = |path: &Path| match Format::of(path)? {
        Format::Field => Ok(Read::Field(Box::new(Field::load(path).map_err(Error::plain)?))),
        _ => read(path).map(|graph| Read::Graph(Box::new(graph))),
    };
    let both = [read(first)?, read(second)?];
    let options = both.iter().find_map(|one| match one {
        Read::Graph(graph) => graph.origin.options.clone(),
        Read::Field(_) => None,
    });
    let options = SceneOptions { proxy_points: 0, ..options.unwrap_or_default() };
    let graph = |one: Read| match one {
        Read::Graph(graph) => Ok(*graph),
        Read::Field(field) => cif_scene::build(&field, &options).map_err(Error::plain),
    };
    let [first, second] = both;
    Ok([graph(first)?, graph(second)?])
}
