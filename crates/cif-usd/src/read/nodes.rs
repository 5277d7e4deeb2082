//! One node from a prim and the splat prims under it.

use cif_geometry::{Bounds, RigidTransform};
use cif_scene::{
    Appearance, AppearanceSample, ConvexHull, DenseMotion, DenseSample, IdentityShares, Motion, MotionModel,
    MotionReport, Node, NodeKind, Part, PartsMotion, PointProxy, PoseSample, Splats, extent, naming,
};
use glam::{DAffine3, DQuat, DVec3};
use pyo3::prelude::*;

use super::bake::Bake;
use super::frames::{Placement, Track};
use super::labels::{self, Recorded};
use super::splats::{Shape, SplatPrim};
use super::stage::Reading;
use super::values::{attribute, text, value};
use crate::{UsdError, primvars, tokens};

/// A prim that becomes a node.
pub(super) struct Owner<'py> {
    pub(super) prim: Bound<'py, PyAny>,
    pub(super) path: String,
    /// What our schema says.
    pub(super) recorded: Recorded,
    pub(super) splats: Vec<SplatPrim<'py>>,
}

/// Splats of one prim and how they lie in the node.
struct Piece {
    splats: Splats,
    placement: Placement,
}

/// Box of the 3-sigma ellipsoids in their own frame.
fn bounds(means: &[[f32; 3]], orientations: &[[f32; 4]], scales: &[[f32; 3]]) -> Bounds {
    extent::ellipsoid_bounds(&RigidTransform::IDENTITY, means, orientations, scales)
}

fn splat_bounds(splats: &Splats) -> Bounds {
    bounds(&splats.means, &splats.orientations, &splats.scales)
}

/// The node.
pub(super) fn read<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    kind: NodeKind,
    taken: &mut naming::Names,
) -> Result<Node, UsdError> {
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
    let mut times: Vec<f64> = Vec::new();
    for prim in &owner.splats {
        times.extend(prim.times().map_err(python)?);
    }
    let deforms =
        !times.is_empty() || placements.iter().any(|placement| matches!(placement, Placement::Sampled(_)));
    let mut pieces = Vec::with_capacity(placements.len());
    for (prim, placement) in owner.splats.iter().zip(placements) {
        pieces.push(Piece { splats: prim.splats(reading)?, placement });
    }
    if kind == NodeKind::Background {
        for (piece, prim) in pieces.iter_mut().zip(&owner.splats) {
            if !prim.has_identities().map_err(python)? {
                piece.splats.identity_probabilities.fill(0.0);
            }
        }
    }
    let parts = !deforms && is_parts(recorded, &pieces);
    let appearance = appearance(reading, owner, &pieces, parts)?;
    let (motion, splats) = if deforms {
        for piece in &pieces {
            times.extend(piece.placement.times());
        }
        times.sort_by(f64::total_cmp);
        times.dedup();
        dense(reading, owner, &pieces, &times, &track)?
    } else if parts {
        in_parts(owner, pieces, &track).map_err(python)?
    } else {
        let splats = merge(pieces.into_iter().map(|piece| {
            let map = piece.placement.at(0.0);
            baked(piece.splats, map)
        }));
        let turned = track.rest.rotation != DQuat::IDENTITY;
        let samples =
            if track.samples.is_empty() && turned { vec![track.rest] } else { track.samples.clone() };
        let kept = recorded.model == Some(MotionModel::Rigid) && !samples.is_empty();
        let motion = if samples.is_empty() && !kept { Motion::Static } else { Motion::Rigid(samples) };
        (motion, splats)
    };
    let stands = matches!(motion, Motion::Static) || track.samples.is_empty();
    let pivot =
        if stands { track.rest.translation } else { recorded.pivot.unwrap_or(track.rest.translation) };
    let (label, category) = labels::names(reading.pxr, &owner.prim, recorded).map_err(python)?;
    let mut node = Node {
        kind,
        name: labels::node_name(&owner.prim, taken).map_err(python)?,
        label,
        category,
        pivot,
        proxy: proxy(reading, owner, &motion, splats.len())?,
        colliders: colliders(reading, owner, &motion)?,
        visibility: labels::visibility(reading.pxr, &owner.prim, reading.start).map_err(python)?,
        extent: Bounds::EMPTY,
        source_frames: recorded.source_frames.unwrap_or(reading.source_frames),
        mean_occupancy: recorded.mean_occupancy.unwrap_or_else(|| mean_occupancy(&splats)),
        report: report(recorded, &motion, &splats),
        motion,
        splats,
        appearance,
    };
    node.extent = node_extent(&node);
    Ok(node)
}

