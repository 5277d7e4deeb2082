//! Files, ours and others', to scene graphs.
//!
//! | module | answers |
//! |---|---|
//! | `source` | what lies in the file and next to it, and whether it may be read |
//! | `accessor` | the numbers of an accessor |
//! | `hierarchy` | nodes and their transforms |
//! | `animation` | curves over time |
//! | `pointers` | animations of properties by pointers |
//! | `motion` | poses of chains of nodes |
//! | `splats` | splats of meshes |
//! | `objects` | which nodes are objects, and who they are |
//! | `cameras` | cameras over time |

use std::collections::BTreeMap;
use std::path::Path;

use cif_field::SortMetric;
use cif_scene::assemble::{
    AssembleError, Copies, FRAMES_PER_SECOND, Identity, Prim, Prims, Timeline, assemble,
};
use cif_scene::{Origin, SceneGraph, TimeCodes, UpAxis};
use glam::{DAffine3, DVec3};

use self::animation::Curves;
use self::hierarchy::{Hierarchy, Placed};
use self::motion::{Clock, Stage};
use self::objects::Reader;
use self::source::Source;
use crate::extras::{self, Cif, World};
use crate::{GltfError, conventions};

mod accessor;
mod animation;
mod cameras;
mod hierarchy;
mod motion;
mod objects;
mod pointers;
mod source;
mod splats;

/// Reads a `.glb` or `.gltf` with `KHR_gaussian_splatting` as a scene.
///
/// Our own files come back as the graph that was written, with the edits that were made to them: float exact,
/// without proxies and colliders. Of other files every node with splats becomes an instance that is labelled by
/// the node's name, occupied and certain of its identity; a node that is turned but does not move gets a rigid
/// track of one sample; scales that are not 1 are worked into the splats. The world then has glTF's axes and
/// units (+y up, metres), 24 time codes per second, and [`cif_scene::Origin`] is empty. Rows count the splats of
/// such a file; in files of ours, splats that were added have [`cif_scene::Splats::NO_ROW`]. Whatever could not
/// be taken over is said in [`SceneGraph::warnings`].
///
/// # Errors
/// Missing, truncated or inconsistent files, buffers outside the file's folder, extensions that must be known,
/// values that are not finite; each names the object of the file.
pub fn read_scene(path: &Path) -> Result<SceneGraph, GltfError> {
    let source = Source::open(path)?;
    let mut warnings = Vec::new();
    let hierarchy = Hierarchy::read(&source, &mut warnings)?;
    let curves = Curves::read(&source, &hierarchy.locals, &mut warnings)?;
    check_amount(&source, &hierarchy)?;
    let world = hierarchy.placed.iter().find_map(|placed| match &placed.cif {
        Some(Cif::World(world)) => Some((placed, (**world).clone())),
        _ => None,
    });
    if let Some((placed, world)) = &world {
        check_world(world).map_err(|what| source.invalid(source.node_name(placed.index), what))?;
        if world.layout > extras::LAYOUT {
            warnings.push(format!("{} wrote this file; a newer cif may read more of it", world.generator));
        }
    }
    let stage = stage(&source, &hierarchy, &curves, world.as_ref().map(|(_, world)| world));
    let found = objects::find(&stage, &hierarchy.placed);
    check_keys(&stage, &found)?;
    let moved = world.as_ref().and_then(|(placed, world)| moved_world(&stage, placed, world, &mut warnings));
    let mut reader = Reader {
        stage: &stage,
        world: world.as_ref().map(|(placed, _)| (placed.index, moved)),
        warnings: &mut warnings,
        next_row: (!is_traced(&source)).then_some(0),
    };
    let prims = found.iter().map(|object| reader.prim(object)).collect::<Result<Vec<_>, _>>()?;
    let mut prims: Vec<Prim> = prims.into_iter().flatten().collect();
    prims.sort_by_key(|prim| prim.identity == Identity::Background);
    let cameras = cameras::read(&mut reader, &hierarchy.placed);
    for (taxonomy, label) in prims.iter().flat_map(|prim| &prim.taxonomies) {
        if let Err(problem) = cif_output::check_taxonomy(taxonomy) {
            return Err(source.invalid(format!("the taxonomy {taxonomy:?}"), problem));
        }
        if label.is_empty() {
            return Err(
                source.invalid(format!("the taxonomy {taxonomy:?}"), "it names nothing; leave it out")
            );
        }
    }
    let objects = prims
        .iter()
        .flat_map(|prim| [&prim.label, &prim.category].into_iter().chain(prim.taxonomies.values()));
    if let Some(name) =
        objects.chain(cameras.iter().map(|track| &track.label)).find(|name| name.contains('\0'))
    {
        return Err(source.invalid(format!("the name {name:?}"), "it holds a NUL character; leave it out"));
    }
    if prims.is_empty() {
        return Err(GltfError::NoSplats { path: path.to_owned(), found: what_else(&source) });
    }
    warn_of_meshes(&source, &hierarchy, &mut warnings);
    let world = world.map(|(_, world)| world);
    let timeline = match &world {
        Some(world) => {
            let codes = &world.time_codes;
            let frame = |code: Option<&f64>| code.map_or(0, |code| code.max(0.0).round() as usize);
            let frames = (frame(codes.first()), frame(codes.last()));
            for prim in &mut prims {
                prim.source_frames.get_or_insert(frames);
            }
            Timeline::Recorded(TimeCodes {
                samples: codes.clone(),
                times: world.times.clone(),
                frames_per_second: world.frames_per_second,
            })
        }
        None => {
            let of_cameras = cameras.iter().flat_map(|track| &track.samples).map(|sample| sample.time_code);
            let codes = std::iter::once(0.0).chain(of_cameras).collect();
            Timeline::Sampled { codes, start: 0.0, frames_per_second: FRAMES_PER_SECOND }
        }
    };
    let scene = Prims {
        timeline,
        prims,
        cameras,
        reserved: reserved(&hierarchy),
        copies: Copies::Renumber,
        ..Prims::default()
    };
    let scene = match world {
        Some(world) => Prims {
            up_axis: world.up_axis,
            meters_per_unit: world.meters_per_unit,
            frame: world.frame,
            background_color: world.background_color,
            sort_metric: world.sort_metric,
            antialiased: world.antialiased,
            omitted: world.omitted,
            warnings: world.warnings.into_iter().chain(warnings).collect(),
            origin: Origin { field_fingerprint: world.field_fingerprint, options: world.options },
            ..scene
        },
        None => Prims { up_axis: UpAxis::Y, sort_metric: SortMetric::Distance, warnings, ..scene },
    };
    assemble(scene).map_err(|AssembleError { place, what }| source.invalid(place, what))
}

