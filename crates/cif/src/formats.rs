//! The formats that scenes are exchanged in, and files of any of them as scene graphs.

use std::path::Path;

use cif_dataset::TimeWindow;
use cif_field::Field;
use cif_scene::{ExportOptions, ExportSummary, ReadOptions, SceneFormat, SceneGraph, SceneOptions};

use crate::error::Error;
use crate::lock::Lock;
use crate::pictures::instance_color;

/// Every format that is read or written. A new one is a crate that implements [`SceneFormat`], and a line here.
pub static FORMATS: [&dyn SceneFormat; 4] =
    [&cif_usd::Usd, &cif_gltf::Gltf, &cif_ply::Ply, &cif_web::Html { color: instance_color }];

/// Content of a file, by its name.
#[derive(Clone, Copy)]
pub enum Content {
    /// `.cif`: a field.
    Field,
    /// A scene graph in this format.
    Graph(&'static dyn SceneFormat),
}

impl Content {
    /// Content by the ending of a name.
    ///
    /// # Errors
    /// When no reader knows the ending.
    pub fn of(path: &Path) -> Result<Self, Error> {
        if is_field(path) {
            return Ok(Self::Field);
        }
        let found = recognised(path).map(Self::Graph);
        found.ok_or_else(|| unknown_ending(path, &format!(".cif, {}", endings())))
    }
}

/// True when a path names a trained scene rather than a file of an exchange format or a capture.
#[must_use]
pub fn is_field(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("cif"))
}

/// The exchange format of a file.
///
/// # Errors
/// When its ending is not known.
pub fn format_of(path: &Path) -> Result<&'static dyn SceneFormat, Error> {
    recognised(path).ok_or_else(|| unknown_ending(path, &endings()))
}

fn recognised(path: &Path) -> Option<&'static dyn SceneFormat> {
    FORMATS.into_iter().find(|format| format.recognises(path))
}

/// Endings of splats in formats that are not read, which a converter unpacks.
const PACKED: [&str; 5] = ["spz", "splat", "ksplat", "sog", "lcc"];

fn unknown_ending(path: &Path, known: &str) -> Error {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
    let name = path.display();
    if PACKED.contains(&ending.as_str()) {
        let unpacked = path.with_extension("ply");
        return Error::usage(
            format!("{name}: files of splats that end in .{ending} are not read"),
            format!(
                "convert it, for example with: splat-transform {name} {}; or use {known}",
                unpacked.display()
            ),
        );
    }
    Error::usage(
        format!("{name}: the format follows from the ending of the name, and this ending is not known"),
        format!("use {known}"),
    )
}

/// Endings that can be read, for messages: `.usda, .usdc (USD), .glb (glTF) or .ply (PLY)`.
#[must_use]
pub fn endings() -> String {
    let of_format = |format: &&dyn SceneFormat| {
        let endings: Vec<String> =
            format.about().endings.iter().map(|ending| format!(".{}", ending.name)).collect();
        format!("{} ({})", endings.join(", "), format.about().name)
    };
    let mut all: Vec<String> =
        FORMATS.iter().filter(|format| format.about().is_read).map(of_format).collect();
    let last = all.pop().unwrap_or_default();
    format!("{} or {last}", all.join(", "))
}

/// Reads a file of an exchange format as one scene: of a stage of several windows of time, that of `window`.
///
/// # Errors
/// When it has other windows than the one that is asked for, and as [`read_all`].
pub fn read(path: &Path, options: ReadOptions, window: Option<TimeWindow>) -> Result<SceneGraph, Error> {
    let graph = read_all(path, options)?;
    let count = graph.windows.len().max(1);
    if count == 1 && window.is_none() {
        return Ok(graph);
    }
    let asked = window.filter(|window| window.count() as usize == count);
    let found = asked.and_then(|window| cif_scene::window_alone(&graph, window.number() as usize - 1));
    found.ok_or_else(|| {
        let (file, problem) = (
            path.display(),
            match count {
                1 => "its splats are the same at all times, without windows".to_owned(),
                _ => format!("its splats are those of {count} windows of time, one after the other"),
            },
        );
        let fix = match count {
            1 => "leave out --window".to_owned(),
            _ => format!("take one: --window 1/{count}"),
        };
        Error::failed(format!("{file}: {problem}"), fix)
    })
}

/// Reads a file of an exchange format as the graph that it holds, with all windows of time.
///
/// # Errors
/// When the file is missing or broken, is a `.cif`, or its ending is not known.
pub fn read_all(path: &Path, options: ReadOptions) -> Result<SceneGraph, Error> {
    let advice = || format!("use {}", endings());
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a file is expected here", path.display()),
            advice(),
        ));
    }
    match Content::of(path)? {
        Content::Graph(format) => format.read(path, options).map_err(Error::plain),
        Content::Field => {
            Err(Error::usage(format!("{} is a scene of cif already", path.display()), advice()))
        }
    }
}

/// Writes a scene graph, while no other command changes the file.
///
/// # Errors
/// When another command goes on changing it, and as [`SceneFormat::write`].
pub fn write(
    format: &dyn SceneFormat,
    graph: &SceneGraph,
    path: &Path,
    options: &ExportOptions,
) -> Result<ExportSummary, Error> {
    let _lock = Lock::wait(path)?;
    format.write(graph, path, options).map_err(Error::plain)
}

/// The field that shows what a file shows, as `cif import` makes it without a base.
///
/// # Errors
/// When what was read from `path` does not fit together.
pub fn field_of(graph: &SceneGraph, path: &Path) -> Result<Field, Error> {
    cif_scene::field_from_graph(graph, &name_of(path)).map_err(Error::plain)
}

/// Name by which a scene records a file, without its folder.
#[must_use]
pub fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Reads two files of any format to be compared. A `.cif` that is compared with an exported file becomes the graph that
/// it would be exported as with the same options.
///
/// # Errors
/// As [`read`], and when a scene cannot be loaded or has nothing to show.
pub fn read_both(first: &Path, second: &Path) -> Result<[SceneGraph; 2], Error> {
    enum Read {
        Graph(Box<SceneGraph>),
        Field(Box<Field>),
    }
    let read = |path: &Path| match Content::of(path)? {
        Content::Field => Ok(Read::Field(Box::new(Field::load(path).map_err(Error::plain)?))),
        Content::Graph(_) => {
            read(path, ReadOptions::default(), None).map(|graph| Read::Graph(Box::new(graph)))
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ending_belongs_to_one_format() {
        for format in FORMATS {
            for ending in format.about().endings {
                let name = format!("scene.{}", ending.name.to_uppercase());
                let path = Path::new(&name);
                assert_eq!(FORMATS.iter().filter(|other| other.recognises(path)).count(), 1, "{name}");
                assert_eq!(format_of(path).unwrap().about().key, format.about().key);
                assert_eq!(format.writes(path), ending.written, "{name}");
            }
            assert!(
                format.about().endings[0].written,
                "{}: the first ending is taken where nobody says",
                format.about().name
            );
        }
        assert!(matches!(Content::of(Path::new("a.cif")), Ok(Content::Field)));
        for (name, ways) in
            [("a.SPZ", ["splat-transform a.SPZ a.ply", ".glb"]), ("a.obj", ["not known", ".ply"])]
        {
            let message = Content::of(Path::new(name)).err().unwrap().with_help();
            assert!(ways.iter().all(|way| message.contains(way)), "{message}");
        }
        assert_eq!(endings(), ".usda, .usdc, .usdz, .usd (USD), .glb, .gltf (glTF) or .ply (PLY)");
    }
}
