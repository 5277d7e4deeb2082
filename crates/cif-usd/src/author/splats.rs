//! Splats: one `ParticleField3DGaussianSplat`.

use cif_field::SortMetric;
use cif_geometry::{Bounds, RigidTransform};
use cif_scene::graph::SHARES_PER_SPLAT;
use cif_scene::{IdentityShares, extent};
use pyo3::prelude::*;

use super::context::{Scene, UNIFORM, VARYING};
use super::levels::Selection;
use crate::layer::{Layer, Prim, child};
use crate::pxr::Pxr;
use crate::{primvars, tokens};

/// Token of a blending order.
pub(super) fn sorting(metric: SortMetric) -> &'static str {
    match metric {
        SortMetric::Z => tokens::SORT_Z_DEPTH,
        SortMetric::Distance => tokens::SORT_CAMERA_DISTANCE,
    }
}

fn box_array<'py>(pxr: &Pxr<'py>, bounds: &Bounds) -> PyResult<Bound<'py, PyAny>> {
    pxr.vec3f_array(&extent::outward(bounds))
}

fn bounds(means: &[[f32; 3]], orientations: &[[f32; 4]], scales: &[[f32; 3]]) -> Bounds {
    extent::ellipsoid_bounds(&RigidTransform::IDENTITY, means, orientations, scales)
}

pub(super) fn author(
    scene: &Scene<'_, '_>,
    layer: &Layer<'_, '_>,
    place: &str,
    name: &str,
    selection: &Selection<'_>,
) -> PyResult<()> {
    let (pxr, splats) = (scene.pxr, selection.all());
    let prim = layer.define(&child(place, &format!("{name}_{}", tokens::SPLATS)), tokens::GAUSSIAN_SPLAT)?;
    let means = selection.of(&splats.means);
    let turns = selection.of(&splats.orientations);
    let sizes = selection.of(&splats.scales);
    let positions = prim.set("positions", "Point3fArray", VARYING, pxr.vec3f_array(&means)?)?;
    let orientations = prim.set("orientations", "QuatfArray", VARYING, pxr.quatf_array(&turns)?)?;
    let scales = prim.set("scales", "Float3Array", VARYING, pxr.vec3f_array(&sizes)?)?;
    let opacities = pxr.float_array(&selection.of(&splats.opacities))?;
    let opacities = prim.set("opacities", "FloatArray", VARYING, opacities)?;
    for sample in &selection.appearance().opacities {
        opacities.sample(sample.time_code, pxr.float_array(&selection.of(&sample.values))?)?;
    }
    let whole = bounds(&means, &turns, &sizes);
    let extents = prim.set("extent", "Float3Array", VARYING, box_array(pxr, &whole)?)?;
    for sample in selection.samples() {
        let (time, means, turns) =
            (sample.time_code, selection.of(&sample.means), selection.of(&sample.orientations));
        positions.sample(time, pxr.vec3f_array(&means)?)?;
        orientations.sample(time, pxr.quatf_array(&turns)?)?;
        let extent = match &sample.scales {
            Some(values) => {
                let values = selection.of(values);
                scales.sample(time, pxr.vec3f_array(&values)?)?;
                bounds(&means, &turns, &values)
            }
            None if selection.is_whole() => sample.extent,
            None => bounds(&means, &turns, &sizes),
        };
        extents.sample(time, box_array(pxr, &extent)?)?;
    }
    let degree = i32::from(selection.degree());
    prim.set(tokens::SH_DEGREE, "Int", UNIFORM, degree)?;
    let coefficients = selection.coefficients(&splats.sh_coefficients);
    let sh = pxr.vec3f_array_flat(&coefficients)?;
    let sh = prim.set(tokens::SH_COEFFICIENTS, "Float3Array", VARYING, sh)?;
    sh.info("elementSize", (degree + 1) * (degree + 1))?;
    sh.info("interpolation", tokens::VERTEX)?;
    let colors = primvars::base_colors(&coefficients, selection.degree());
    let changes = &selection.appearance().colors;
    if changes.is_empty() {
        display_color(scene, &prim, &colors)?;
    } else {
        let display = prim.set(tokens::DISPLAY_COLOR, "Color3fArray", VARYING, pxr.vec3f_array(&colors)?)?;
        display.info("interpolation", tokens::VERTEX)?;
        let all = primvars::indices_or_all(None, colors.len(), scene.has_windows());
        set_indices(pxr, &prim, tokens::DISPLAY_COLOR, all)?;
        for sample in changes {
            let coefficients = selection.coefficients(&sample.values);
            sh.sample(sample.time_code, pxr.vec3f_array_flat(&coefficients)?)?;
            let colors = primvars::base_colors(&coefficients, selection.degree());
            display.sample(sample.time_code, pxr.vec3f_array(&colors)?)?;
        }
    }
    prim.set_custom(tokens::COLOR_CHECKSUM, "String", primvars::checksum(&colors))?;
    prim.set("projectionModeHint", "Token", UNIFORM, tokens::PERSPECTIVE)?;
    prim.set("sortingModeHint", "Token", UNIFORM, sorting(scene.graph.sort_metric))?;
    for (name, values) in [
        (tokens::PRIMVAR_OCCUPANCY, &splats.occupancies),
        (tokens::PRIMVAR_IDENTITY, &splats.identity_probabilities),
    ] {
        let values = selection.of(values);
        let (unique, indices) = primvars::without_repetitions(values.as_chunks::<1>().0);
        let attribute = prim.set(name, "FloatArray", VARYING, pxr.float_array(unique.as_flattened())?)?;
        attribute.info("interpolation", tokens::VERTEX)?;
        let indices = primvars::indices_or_all(indices, values.len(), scene.has_windows());
        set_indices(pxr, &prim, name, indices)?;
    }
    if !splats.identities.is_empty() {
        instance_shares(scene, &prim, &selection.of(&splats.identities))?;
    }
    let rows = primvars::as_ints(&selection.of(&splats.rows));
    ints(pxr, &prim, tokens::PRIMVAR_ROW, &rows)
}

