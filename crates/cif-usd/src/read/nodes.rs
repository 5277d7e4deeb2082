//! An object from a prim and the splat prims under it.

use cif_scene::assemble::{Piece, Placement, Prim, PrimName, Shape, Track};
use cif_scene::{ConvexHull, MotionModel, MotionReport, PointProxy, Splats};
use glam::{DAffine3, DVec3};
use pyo3::prelude::*;

use super::joints::joints;
use super::labels::{self, Recorded};
use super::owner::Owner;
use super::reading::Reading;
use super::splats::SplatPrim;
use super::values::{attribute, text, value};
use crate::{UsdError, primvars, tokens};

/// Prim that the assembler makes a node of.
pub(super) fn read<'py>(reading: &Reading<'_, 'py>, owner: &Owner<'py>) -> Result<Prim, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let collapses = |path: &str| {
        reading.prim_error(
            path,
            "its transform flattens everything or is not finite".into(),
            "give every axis a scale other than 0",
        )
    };
    let recorded = &owner.recorded;
    // One splat prim that moves under its owner moves the node; parts are several.
    let frame_of = |prim: &Bound<'py, PyAny>, path: &str| {
        reading.frames.node(prim).map_err(python)?.ok_or_else(|| collapses(path))
    };
    let place = |prim: &SplatPrim<'py>, carrier: &Bound<'py, PyAny>, track: &Track, exact: bool| {
        let placement = reading.frames.placement(&prim.prim, carrier, track, exact).map_err(python)?;
        placement.ok_or_else(|| collapses(&prim.path))
    };
    let (mut track, exact) = frame_of(&owner.prim, &owner.path)?;
    let mut placements = Vec::with_capacity(owner.splats.len());
    for prim in &owner.splats {
        placements.push(place(prim, &owner.prim, &track, exact)?);
    }
    if let ([prim], [Placement::Rigid { track: within, .. }]) = (&owner.splats[..], &placements[..])
        && !within.is_identity()
    {
        let (own, exact) = frame_of(&prim.prim, &prim.path)?;
        placements = vec![place(prim, &prim.prim, &own, exact)?];
        track = own;
    }
    let [mut shape_codes, opacity_codes, color_codes] = codes(owner).map_err(python)?;
    if !shape_codes.is_empty()
        || placements.iter().any(|placement| matches!(placement, Placement::Sampled(_)))
    {
        shape_codes.extend(placements.iter().flat_map(Placement::codes));
        sort(&mut shape_codes);
    }
    let in_parts = shape_codes.is_empty() && is_parts(recorded, &placements);
    let mut prim = Prim {
        shape_codes,
        opacity_codes,
        color_codes,
        in_parts,
        ..Prim::still(owner.path.clone(), String::new(), Splats::default())
    };
    prim.scales_change = placements.iter().any(|placement| matches!(placement, Placement::Sampled(_)));
    for splats in &owner.splats {
        prim.scales_change |= splats.samples_scales().map_err(python)?;
    }
    prim.pieces = owner
        .splats
        .iter()
        .zip(placements)
        .map(|(splats, placement)| piece(reading, owner, &prim, splats, placement))
        .collect::<Result<_, _>>()?;
    if in_parts {
        let joints = joints(reading.pxr, owner).map_err(python)?;
        prim.pieces.iter_mut().zip(joints).for_each(|(piece, joint)| piece.joint = joint);
    }
    let splats = prim.pieces.iter().map(|piece| piece.splats.len()).sum();
    let original = labels::is_original(reading.pxr, &owner.prim).map_err(python)?;
    let (label, category) = labels::names(reading.pxr, &owner.prim, recorded).map_err(python)?;
    Ok(Prim {
        identity: owner.identity(original),
        name: PrimName::Given(labels::node_name(&owner.prim).map_err(python)?),
        label,
        category,
        taxonomies: labels::others(reading.pxr, &owner.prim).map_err(python)?,
        embedding: labels::embedding(reading.pxr, &owner.prim).map_err(python)?,
        // The transform of an object without motion is its pivot.
        pivot: recorded.pivot.filter(|_| !track.samples.is_empty()),
        track,
        proxy: proxy(reading, owner, in_parts, splats)?,
        colliders: colliders(reading, owner, in_parts)?,
        visibility: labels::visibility(reading.pxr, &owner.prim, reading.start).map_err(python)?,
        source_frames: Some(recorded.source_frames.unwrap_or(reading.source_frames)),
        mean_occupancy: recorded.mean_occupancy,
        report: recorded
            .report
            .as_deref()
            .and_then(|text| serde_json::from_str::<MotionReport>(text).ok())
            .map(|report| MotionReport { rotation: recorded.rotation, ..report }),
        ..prim
    })
}

