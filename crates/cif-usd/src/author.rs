//! What a stage is made of.

use std::collections::BTreeMap;

use cif_geometry::Bounds;
use cif_scene::{DenseSample, Motion, Node, NodeKind, PointProxy, PoseSample, SceneGraph, extent};
use pyo3::prelude::*;

use crate::pxr::{Pxr, set, set_default};
use crate::{camera_prims, conventions, tokens};

/// Fills an empty stage.
pub(crate) fn author(pxr: &Pxr<'_>, stage: &Bound<'_, PyAny>, graph: &SceneGraph) -> PyResult<()> {
    metadata(pxr, stage, graph)?;
    let world = pxr.define(&pxr.usd_geom, "Xform", stage, tokens::WORLD)?;
    let world = world.call_method0("GetPrim")?;
    stage.call_method1("SetDefaultPrim", (&world,))?;
    set_kind(pxr, &world, tokens::KIND_ASSEMBLY)?;
    for node in &graph.nodes {
        author_node(pxr, stage, graph, node)?;
    }
    if !graph.cameras.is_empty() {
        pxr.define(&pxr.usd_geom, "Scope", stage, tokens::CAMERAS)?;
        for track in &graph.cameras {
            camera_prims::author(pxr, stage, track, graph.meters_per_unit)?;
        }
    }
    Ok(())
}

fn metadata(pxr: &Pxr<'_>, stage: &Bound<'_, PyAny>, graph: &SceneGraph) -> PyResult<()> {
    pxr.usd_geom.call_method1("SetStageUpAxis", (stage, conventions::up_axis_token(graph.up_axis)))?;
    pxr.usd_geom.call_method1("SetStageMetersPerUnit", (stage, graph.meters_per_unit))?;
    let codes = &graph.time_codes;
    stage.call_method1("SetTimeCodesPerSecond", (codes.frames_per_second,))?;
    stage.call_method1("SetFramesPerSecond", (codes.frames_per_second,))?;
    stage.call_method1("SetStartTimeCode", (codes.start(),))?;
    stage.call_method1("SetEndTimeCode", (codes.end(),))?;
    let ours = pxr.dictionary();
    ours.set_item("generator", concat!("cif ", env!("CARGO_PKG_VERSION")))?;
    ours.set_item("layout", tokens::LAYOUT_VERSION)?;
    let [red, green, blue] = graph.background_color;
    ours.set_item("backgroundColor", pxr.gf.call_method1("Vec3f", (red, green, blue))?)?;
    for (key, values) in [(tokens::SAMPLE_TIMES, &codes.times), (tokens::SAMPLE_CODES, &codes.samples)] {
        ours.set_item(key, pxr.vt.call_method1("DoubleArray", (values.clone(),))?)?;
    }
    let data = pxr.dictionary();
    data.set_item(tokens::CIF, ours)?;
    stage.call_method0("GetRootLayer")?.setattr("customLayerData", data)
}

fn set_kind(pxr: &Pxr<'_>, prim: &Bound<'_, PyAny>, kind: &str) -> PyResult<()> {
    pxr.usd.getattr("ModelAPI")?.call1((prim,))?.call_method1("SetKind", (kind,))?;
    Ok(())
}

fn author_node(pxr: &Pxr<'_>, stage: &Bound<'_, PyAny>, graph: &SceneGraph, node: &Node) -> PyResult<()> {
    let path = format!("{}/{}", tokens::WORLD, node.name);
    let xform = pxr.define(&pxr.usd_geom, "Xform", stage, &path)?;
    let prim = xform.call_method0("GetPrim")?;
    set_kind(pxr, &prim, tokens::KIND_COMPONENT)?;
    prim.call_method1("SetDisplayName", (&node.label,))?;
    // Both words find the object: the class ("mug") and what a person calls it ("red mug").
    let mut class = vec![node.category.as_str()];
    if node.label != node.category {
        class.push(&node.label);
    }
    set_labels(pxr, &prim, tokens::TAXONOMY_CLASS, &class)?;
    set_labels(pxr, &prim, tokens::TAXONOMY_INSTANCE, &[node.name.as_str()])?;
    let string = pxr.value_type("String")?;
    let label = prim.call_method1("CreateAttribute", (tokens::USER_LABEL, string, true))?;
    set(&label, &node.label, None)?;
    prim.call_method1("SetCustomDataByKey", (tokens::CIF, custom_data(pxr, node)?))?;
    let rest = PoseSample { time_code: 0.0, translation: node.pivot, rotation: glam::DQuat::IDENTITY };
    transform_ops(pxr, &xform, node.track().first().unwrap_or(&rest), node.track())?;
    splats(pxr, stage, graph, node, &path)?;
    if let Some(proxy) = &node.proxy {
        author_proxy(pxr, stage, node, proxy, &path)?;
    }
    Ok(())
}

