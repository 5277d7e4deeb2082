//! Authoring of a stage from a scene graph.

mod camera_prims;
mod clips;
mod context;
mod ground;
mod hulls;
mod instance;
mod joints;
mod levels;
mod metadata;
mod physics;
mod proxies;
mod splats;
mod transforms;

use std::path::Path;

use pyo3::prelude::*;

pub(crate) use context::{Scene, Storage};

use crate::layer::Layer;
use crate::tokens;

/// Writes the stage whose root layer is the file `root`, which does not exist yet.
pub(crate) fn author(scene: &Scene<'_, '_>, root: &Path) -> PyResult<()> {
    let layer = Layer::create(scene.pxr, root)?;
    let graph = scene.graph;
    metadata::author(scene, &layer, tokens::ROLE_ROOT, tokens::WORLD)?;
    let world = layer.define(tokens::WORLD, "Xform")?;
    world.info("kind", tokens::KIND_ASSEMBLY)?;
    transforms::world(scene.pxr, &world, &graph.frame)?;
    for node in &graph.nodes {
        instance::author(scene, &layer, node)?;
    }
    clips::author(scene, &world)?;
    if !graph.cameras.is_empty() {
        layer.define(tokens::CAMERAS, "Scope")?;
        for track in &graph.cameras {
            camera_prims::author(scene.pxr, &layer, track, graph.meters_per_unit)?;
        }
    }
    let ground = ground::height(graph, scene.options.ground);
    if ground.is_some() || graph.nodes.iter().any(|node| !node.colliders.is_empty()) {
        physics::gravity(scene, &layer)?;
    }
    if let Some(height) = ground {
        ground::author(scene, &layer, height)?;
    }
    layer.save()
}