/// Box in the local frame at the first time.
fn node_extent(node: &Node) -> Bounds {
    let Motion::Parts(motion) = &node.motion else { return splat_bounds(&node.splats) };
    let boxes = motion.parts.iter().map(|part| {
        let rest = part.track.first().map_or(
            RigidTransform { rotation: glam::DMat3::IDENTITY, translation: part.pivot },
            PoseSample::transform,
        );
        let (splats, range) = (&node.splats, part.splats.clone());
        extent::ellipsoid_bounds(
            &rest,
            &splats.means[range.clone()],
            &splats.orientations[range.clone()],
            &splats.scales[range],
        )
    });
    boxes.fold(Bounds::EMPTY, |all, bounds| all.union(bounds))
}

/// Whether several prims move, or were written, as parts.
fn is_parts(recorded: &Recorded, pieces: &[Piece]) -> bool {
    let moves = |piece: &Piece| match &piece.placement {
        Placement::Rigid { track, .. } => !track.samples.is_empty(),
        Placement::Sampled(_) => false,
    };
    pieces.len() > 1 && (recorded.model == Some(MotionModel::Parts) || pieces.iter().any(moves))
}

/// Splats moved by an affine map; those that do not move stay exact.
fn baked(mut splats: Splats, map: DAffine3) -> Splats {
    if map != DAffine3::IDENTITY {
        let bake = Bake::new(map);
        bake.means(&mut splats.means);
        bake.shapes(&mut splats.orientations, &mut splats.scales);
        bake.harmonics(&mut splats.sh_coefficients, splats.sh_degree);
    }
    splats
}

/// Several sets of splats as one; coefficients are padded to the highest degree.
fn merge(sets: impl Iterator<Item = Splats>) -> Splats {
    let mut sets: Vec<Splats> = sets.collect();
    if sets.len() == 1 {
        return sets.swap_remove(0);
    }
    let floats = |degree| 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    let degree = sets.iter().map(|set| set.sh_degree).max().unwrap_or(0);
    let mut all = Splats { sh_degree: degree, ..Splats::default() };
    let tells = sets.iter().any(|set| !set.identities.is_empty());
    for mut set in sets {
        if tells {
            set.identities.resize(set.means.len(), IdentityShares::default());
            all.identities.append(&mut set.identities);
        }
        for sh in set.sh_coefficients.chunks_exact(floats(set.sh_degree)) {
            all.sh_coefficients.extend_from_slice(sh);
            all.sh_coefficients.resize(all.sh_coefficients.len() + floats(degree) - sh.len(), 0.0);
        }
        all.means.extend(set.means);
        all.orientations.extend(set.orientations);
        all.scales.extend(set.scales);
        all.opacities.extend(set.opacities);
        all.occupancies.extend(set.occupancies);
        all.identity_probabilities.extend(set.identity_probabilities);
        all.rows.extend(set.rows);
    }
    all
}