fn sort(codes: &mut Vec<f64>) {
    codes.sort_by(f64::total_cmp);
    codes.dedup();
}

/// Time codes at which shapes, opacities and colours of any of the splat prims are sampled.
fn codes(owner: &Owner<'_>) -> PyResult<[Vec<f64>; 3]> {
    let mut codes = [Vec::new(), Vec::new(), Vec::new()];
    for prim in &owner.splats {
        codes[0].extend(prim.times()?);
        codes[1].extend(prim.opacity_times()?);
        codes[2].extend(prim.color_times()?);
    }
    codes.iter_mut().for_each(sort);
    Ok(codes)
}

/// True when several prims move, or were written, as parts.
fn is_parts(recorded: &Recorded, placements: &[Placement]) -> bool {
    let moves = |placement: &Placement| match placement {
        Placement::Rigid { track, .. } => !track.samples.is_empty(),
        Placement::Sampled(_) => false,
    };
    placements.len() > 1 && (recorded.model == Some(MotionModel::Parts) || placements.iter().any(moves))
}

/// Splats of one prim, at all times that its owner is sampled at.
fn piece<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    sampled: &Prim,
    prim: &SplatPrim<'py>,
    placement: Placement,
) -> Result<Piece, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let origin = prim.origin(reading)?;
    let placement = from_origin(placement, origin);
    let mut splats = prim.splats(reading, origin)?;
    if owner.recorded.background && !prim.has_identities().map_err(python)? {
        splats.identity_probabilities.fill(0.0);
    }
    let (count, degree) = (splats.len(), splats.sh_degree);
    let opacities = sampled.opacity_codes.iter().map(|&code| prim.opacities_at(reading, code, count));
    let opacities = opacities.collect::<Result<_, _>>()?;
    let mut colors = Vec::with_capacity(sampled.color_codes.len());
    for &code in &sampled.color_codes {
        let (own, coefficients) = prim.harmonics_at(reading, code, count)?;
        if own != degree {
            let problem = format!("coefficients of degree {own} at time code {code}");
            return Err(reading.prim_error(&prim.path, problem, "keep one degree over time"));
        }
        colors.push(coefficients);
    }
    let mut shapes: Vec<Shape> = Vec::with_capacity(sampled.shape_codes.len());
    for &code in &sampled.shape_codes {
        let shape = prim.shape(reading, Some(code), origin)?;
        if shape.means.len() != count {
            return Err(reading.prim_error(
                &prim.path,
                format!("{} splats at time code {code}, {count} at first", shape.means.len()),
                "keep the number of splats; fade with opacity 0 what comes or goes",
            ));
        }
        shapes.push(shape);
    }
    let (name, pivot) = match sampled.in_parts {
        true => {
            let carrier = prim.carrier(&owner.prim).map_err(python)?;
            (labels::node_name(&carrier).map_err(python)?, part_pivot(&carrier).map_err(python)?)
        }
        false => (String::new(), None),
    };
    Ok(Piece { name, splats, placement, pivot, joint: None, shapes, opacities, colors })
}

/// Where a piece is whose splats are given from a place in it on.
fn from_origin(placement: Placement, origin: DVec3) -> Placement {
    match placement {
        Placement::Rigid { mut track, baked } => {
            let place = baked.map_or(origin, |map| map.transform_vector3(origin));
            for pose in track.samples.iter_mut().chain([&mut track.rest]) {
                pose.translation += pose.rotation * place;
            }
            Placement::Rigid { track, baked }
        }
        Placement::Sampled(mut maps) => {
            maps.iter_mut().for_each(|(_, map)| *map *= DAffine3::from_translation(origin));
            Placement::Sampled(maps)
        }
    }
}