/// Checks the `extras` of our exporter, which may have been changed since.
fn check_world(world: &World) -> Result<(), String> {
    let codes = &world.time_codes;
    let ascending = |values: &[f64]| values.windows(2).all(|pair| pair[0] < pair[1]);
    let finite = codes.iter().chain(&world.times).all(|value| value.is_finite());
    if codes.is_empty() || codes.len() != world.times.len() || !finite || !ascending(codes) {
        return Err(
            "time_codes and times of its extras.cif do not pair up; export the scene again".to_owned()
        );
    }
    let positive = |value: f64| value.is_finite() && value > 0.0;
    if !positive(world.frames_per_second)
        || !positive(world.meters_per_unit)
        || !world.first_time_code.is_finite()
    {
        return Err("frame rate or unit of its extras.cif is not above 0; export the scene again".to_owned());
    }
    if !world.frame.is_valid() {
        return Err("frame of its extras.cif places the scene nowhere; export the scene again".to_owned());
    }
    Ok(())
}

fn stage<'a>(
    source: &'a Source,
    hierarchy: &'a Hierarchy,
    curves: &'a Curves,
    world: Option<&World>,
) -> Stage<'a> {
    let of_cameras = hierarchy.placed.iter().filter_map(|placed| match &placed.cif {
        Some(Cif::Camera(camera)) => Some(camera.time_codes.iter().copied()),
        _ => None,
    });
    let clock = match world {
        Some(world) => Clock::new(
            world.first_time_code,
            world.frames_per_second,
            world.time_codes.iter().copied().chain(of_cameras.flatten()),
        ),
        None => Clock::new(0.0, FRAMES_PER_SECOND, std::iter::empty()),
    };
    let start = world.map_or(0.0, |world| world.time_codes[0]);
    Stage { source, locals: &hierarchy.locals, curves, clock, start }
}