/// Opacities and colours of all pieces over time, these in the frame of the node or of its parts.
fn appearance<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    pieces: &[Piece],
    parts: bool,
) -> Result<Appearance, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let mut times = [Vec::new(), Vec::new()];
    for prim in &owner.splats {
        times[0].extend(prim.opacity_times().map_err(python)?);
        times[1].extend(prim.color_times().map_err(python)?);
    }
    let [opacity_times, color_times] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times.dedup();
        times
    });
    let mut appearance = Appearance::default();
    for time_code in opacity_times {
        let mut values = Vec::new();
        for (prim, piece) in owner.splats.iter().zip(pieces) {
            values.extend(prim.opacities_at(reading, time_code, piece.splats.len())?);
        }
        appearance.opacities.push(AppearanceSample { time_code, values });
    }
    let degree = pieces.iter().map(|piece| piece.splats.sh_degree).max().unwrap_or(0);
    let floats = |degree| 3 * cif_geometry::spherical_harmonics::coefficient_count(degree);
    for time_code in color_times {
        let mut values = Vec::new();
        for (prim, piece) in owner.splats.iter().zip(pieces) {
            let (own, mut coefficients) = prim.harmonics_at(reading, time_code, piece.splats.len())?;
            if own != piece.splats.sh_degree {
                let problem = format!("coefficients of degree {own} at time code {time_code}");
                return Err(reading.prim_error(&prim.path, problem, "keep one degree over time"));
            }
            let map = match &piece.placement {
                Placement::Rigid { baked, .. } if parts => baked.unwrap_or(DAffine3::IDENTITY),
                placement => placement.at(time_code),
            };
            if map != DAffine3::IDENTITY {
                Bake::new(map).harmonics(&mut coefficients, own);
            }
            for sh in coefficients.chunks_exact(floats(own)) {
                values.extend_from_slice(sh);
                values.resize(values.len() + floats(degree) - sh.len(), 0.0);
            }
        }
        appearance.colors.push(AppearanceSample { time_code, values });
    }
    Ok(appearance)
}

/// Every piece a part with its own track.
fn in_parts(owner: &Owner<'_>, pieces: Vec<Piece>, track: &Track) -> PyResult<(Motion, Splats)> {
    let (mut parts, mut sets, mut start) = (Vec::<Part>::new(), Vec::new(), 0);
    let mut names = naming::Names::default();
    for (piece, prim) in pieces.into_iter().zip(&owner.splats) {
        let Placement::Rigid { track, baked: map } = piece.placement else { continue };
        let set = baked(piece.splats, map.unwrap_or(DAffine3::IDENTITY));
        let carrier = prim.carrier(&owner.prim)?;
        let turned = track.rest.rotation != DQuat::IDENTITY;
        let samples = if track.samples.is_empty() && turned { vec![track.rest] } else { track.samples };
        parts.push(Part {
            name: labels::node_name(&carrier, &mut names)?,
            splats: start..start + set.len(),
            pivot: part_pivot(&carrier)?.unwrap_or(track.rest.translation),
            track: samples,
            extent: splat_bounds(&set),
        });
        start += set.len();
        sets.push(set);
    }
    let turned = track.rest.rotation != DQuat::IDENTITY;
    let samples = if track.samples.is_empty() && turned { vec![track.rest] } else { track.samples.clone() };
    Ok((Motion::Parts(PartsMotion { track: samples, parts }), merge(sets.into_iter())))
}

/// Origin of a part's frame at the reference time, where it is recorded and the part moves.
fn part_pivot(prim: &Bound<'_, PyAny>) -> PyResult<Option<DVec3>> {
    let Some(attribute) = attribute(prim, tokens::PART_PIVOT)? else { return Ok(None) };
    super::values::vec3(&attribute.call_method0("Get")?).map(Some)
}