fn set_labels(pxr: &Pxr<'_>, prim: &Bound<'_, PyAny>, taxonomy: &str, labels: &[&str]) -> PyResult<()> {
    let api = pxr.usd_semantics.getattr("LabelsAPI")?.call_method1("Apply", (prim, taxonomy))?;
    let array = pxr.vt.call_method1("TokenArray", (labels.to_vec(),))?;
    set_default(&api, "CreateLabelsAttr", array)?;
    Ok(())
}

/// What no standard schema holds about a node.
fn custom_data<'py>(pxr: &Pxr<'py>, node: &Node) -> PyResult<Bound<'py, PyAny>> {
    let data = pxr.dictionary();
    if let NodeKind::Instance { id, .. } = node.kind {
        data.set_item("id", i32::from(id))?;
    }
    data.set_item("meanOccupancy", node.mean_occupancy)?;
    let frame = |frame: usize| i32::try_from(frame).unwrap_or(i32::MAX);
    let (first, last) = node.source_frames;
    data.set_item("sourceFrames", pxr.gf.call_method1("Vec2i", (frame(first), frame(last)))?)?;
    let motion = pxr.dictionary();
    let report = &node.report;
    motion.set_item("model", node.model().to_string())?;
    motion.set_item("tolerance", report.tolerance)?;
    motion.set_item("residualRms", report.residual.rms)?;
    motion.set_item("residualDecisive", report.residual.decisive)?;
    motion.set_item("residualMax", report.residual.max)?;
    motion.set_item("outlierShare", report.residual.outlier_share)?;
    data.set_item("motion", motion)?;
    Ok(data.into_any())
}

/// `translate` and `orient`, default values always, samples where there are several.
pub(crate) fn transform_ops(
    pxr: &Pxr<'_>,
    xformable: &Bound<'_, PyAny>,
    default: &PoseSample,
    track: &[PoseSample],
) -> PyResult<()> {
    let op_class = pxr.usd_geom.getattr("XformOp")?;
    let double = op_class.getattr("PrecisionDouble")?;
    let float = op_class.getattr("PrecisionFloat")?;
    let translate = xformable.call_method1("AddTranslateOp", (double,))?.call_method0("GetAttr")?;
    let orient = xformable.call_method1("AddOrientOp", (float,))?.call_method0("GetAttr")?;
    set(&translate, pxr.vec3d(default.translation)?, None)?;
    set(&orient, pxr.quatf(default.rotation)?, None)?;
    if track.len() > 1 {
        for sample in track {
            set(&translate, pxr.vec3d(sample.translation)?, Some(sample.time_code))?;
            set(&orient, pxr.quatf(sample.rotation)?, Some(sample.time_code))?;
        }
    }
    Ok(())
}

fn box_array<'py>(pxr: &Pxr<'py>, bounds: &Bounds) -> PyResult<Bound<'py, PyAny>> {
    pxr.vec3f_array(&extent::outward(bounds))
}

fn dense_samples(node: &Node) -> &[DenseSample] {
    match &node.motion {
        Motion::Dense(dense) => &dense.samples,
        Motion::Static | Motion::Rigid(_) | Motion::Parts(_) => &[],
    }
}

fn splats(
    pxr: &Pxr<'_>,
    stage: &Bound<'_, PyAny>,
    graph: &SceneGraph,
    node: &Node,
    path: &str,
) -> PyResult<()> {
    let path = format!("{path}/{}", tokens::SPLATS);
    let prim = pxr.define(&pxr.usd_vol, "ParticleField3DGaussianSplat", stage, &path)?;
    let splats = &node.splats;
    let positions = set_default(&prim, "CreatePositionsAttr", pxr.vec3f_array(&splats.means)?)?;
    let orientations = set_default(&prim, "CreateOrientationsAttr", pxr.quatf_array(&splats.orientations)?)?;
    let scales = set_default(&prim, "CreateScalesAttr", pxr.vec3f_array(&splats.scales)?)?;
    set_default(&prim, "CreateOpacitiesAttr", pxr.float_array(&splats.opacities)?)?;
    let extents = set_default(&prim, "CreateExtentAttr", box_array(pxr, &node.extent)?)?;
    for sample in dense_samples(node) {
        let time = Some(sample.time_code);
        set(&positions, pxr.vec3f_array(&sample.means)?, time)?;
        set(&orientations, pxr.quatf_array(&sample.orientations)?, time)?;
        if let Some(values) = &sample.scales {
            set(&scales, pxr.vec3f_array(values)?, time)?;
        }
        set(&extents, box_array(pxr, &sample.extent)?, time)?;
    }
    let degree = i32::from(splats.sh_degree);
    set_default(&prim, "CreateRadianceSphericalHarmonicsDegreeAttr", degree)?;
    let coefficients = set_default(
        &prim,
        "CreateRadianceSphericalHarmonicsCoefficientsAttr",
        pxr.vec3f_array_flat(&splats.sh_coefficients)?,
    )?;
    let primvar = pxr.usd_geom.getattr("Primvar")?.call1((&coefficients,))?;
    primvar.call_method1("SetElementSize", ((degree + 1) * (degree + 1),))?;
    primvar.call_method1("SetInterpolation", (tokens::VERTEX,))?;
    display_color(pxr, &prim, &splats.base_colors())?;
    set_default(&prim, "CreateProjectionModeHintAttr", tokens::PERSPECTIVE)?;
    let sorting = match graph.sort_metric {
        cif_field::SortMetric::Z => tokens::SORT_Z_DEPTH,
        cif_field::SortMetric::Distance => tokens::SORT_CAMERA_DISTANCE,
    };
    set_default(&prim, "CreateSortingModeHintAttr", sorting)?;
    let primvars = pxr.usd_geom.getattr("PrimvarsAPI")?.call1((&prim,))?;
    let float_array = pxr.value_type("FloatArray")?;
    for (name, values) in [
        (tokens::PRIMVAR_OCCUPANCY, &splats.occupancies),
        (tokens::PRIMVAR_IDENTITY, &splats.identity_probabilities),
    ] {
        let primvar = primvars.call_method1("CreatePrimvar", (name, &float_array, tokens::VERTEX))?;
        let (unique, indices) = without_repetitions(values.as_chunks::<1>().0);
        set(&primvar.call_method0("GetAttr")?, pxr.float_array(unique.as_flattened())?, None)?;
        set_indices(pxr, &primvar, indices)?;
    }
    Ok(())
}

