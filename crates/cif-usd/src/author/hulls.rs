//! Convex hulls as collision meshes.

use cif_scene::{ConvexHull, Node};
use glam::Vec3;
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use crate::layer::{Layer, child};
use crate::tokens;

pub(super) fn author(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, place: &str, node: &Node) -> PyResult<()> {
    let masses = cif_scene::masses(scene.graph, node, scene.options.density);
    for (index, (hull, mass)) in node.colliders.iter().zip(masses).enumerate() {
        let part = hull.part.zip(node.motion.parts()).and_then(|(part, motion)| motion.parts.get(part));
        let place = part.map_or_else(|| place.to_owned(), |part| child(place, &part.name));
        // The number gives the order over all parts.
        let name = match index {
            0 => tokens::COLLIDER.to_owned(),
            _ => format!("{}_{index:02}", tokens::COLLIDER),
        };
        mesh(scene, layer, &child(&place, &name), hull, mass)?;
    }
    Ok(())
}

/// A mesh with its mass in kg: MuJoCo reads masses of colliders alone.
fn mesh(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    path: &str,
    hull: &ConvexHull,
    mass: f64,
) -> PyResult<()> {
    let pxr = scene.pxr;
    let prim = layer.define(path, "Mesh")?;
    prim.apply(&["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "PhysicsMassAPI"])?;
    prim.set("physics:mass", "Float", VARYING, mass)?;
    prim.set("purpose", "Token", UNIFORM, tokens::PURPOSE_GUIDE)?;
    prim.set("physics:approximation", "Token", UNIFORM, "convexHull")?;
    prim.set("subdivisionScheme", "Token", UNIFORM, "none")?;
    prim.set("points", "Point3fArray", VARYING, pxr.vec3f_array(&hull.points)?)?;
    let low = hull.points.iter().fold(Vec3::INFINITY, |low, &point| low.min(point.into()));
    let high = hull.points.iter().fold(Vec3::NEG_INFINITY, |high, &point| high.max(point.into()));
    let extent = pxr.vec3f_array(&[low.to_array(), high.to_array()])?;
    prim.set("extent", "Float3Array", VARYING, extent)?;
    let counts = vec![3; hull.triangles.len()];
    prim.set("faceVertexCounts", "IntArray", VARYING, pxr.int_array(&counts)?)?;
    let indices = crate::primvars::as_ints(hull.triangles.as_flattened());
    prim.set("faceVertexIndices", "IntArray", VARYING, pxr.int_array(&indices)?)?;
    let normals: Vec<[f32; 3]> =
        hull.triangles.iter().flat_map(|corners| [normal(hull, corners); 3]).collect();
    let normals = prim.set("normals", "Normal3fArray", VARYING, pxr.vec3f_array(&normals)?)?;
    normals.info("interpolation", tokens::FACE_VARYING)
}

/// Unit normal of a triangle; up for one without area.
fn normal(hull: &ConvexHull, corners: &[u32; 3]) -> [f32; 3] {
    let [a, b, c] = corners.map(|corner| Vec3::from(hull.points[corner as usize]));
    (b - a).cross(c - a).normalize_or(Vec3::Z).to_array()
}