/// Where our root was moved: what brings the world of the file into that of the scene.
fn moved_world(
    stage: &Stage<'_>,
    placed: &Placed,
    world: &World,
    warnings: &mut Vec<String>,
) -> Option<DAffine3> {
    let root = conventions::gltf_from_scene(world.up_axis, world.meters_per_unit, &world.frame);
    let scale = DVec3::splat(f64::from(root.scale as f32));
    let written = DAffine3::from_scale_rotation_translation(scale, root.rotation, root.translation);
    let chain = placed.chain.iter();
    let now = chain.clone().fold(DAffine3::IDENTITY, |all, &node| all * stage.locals[node].affine());
    let animated = chain.clone().any(|&node| stage.curves.of(node).is_some());
    let difference = (now.matrix3 - written.matrix3).to_cols_array();
    let turned = difference.iter().any(|value| value.abs() > 1e-6 * scale.x);
    // Readers hold single precision.
    let rounding = 1e-9 + f64::from(f32::EPSILON) * written.translation.abs().max_element();
    if !animated && !turned && (now.translation - written.translation).abs().max_element() < rounding {
        return None;
    }
    warnings.push(format!("{} was moved: all objects move with it", stage.source.node_name(placed.index)));
    Some(written.inverse())
}

fn is_traced(source: &Source) -> bool {
    let row = gltf::json::validation::Checked::Valid(gltf::json::mesh::Semantic::Extras(
        crate::ROW[1..].to_owned(),
    ));
    source.root.meshes.iter().flat_map(|mesh| &mesh.primitives).any(|p| p.attributes.contains_key(&row))
}

/// Mask values that objects of ours carry, and their places in the instance table.
fn reserved(hierarchy: &Hierarchy) -> BTreeMap<u16, usize> {
    let ids = hierarchy.placed.iter().filter_map(|placed| match &placed.cif {
        Some(Cif::Instance(instance)) => Some((instance.id, instance.index)),
        _ => None,
    });
    ids.collect()
}

/// Meshes may be placed often; what they become must stay in proportion to the file.
fn check_amount(source: &Source, hierarchy: &Hierarchy) -> Result<(), GltfError> {
    let mut total = 0_u64;
    for placed in &hierarchy.placed {
        let Some(mesh) = source.root.nodes[placed.index].mesh else { continue };
        if mesh.value() >= source.root.meshes.len() {
            let what = format!("its mesh {} is not in the file", mesh.value());
            return Err(source.invalid(source.node_name(placed.index), what));
        }
        total = total.saturating_add(source.splat_count(mesh.value()).unwrap_or(0));
        if total > source.bytes {
            let what = format!(
                "up to here the file places {total} splats, more than its {} bytes can describe; place meshes less often",
                source.bytes
            );
            return Err(source.invalid(source.node_name(placed.index), what));
        }
    }
    Ok(())
}

/// As [`check_amount`], for the keys of nodes above many objects.
fn check_keys(stage: &Stage<'_>, found: &[objects::Found<'_>]) -> Result<(), GltfError> {
    let allowed = stage.source.bytes.max(1 << 20);
    let mut total = 0_u64;
    for placed in found.iter().flat_map(objects::Found::all) {
        let keys: usize =
            placed.chain.iter().filter_map(|&node| stage.curves.of(node)).map(|c| c.keys()).sum();
        total += (keys * placed.chain.len()) as u64;
        if total > allowed {
            let what = format!(
                "up to here {total} keys are to be followed; animate nodes that are nearer to the splats"
            );
            return Err(stage.source.invalid(stage.source.node_name(placed.index), what));
        }
    }
    Ok(())
}

fn what_else(source: &Source) -> String {
    let root = &source.root;
    let points = root.meshes.iter().flat_map(|mesh| &mesh.primitives).count();
    match (root.meshes.len(), points) {
        (0, _) => format!("{} nodes without meshes", root.nodes.len()),
        (meshes, primitives) => format!("{meshes} meshes with {primitives} primitives of other kinds"),
    }
}

fn warn_of_meshes(source: &Source, hierarchy: &Hierarchy, warnings: &mut Vec<String>) {
    let others = hierarchy.placed.iter().filter(|placed| {
        let mesh = source.root.nodes[placed.index].mesh;
        mesh.is_some_and(|mesh| source.splat_count(mesh.value()).is_none())
    });
    let count = others.count();
    if count > 0 {
        warnings.push(format!("{count} nodes hold meshes without splats; they were left out"));
    }
}