fn display_color(pxr: &Pxr<'_>, gprim: &Bound<'_, PyAny>, colors: &[[f32; 3]]) -> PyResult<()> {
    let primvar = gprim.call_method1("CreateDisplayColorPrimvar", (tokens::VERTEX,))?;
    let (unique, indices) = without_repetitions(colors);
    set(&primvar.call_method0("GetAttr")?, pxr.vec3f_array(&unique)?, None)?;
    set_indices(pxr, &primvar, indices)
}

/// Values without repetitions in the order of first appearance, and an index per value; no indices where
/// nothing repeats. Validators ask for indices as soon as one value repeats (requirement VG.009).
fn without_repetitions<const C: usize>(values: &[[f32; C]]) -> (Vec<[f32; C]>, Option<Vec<i32>>) {
    let mut places: BTreeMap<[u32; C], i32> = BTreeMap::new();
    let mut unique: Vec<[f32; C]> = Vec::new();
    let mut indices = Vec::with_capacity(values.len());
    for value in values {
        // Adding 0 makes one zero of both.
        let value = value.map(|component| component + 0.0);
        let next = unique.len() as i32;
        let index = *places.entry(value.map(f32::to_bits)).or_insert(next);
        if index == next {
            unique.push(value);
        }
        indices.push(index);
    }
    let repeats = unique.len() < values.len();
    (unique, repeats.then_some(indices))
}

fn set_indices(pxr: &Pxr<'_>, primvar: &Bound<'_, PyAny>, indices: Option<Vec<i32>>) -> PyResult<()> {
    if let Some(indices) = indices {
        primvar.call_method1("SetIndices", (pxr.int_array(&indices)?,))?;
    }
    Ok(())
}

fn author_proxy(
    pxr: &Pxr<'_>,
    stage: &Bound<'_, PyAny>,
    node: &Node,
    proxy: &PointProxy,
    path: &str,
) -> PyResult<()> {
    let path = format!("{path}/{}", tokens::PROXY);
    let prim = pxr.define(&pxr.usd_geom, "Points", stage, &path)?;
    set_default(&prim, "CreatePurposeAttr", tokens::PURPOSE_PROXY)?;
    let pick = |means: &[[f32; 3]]| -> Vec<[f32; 3]> {
        proxy.indices.iter().map(|&index| means[index as usize]).collect()
    };
    let points = pick(&node.splats.means);
    let extents = set_default(&prim, "CreateExtentAttr", pxr.vec3f_array(&points_box(&points, proxy))?)?;
    let attribute = set_default(&prim, "CreatePointsAttr", pxr.vec3f_array(&points)?)?;
    for sample in dense_samples(node) {
        let points = pick(&sample.means);
        set(&attribute, pxr.vec3f_array(&points)?, Some(sample.time_code))?;
        set(&extents, pxr.vec3f_array(&points_box(&points, proxy))?, Some(sample.time_code))?;
    }
    set_default(&prim, "CreateWidthsAttr", pxr.float_array(&proxy.widths)?)?;
    prim.call_method1("SetWidthsInterpolation", (tokens::VERTEX,))?;
    display_color(pxr, &prim, &proxy.colors)
}

/// Box of points with widths, in the single-precision arithmetic of usd-core itself: validators compare exactly.
fn points_box(points: &[[f32; 3]], proxy: &PointProxy) -> [[f32; 3]; 2] {
    let mut corners = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for (point, width) in points.iter().zip(&proxy.widths) {
        let half = width / 2.0;
        for axis in 0..3 {
            corners[0][axis] = corners[0][axis].min(point[axis] - half);
            corners[1][axis] = corners[1][axis].max(point[axis] + half);
        }
    }
    corners
}
