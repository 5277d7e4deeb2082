//! The part of `cif export` that writes glTF.

use std::path::{Path, PathBuf};

use cif_field::Field;
use cif_scene::{SceneGraph, SceneOptions};
use clap::Args;

use crate::error::Error;
use crate::output::Outputs;

#[derive(Debug, Args)]
pub(super) struct Gltf {
    /// glTF to write; the ending decides: .glb (one file), .gltf (text beside a .bin). Objects that deform
    /// move as a few rigid parts; the table says what that misses
    #[arg(long, value_name = "OUT.glb|gltf")]
    pub(super) gltf: Option<PathBuf>,
}

impl Gltf {
    /// Checks the target before the work starts.
    pub(super) fn check(&self, force: bool, outputs: &mut Outputs) -> Result<(), Error> {
        let Some(path) = &self.gltf else { return Ok(()) };
        let known = ["glb", "gltf"].contains(&ending(path).as_str());
        if !known {
            return Err(Error::usage(
                format!("--gltf {}: the ending decides the format", path.display()),
                "end the name in .glb (one file) or .gltf (text beside a .bin)",
            ));
        }
        outputs.file(path)?;
        if ending(path) == "gltf" {
            outputs.file(&path.with_extension("bin"))?;
        }
        cif_gltf::check_target(path, cif_gltf::ExportOptions { force }).map_err(Error::plain)
    }

    /// Options of a graph that glTF can hold.
    pub(super) fn options(options: &SceneOptions) -> SceneOptions {
        let most_expensive_motion = options.most_expensive_motion.min(cif_gltf::MOST_EXPENSIVE_MOTION);
        SceneOptions { most_expensive_motion, ..options.clone() }
    }

    /// Writes the file. A graph of dense motion is built again without it and given back.
    pub(super) fn write(
        &self,
        field: &Field,
        graph: &SceneGraph,
        options: &SceneOptions,
        force: bool,
    ) -> Result<Option<SceneGraph>, Error> {
        let Some(path) = &self.gltf else { return Ok(None) };
        let rebuilt = match graph.nodes.iter().any(|node| node.model() > cif_gltf::MOST_EXPENSIVE_MOTION) {
            true => Some(cif_scene::build(field, &Self::options(options)).map_err(Error::plain)?),
            false => None,
        };
        let graph = rebuilt.as_ref().unwrap_or(graph);
        let written =
            cif_gltf::export(graph, path, cif_gltf::ExportOptions { force }).map_err(Error::plain)?;
        for lost in &written.not_held {
            eprintln!("warning: glTF does not hold everything of {lost}");
        }
        eprintln!(
            "wrote {}: {} nodes, {} splats, {} time samples, {:.1} MB",
            written.path.display(),
            written.nodes,
            written.splats,
            written.samples,
            written.bytes as f64 / 1e6
        );
        Ok(rebuilt)
    }
}

fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_lowercase()
}