/// Samples of everything that deforms.
fn dense<'py>(
    reading: &Reading<'_, 'py>,
    owner: &Owner<'py>,
    pieces: &[Piece],
    times: &[f64],
    track: &Track,
) -> Result<(Motion, Splats), UsdError> {
    let mut scaled = false;
    for (prim, piece) in owner.splats.iter().zip(pieces) {
        scaled |= prim.samples_scales().map_err(|error| reading.python(&error))?;
        scaled |= matches!(piece.placement, Placement::Sampled(_));
    }
    let mut samples: Vec<DenseSample> = Vec::with_capacity(times.len());
    for &time in times {
        let mut whole = Shape { means: Vec::new(), orientations: Vec::new(), scales: Vec::new() };
        for (prim, piece) in owner.splats.iter().zip(pieces) {
            let mut shape = prim.shape(reading, Some(time))?;
            if shape.means.len() != piece.splats.len() {
                return Err(reading.prim_error(
                    &prim.path,
                    format!(
                        "{} splats at time code {time}, {} at first",
                        shape.means.len(),
                        piece.splats.len()
                    ),
                    "keep the number of splats; fade with opacity 0 what comes or goes",
                ));
            }
            let map = piece.placement.at(time);
            if map != DAffine3::IDENTITY {
                let bake = Bake::new(map);
                bake.means(&mut shape.means);
                bake.shapes(&mut shape.orientations, &mut shape.scales);
            }
            whole.means.extend(shape.means);
            whole.orientations.extend(shape.orientations);
            whole.scales.extend(shape.scales);
        }
        if let Some(before) = samples.last() {
            for (q, before) in whole.orientations.iter_mut().zip(&before.orientations) {
                if q.iter().zip(before).map(|(a, b)| a * b).sum::<f32>() < 0.0 {
                    *q = q.map(|component| -component);
                }
            }
        }
        let extent = bounds(&whole.means, &whole.orientations, &whole.scales);
        samples.push(DenseSample {
            time_code: time,
            means: whole.means,
            orientations: whole.orientations,
            scales: scaled.then_some(whole.scales),
            extent,
        });
    }
    let first = times.first().copied().unwrap_or(0.0);
    let splats = merge(pieces.iter().map(|piece| baked(piece.splats.clone(), piece.placement.at(first))));
    let turned = track.rest.rotation != DQuat::IDENTITY;
    let poses = if track.samples.is_empty() && turned { vec![track.rest] } else { track.samples.clone() };
    Ok((Motion::Dense(DenseMotion { track: poses, samples }), splats))
}

fn mean_occupancy(splats: &Splats) -> f32 {
    let (sum, total) = splats
        .occupancies
        .iter()
        .zip(&splats.opacities)
        .fold((0.0, 0.0), |(sum, total), (pi, o)| (sum + f64::from(pi * o), total + f64::from(*o)));
    if total > 0.0 { (sum / total) as f32 } else { 0.0 }
}

/// The motion report of the export where it still holds, else what can be told from the stage.
fn report(recorded: &Recorded, motion: &Motion, splats: &Splats) -> MotionReport {
    let (model, samples) = match motion {
        Motion::Static => (MotionModel::Static, 0),
        Motion::Rigid(track) => (MotionModel::Rigid, track.len()),
        Motion::Parts(parts) => {
            let samples = parts.track.len() + parts.parts.iter().map(|part| part.track.len()).sum::<usize>();
            (MotionModel::Parts, samples)
        }
        Motion::Dense(dense) => (MotionModel::Dense, dense.samples.len()),
    };
    let before = recorded.report.as_deref().and_then(|text| serde_json::from_str::<MotionReport>(text).ok());
    if let Some(before) = before.filter(|before| before.model == model) {
        return before;
    }
    let parts = if let Motion::Parts(parts) = motion { parts.parts.len() } else { 0 };
    MotionReport { model, parts, ..MotionReport::unfitted(splats, samples) }
}

/// A prim, its name, and the part that it moves with.
type Child<'py> = (Bound<'py, PyAny>, String, Option<usize>);

/// Prims of a type under an owner and its parts whose name starts so, with the index of their part.
fn children<'py>(owner: &Owner<'py>, motion: &Motion, prefix: &str) -> PyResult<Vec<Child<'py>>> {
    let mut places = vec![(owner.prim.clone(), None)];
    if let Motion::Parts(_) = motion {
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
    motion: &Motion,
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
    for (prim, _, _) in children(owner, motion, tokens::PROXY).map_err(python)? {
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
    motion: &Motion,
) -> Result<Vec<ConvexHull>, UsdError> {
    let python = |error: PyErr| reading.python(&error);
    let mut found: Vec<(u64, ConvexHull)> = Vec::new();
    for (prim, name, part) in children(owner, motion, tokens::COLLIDER).map_err(python)? {
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