/// Origin of a part's frame at the reference time, where it is recorded and the part moves.
fn part_pivot(prim: &Bound<'_, PyAny>) -> PyResult<Option<DVec3>> {
    let Some(attribute) = attribute(prim, tokens::PART_PIVOT)? else { return Ok(None) };
    super::values::vec3(&attribute.call_method0("Get")?).map(Some)
}

/// A prim, its name, and the part that it moves with.
type Child<'py> = (Bound<'py, PyAny>, String, Option<usize>);

/// Prims of a type under an owner and its parts whose name starts so, with the index of their part.
fn children<'py>(owner: &Owner<'py>, in_parts: bool, prefix: &str) -> PyResult<Vec<Child<'py>>> {
    let mut places = vec![(owner.prim.clone(), None)];
    if in_parts {
        for (index, prim) in owner.splats.iter().enumerate() {
            places.push((prim.carrier(&owner.prim)?, Some(index)));
        }
    }
    let mut found = Vec::new();
    for (place, part) in places {
        for child in place.call_method0("GetChildren")?.try_iter()? {
            let child = child?;
            let name = text(&child.call_method0("GetName")?)?;
            if name.starts_with(prefix) {
                found.push((child, name, part));
            }
        }
    }
    Ok(found)
}

/// Our point proxies; none where a coarser level of detail is selected, whose splats they do not sit on.
fn proxy<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    in_parts: bool,
    splats: usize,
) -> Result<Option<PointProxy>, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let selected = owner
        .prim
        .call_method0("GetVariantSets")
        .and_then(|sets| sets.call_method1("GetVariantSelection", (tokens::variants::LOD,)))
        .and_then(|selection| text(&selection))
        .map_err(python)?;
    if !(selected.is_empty() || selected == tokens::variants::FULL) {
        return Ok(None);
    }
    let mut all: Option<PointProxy> = None;
    for (prim, _, _) in children(owner, in_parts, tokens::PROXY).map_err(python)? {
        // Below the instancer; earlier stages have the points in its place.
        let inside = prim.call_method1("GetPrimAtPath", (tokens::PROXY_POINTS,)).map_err(python)?;
        let prim = if inside.is_truthy().map_err(python)? { inside } else { prim };
        let prim = SplatPrim { path: super::values::path(&prim).map_err(python)?, prim };
        let Some((indices, widths, colors)) = prim.proxy(reading)? else { continue };
        let consistent = indices.len() == widths.len()
            && indices.len() == colors.len()
            && indices.iter().all(|&index| (index as usize) < splats);
        if consistent {
            let proxy = all.get_or_insert_default();
            proxy.indices.extend(indices);
            proxy.widths.extend(widths);
            proxy.colors.extend(colors);
        }
    }
    Ok(all)
}

/// Our convex hulls in the order in which they were written.
fn colliders<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    in_parts: bool,
) -> Result<Vec<ConvexHull>, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let mut found: Vec<(u64, ConvexHull)> = Vec::new();
    for (prim, name, part) in children(owner, in_parts, tokens::COLLIDER).map_err(python)? {
        let path = super::values::path(&prim).map_err(python)?;
        let at = reading.pxr.earliest().map_err(python)?;
        let get = |name: &str| value(&prim, name, &at).map_err(python);
        let (Some(points), Some(corners)) = (get("points")?, get("faceVertexIndices")?) else { continue };
        let prim = SplatPrim { prim: prim.clone(), path };
        let points = prim.array(reading, "points", reading.arrays.floats::<3>(&points))?;
        let corners = prim.array(reading, "faceVertexIndices", reading.arrays.ints(&corners))?;
        let corners = primvars::from_ints(&corners);
        let (triangles, rest) = corners.as_chunks::<3>();
        if !rest.is_empty() || corners.iter().any(|&corner| corner as usize >= points.len()) {
            let problem = "its faces are not triangles of its points".to_owned();
            return Err(reading.prim_error(&prim.path, problem, "triangulate the hull, or delete it"));
        }
        let number = name.strip_prefix(tokens::COLLIDER).unwrap_or_default().trim_start_matches('_');
        found.push((number.parse().unwrap_or(0), ConvexHull { points, triangles: triangles.to_vec(), part }));
    }
    found.sort_by_key(|(number, _)| *number);
    Ok(found.into_iter().map(|(_, hull)| hull).collect())
}