/// The instances that every splat may belong to, as many places per splat as any of them needs.
fn instance_shares(
    scene: &Scene<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    identities: &[IdentityShares],
) -> PyResult<()> {
    let pxr = scene.pxr;
    let used = |shares: &IdentityShares| shares.iter().filter(|entry| entry.id != 0).count();
    let places = match scene.has_windows() {
        true => SHARES_PER_SPLAT,
        false => identities.iter().map(used).max().unwrap_or(0).max(1),
    };
    let entries = || identities.iter().flat_map(|shares| &shares[..places]);
    let ids: Vec<i32> = entries().map(|entry| i32::from(entry.id)).collect();
    let mut shares: Vec<f32> = entries().map(|entry| entry.share).collect();
    if places == 1 {
        // Validators ask for indices of whatever has one value per splat, and know no other case.
        let (unique, indices) = primvars::without_repetitions(shares.as_chunks::<1>().0);
        shares = unique.into_flattened();
        set_indices(pxr, prim, tokens::PRIMVAR_INSTANCE_SHARES, indices)?;
    }
    let ids = prim.set(tokens::PRIMVAR_INSTANCE_IDS, "IntArray", VARYING, pxr.int_array(&ids)?)?;
    let shares =
        prim.set(tokens::PRIMVAR_INSTANCE_SHARES, "FloatArray", VARYING, pxr.float_array(&shares)?)?;
    for attribute in [ids, shares] {
        attribute.info("elementSize", places as i32)?;
        attribute.info("interpolation", tokens::VERTEX)?;
    }
    Ok(())
}

/// A primvar of integers, one per point, without repetitions among them.
pub(super) fn ints(pxr: &Pxr<'_>, prim: &Prim<'_, '_, '_>, name: &str, values: &[i32]) -> PyResult<()> {
    let attribute = prim.set(name, "IntArray", VARYING, pxr.int_array(values)?)?;
    attribute.info("interpolation", tokens::VERTEX)
}

/// Colours for viewers that do not read spherical harmonics.
pub(super) fn display_color(
    scene: &Scene<'_, '_>,
    prim: &Prim<'_, '_, '_>,
    colors: &[[f32; 3]],
) -> PyResult<()> {
    let pxr = scene.pxr;
    let (unique, indices) = primvars::without_repetitions(colors);
    let indices = primvars::indices_or_all(indices, colors.len(), scene.has_windows());
    let attribute = prim.set(tokens::DISPLAY_COLOR, "Color3fArray", VARYING, pxr.vec3f_array(&unique)?)?;
    attribute.info("interpolation", tokens::VERTEX)?;
    set_indices(pxr, prim, tokens::DISPLAY_COLOR, indices)
}

fn set_indices(
    pxr: &Pxr<'_>,
    prim: &Prim<'_, '_, '_>,
    name: &str,
    indices: Option<Vec<i32>>,
) -> PyResult<()> {
    if let Some(indices) = indices {
        prim.set(&format!("{name}:indices"), "IntArray", VARYING, pxr.int_array(&indices)?)?;
    }
    Ok(())
}
