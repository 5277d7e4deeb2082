//! Nodes: who hangs from whom, and where they stand.

use glam::{DAffine3, DMat4, DQuat, DVec3};
use gltf::json;
use serde_json::Value;

use super::source::Source;
use crate::extras::{Cif, Extras};
use crate::{GltfError, VISIBILITY, conventions};

/// Transform of a node in its parent.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Local {
    /// Translation, rotation, scale.
    Parts(DVec3, DQuat, DVec3),
    /// Any affine matrix.
    Matrix(DAffine3),
}

impl Local {
    pub(crate) fn affine(&self) -> DAffine3 {
        match *self {
            Self::Parts(translation, rotation, scale) => {
                DAffine3::from_scale_rotation_translation(scale, rotation, translation)
            }
            Self::Matrix(matrix) => matrix,
        }
    }
}

/// A node that is in the scene.
pub(crate) struct Placed {
    pub(crate) index: usize,
    /// Nodes from the root of the scene down to this one, itself included.
    pub(crate) chain: Vec<usize>,
    /// Its `extras.cif`, where our exporter wrote it.
    pub(crate) cif: Option<Cif>,
}

/// Transforms of all nodes, and those of the scene in depth-first order.
pub(crate) struct Hierarchy {
    pub(crate) locals: Vec<Local>,
    pub(crate) placed: Vec<Placed>,
}

impl Hierarchy {
    pub(crate) fn read(source: &Source, warnings: &mut Vec<String>) -> Result<Self, GltfError> {
        let nodes = &source.root.nodes;
        let locals = (0..nodes.len()).map(|index| local(source, index)).collect::<Result<Vec<_>, _>>()?;
        let mut parents: Vec<Option<usize>> = vec![None; nodes.len()];
        for (parent, node) in nodes.iter().enumerate() {
            for child in node.children.iter().flatten().map(json::Index::value) {
                let slot = parents.get_mut(child).ok_or_else(|| {
                    source.invalid(
                        source.node_name(parent),
                        format!("its child {child} is no node of the file"),
                    )
                })?;
                if slot.replace(parent).is_some() {
                    return Err(source
                        .invalid(source.node_name(child), "it hangs from two nodes; nodes must form trees"));
                }
            }
        }
        let mut placed: Vec<Placed> = Vec::new();
        let mut seen = vec![false; nodes.len()];
        // Chains of chains would take memory beyond the file's size.
        let mut budget = (source.bytes / 4).max(1 << 16);
        let mut stack: Vec<(usize, Vec<usize>)> =
            roots(source, &parents)?.into_iter().rev().map(|root| (root, Vec::new())).collect();
        while let Some((index, mut chain)) = stack.pop() {
            if std::mem::replace(&mut seen[index], true) {
                return Err(source
                    .invalid(source.node_name(index), "it hangs from itself or stands in the scene twice"));
            }
            chain.push(index);
            budget = budget.checked_sub(chain.len() as u64).ok_or_else(|| {
                source
                    .invalid(source.node_name(index), "the nodes hang too deep from each other; flatten them")
            })?;
            let node = &nodes[index];
            for child in node.children.iter().flatten().rev() {
                stack.push((child.value(), chain.clone()));
            }
            placed.push(Placed { index, cif: ours(source, index, warnings), chain });
        }
        Ok(Self { locals, placed })
    }
}

/// Root nodes of the default scene, of the first one, or of the file.
fn roots(source: &Source, parents: &[Option<usize>]) -> Result<Vec<usize>, GltfError> {
    let scenes = &source.root.scenes;
    let chosen = source.root.scene.map_or(0, |scene| scene.value());
    let Some(scene) = scenes.get(chosen) else {
        if source.root.scene.is_some() {
            let what = format!("it is the default scene, but the file has {}", scenes.len());
            return Err(source.invalid(format!("scene {chosen}"), what));
        }
        return Ok((0..parents.len()).filter(|&node| parents[node].is_none()).collect());
    };
    let roots: Vec<usize> = scene.nodes.iter().map(json::Index::value).collect();
    match roots.iter().find(|&&root| root >= parents.len()) {
        Some(root) => {
            Err(source.invalid(format!("scene {chosen}"), format!("its node {root} is not in the file")))
        }
        None => Ok(roots),
    }
}

fn local(source: &Source, index: usize) -> Result<Local, GltfError> {
    let node = &source.root.nodes[index];
    let wrong = |what: &str| source.invalid(source.node_name(index), what);
    let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
    if let Some(matrix) = &node.matrix {
        if !finite(matrix) {
            return Err(wrong("its matrix is not finite; reset its transform"));
        }
        let mut matrix = DMat4::from_cols_array(&matrix.map(f64::from));
        if let Some(place) = source.places.get(&index) {
            matrix.w_axis = DVec3::from_array(*place).extend(1.0);
        }
        return Ok(Local::Matrix(DAffine3::from_mat4(matrix)));
    }
    let translation = node.translation.unwrap_or_default();
    let scale = node.scale.unwrap_or([1.0; 3]);
    if !finite(&translation) || !finite(&scale) {
        return Err(wrong("its translation or scale is not finite; reset its transform"));
    }
    let rotation = node.rotation.map_or([0.0, 0.0, 0.0, 1.0], |rotation| rotation.0.map(f64::from));
    let rotation = conventions::rotation(rotation)
        .ok_or_else(|| wrong("its rotation has no length; give it (0, 0, 0, 1)"))?;
    let translation =
        source.places.get(&index).map_or(vector(translation), |place| DVec3::from_array(*place));
    Ok(Local::Parts(translation, rotation, vector(scale)))
}

pub(crate) fn vector(values: [f32; 3]) -> DVec3 {
    DVec3::from_array(values.map(f64::from))
}

/// `extras.cif` of a node.
fn ours(source: &Source, index: usize, warnings: &mut Vec<String>) -> Option<Cif> {
    let extras = source.root.nodes[index].extras.as_ref()?.get();
    serde_json::from_str::<Value>(extras).ok()?.get("cif")?;
    match serde_json::from_str::<Extras>(extras) {
        Ok(extras) => Some(extras.cif),
        Err(error) => {
            warnings.push(format!(
                "{}: extras.cif was changed so that it cannot be read ({error}); taken as a node of another program",
                source.node_name(index)
            ));
            None
        }
    }
}

/// True when `KHR_node_visibility` hides a node.
pub(crate) fn is_hidden(source: &Source, index: usize) -> bool {
    let extensions = source.root.nodes[index].extensions.as_ref();
    extensions
        .and_then(|extensions| extensions.others.get(VISIBILITY))
        .and_then(|extension| extension.get("visible"))
        .and_then(Value::as_bool)
        == Some(false)
}
