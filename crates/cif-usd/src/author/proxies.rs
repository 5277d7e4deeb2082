//! Point proxies: stand-ins that every viewer can draw.
//!
//! A simulator that makes a shape of every geometric primitive, as MuJoCo does whatever its purpose, refuses a stage
//! with bare `Points`. So the points are the prototype of a `PointInstancer` that draws them once, in the form that
//! its documentation gives: traversals skip prototypes below an `over`, while viewers find them by relationship.

use cif_scene::{Motion, Node};
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use super::splats;
use crate::layer::{Layer, child};
use crate::tokens;

pub(super) fn author(scene: &Scene<'_, '_>, layer: &Layer<'_, '_>, place: &str, node: &Node) -> PyResult<()> {
    let Some(proxy) = &node.proxy else { return Ok(()) };
    match node.motion.parts() {
        None => points(scene, layer, place, node, 0..proxy.indices.len()),
        Some(motion) => motion.parts.iter().try_for_each(|part| {
            // Indices ascend, so those of a part stand together.
            let first = |splat: usize| proxy.indices.partition_point(|&index| (index as usize) < splat);
            let range = first(part.splats.start)..first(part.splats.end);
            points(scene, layer, &child(place, &part.name), node, range)
        }),
    }
}

fn points(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    place: &str,
    node: &Node,
    range: std::ops::Range<usize>,
) -> PyResult<()> {
    let (pxr, Some(proxy)) = (scene.pxr, &node.proxy) else { return Ok(()) };
    if range.is_empty() {
        return Ok(());
    }
    let (indices, widths) = (&proxy.indices[range.clone()], &proxy.widths[range.clone()]);
    let pick = |means: &[[f32; 3]]| -> Vec<[f32; 3]> {
        indices.iter().map(|&index| means[index as usize]).collect()
    };
    let instancer = layer.define(&child(place, tokens::PROXY), "PointInstancer")?;
    instancer.set("purpose", "Token", UNIFORM, tokens::PURPOSE_PROXY)?;
    instancer.set("positions", "Point3fArray", VARYING, pxr.vec3f_array(&[[0.0; 3]])?)?;
    instancer.set("protoIndices", "IntArray", VARYING, pxr.int_array(&[0])?)?;
    let prim = layer.define(&child(instancer.path(), tokens::PROXY_POINTS), "Points")?;
    instancer.relate("prototypes", prim.path())?;
    let at_rest = pick(&node.splats.means);
    let attribute = prim.set("points", "Point3fArray", VARYING, pxr.vec3f_array(&at_rest)?)?;
    let at_rest = pxr.vec3f_array(&points_box(&at_rest, widths))?;
    let extents = [
        instancer.set("extent", "Float3Array", VARYING, &at_rest)?,
        prim.set("extent", "Float3Array", VARYING, &at_rest)?,
    ];
    if let Motion::Dense(dense) = &node.motion {
        for sample in &dense.samples {
            let points = pick(&sample.means);
            attribute.sample(sample.time_code, pxr.vec3f_array(&points)?)?;
            let corners = pxr.vec3f_array(&points_box(&points, widths))?;
            extents.iter().try_for_each(|extent| extent.sample(sample.time_code, &corners))?;
        }
    }
    let widths = prim.set("widths", "FloatArray", VARYING, pxr.float_array(widths)?)?;
    widths.info("interpolation", tokens::VERTEX)?;
    splats::display_color(scene, &prim, &proxy.colors[range])?;
    let indices = crate::primvars::as_ints(indices);
    splats::ints(pxr, &prim, tokens::PRIMVAR_SPLAT, &indices)
}

/// Box of points with widths, in the single-precision arithmetic of usd-core itself: validators compare exactly.
fn points_box(points: &[[f32; 3]], widths: &[f32]) -> [[f32; 3]; 2] {
    let mut corners = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for (point, width) in points.iter().zip(widths) {
        let half = width / 2.0;
        for axis in 0..3 {
            corners[0][axis] = corners[0][axis].min(point[axis] - half);
            corners[1][axis] = corners[1][axis].max(point[axis] + half);
        }
    }
    corners
}
