//! A scene graph as the document of a page.

use std::collections::BTreeMap;

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_geometry::{Bounds, PinholeCamera, UpAxis};
use cif_scene::{CameraTrack, Motion, NodeKind, PartsMotion, PoseSample, SceneGraph, Splats as GraphSplats};
use glam::{DQuat, DVec3};

use crate::arrays::Block;
use crate::document::{
    Camera, Deformation, Document, Joint, Kind, Node, Part, Samples, Shot, Splats, Timeline, Track, VERSION,
    Visibility,
};

/// Near plane of scenes that state none, world units: that of the renderers of cif.
pub const NEAR: f32 = 0.2;

/// A document and its block of bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    /// The document.
    pub document: Document,
    /// The arrays that it names.
    pub bytes: Vec<u8>,
}

impl Page {
    /// A document with its bytes.
    #[must_use]
    pub fn of(document: Document, bytes: Vec<u8>) -> Self {
        Self { document: Document { bytes: bytes.len(), ..document }, bytes }
    }

    /// A page of a run that has nothing to show yet.
    #[must_use]
    pub fn empty(title: &str) -> Self {
        let document = Document {
            version: VERSION,
            title: title.to_owned(),
            up: up(UpAxis::Z, []),
            meters_per_unit: None,
            background: [0.1; 3],
            sort: "z",
            antialiased: false,
            near: NEAR,
            timeline: Timeline { start: 0.0, end: 0.0, per_second: 1.0, samples: vec![0.0] },
            nodes: Vec::new(),
            cameras: Vec::new(),
            views: Vec::new(),
            stage: None,
            bytes: 0,
            live: true,
        };
        Self { document, bytes: Vec::new() }
    }
}

/// Colour of an instance in pictures, by its mask value.
pub type InstanceColor = fn(u16) -> [u8; 3];

/// A scene graph as a page. `paths` are those of prims by the names of nodes; nodes that it does not have are where `cif
/// export` writes them.
#[must_use]
pub fn describe(
    graph: &SceneGraph,
    title: &str,
    paths: &BTreeMap<String, String>,
    color: InstanceColor,
) -> Page {
    let mut block = Block::default();
    let nodes = graph.nodes.iter().map(|node| {
        let path = paths.get(&node.name).cloned();
        let path = path.unwrap_or_else(|| format!("/World/{}", node.name));
        self::node(graph, node, path, color, &mut block)
    });
    let document = Document {
        version: VERSION,
        title: title.to_owned(),
        up: up(
            graph.up_axis,
            graph.cameras.iter().flat_map(|track| &track.samples).map(|sample| &sample.camera),
        ),
        meters_per_unit: Some(graph.meters_per_unit),
        background: graph.background_color,
        sort: match graph.sort_metric {
            cif_field::SortMetric::Z => "z",
            cif_field::SortMetric::Distance => "distance",
        },
        antialiased: graph.antialiased.unwrap_or_default(),
        near: graph.near.unwrap_or(NEAR),
        timeline: Timeline {
            start: graph.time_codes.start(),
            end: graph.time_codes.end(),
            per_second: graph.time_codes.frames_per_second,
            samples: graph.time_codes.samples.clone(),
        },
        nodes: nodes.collect(),
        cameras: graph.cameras.iter().map(camera).collect(),
        views: Vec::new(),
        stage: None,
        bytes: 0,
        live: false,
    };
    Page::of(document, block.into_bytes())
}

/// Cosine of the angle between the declared axis and the mean up direction of cameras from which on the cameras decide:
/// 45 degrees, as people hold cameras upright and look down on tables.
const UPRIGHT: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// The unit vector that points up: the declared axis, unless the cameras of the scene stand otherwise, as in captures
/// whose world has any orientation.
#[must_use]
pub fn up<'a>(axis: UpAxis, cameras: impl IntoIterator<Item = &'a PinholeCamera>) -> [f64; 3] {
    let declared = match axis {
        UpAxis::Y => DVec3::Y,
        UpAxis::Z => DVec3::Z,
    };
    // Rows of `camera_from_world` are the axes of the camera in the world, of which y points down.
    let sum: DVec3 = cameras.into_iter().map(|camera| -camera.camera_from_world.rotation.row(1)).sum();
    let upright = sum.try_normalize().filter(|mean| mean.dot(declared) < UPRIGHT);
    upright.unwrap_or(declared).to_array()
}

/// A camera at a time code.
#[must_use]
pub fn shot(code: f64, camera: &PinholeCamera) -> Shot {
    let world_from_camera = camera.camera_from_world.inverse();
    Shot {
        code,
        size: [camera.width, camera.height],
        focal: camera.focal_px.to_array(),
        principal: camera.principal_px.to_array(),
        pose: pose(world_from_camera.translation, DQuat::from_mat3(&world_from_camera.rotation)),
    }
}

fn camera(track: &CameraTrack) -> Camera {
    let shots = track.samples.iter().map(|sample| shot(sample.time_code, &sample.camera));
    Camera { name: track.label.clone(), samples: shots.collect() }
}

fn pose(translation: DVec3, rotation: DQuat) -> [f64; 7] {
    let ([x, y, z], q) = (translation.to_array(), rotation.normalize());
    [x, y, z, q.w, q.x, q.y, q.z]
}

/// A path; what stays has one pose.
fn track(samples: &[PoseSample], rest: DVec3, start: f64) -> Track {
    if samples.is_empty() {
        return Track { codes: vec![start], poses: vec![pose(rest, DQuat::IDENTITY)] };
    }
    Track {
        codes: samples.iter().map(|sample| sample.time_code).collect(),
        poses: samples.iter().map(|sample| pose(sample.translation, sample.rotation)).collect(),
    }
}

fn node(
    graph: &SceneGraph,
    node: &cif_scene::Node,
    path: String,
    color: InstanceColor,
    block: &mut Block,
) -> Node {
    let (kind, id) = match node.kind {
        NodeKind::Instance { id, .. } => (Kind::Instance, Some(id)),
        NodeKind::Background => (Kind::Background, None),
    };
    let deformation = match &node.motion {
        Motion::Dense(dense) if !dense.samples.is_empty() => {
            let centres = &node.splats.means;
            let offset =
                |mean: &[f32; 3], centre: &[f32; 3]| std::array::from_fn(|axis| mean[axis] - centre[axis]);
            let offsets: Vec<[f32; 3]> = dense
                .samples
                .iter()
                .flat_map(|sample| {
                    sample.means.iter().zip(centres).map(|(mean, centre)| offset(mean, centre))
                })
                .collect();
            let turns: Vec<[f32; 4]> =
                dense.samples.iter().flat_map(|sample| sample.orientations.iter().copied()).collect();
            let grows = dense.samples.iter().any(|sample| sample.scales.is_some());
            let scales: Vec<[f32; 3]> = dense
                .samples
                .iter()
                .filter(|_| grows)
                .flat_map(|sample| sample.scales.as_ref().unwrap_or(&node.splats.scales).iter().copied())
                .collect();
            Some(Deformation {
                codes: dense.samples.iter().map(|sample| sample.time_code).collect(),
                offsets: block.fine(offsets.as_flattened()),
                orientations: block.fine(turns.as_flattened()),
                scales: grows.then(|| block.rounded(scales.as_flattened())),
            })
        }
        _ => None,
    };
    let samples = |changes: &[cif_scene::AppearanceSample], block: &mut Block| {
        (!changes.is_empty()).then(|| Samples {
            codes: changes.iter().map(|sample| sample.time_code).collect(),
            values: block
                .rounded(&changes.iter().flat_map(|sample| &sample.values).copied().collect::<Vec<_>>()),
        })
    };
    Node {
        kind,
        id,
        name: node.name.clone(),
        path,
        label: node.label.clone(),
        category: node.category.clone(),
        color: color(id.unwrap_or_default()),
        motion: node.model().to_string(),
        rotation: node.report.rotation.map(|evidence| evidence.to_string()),
        mean_occupancy: node.mean_occupancy,
        extent: extent(graph, node),
        track: track(node.track(), node.pivot, graph.time_codes.start()),
        parts: node.motion.parts().map_or_else(Vec::new, |motion| parts(motion, graph.time_codes.start())),
        visibility: node
            .visibility
            .iter()
            .map(|change| Visibility { code: change.time_code, visible: change.visible })
            .collect(),
        splats: splats(&node.splats, block),
        deformation,
        opacities: samples(&node.appearance.opacities, block),
        harmonics: samples(&node.appearance.colors, block),
    }
}

/// The box of a node over all sampled times.
fn extent(graph: &SceneGraph, node: &cif_scene::Node) -> [[f64; 3]; 2] {
    let boxes = node.boxes();
    let changes = matches!(node.motion, Motion::Parts(_) | Motion::Dense(_));
    let codes = &graph.time_codes.samples;
    let codes = if changes { codes.as_slice() } else { codes.get(..1).unwrap_or(codes) };
    corners(&codes.iter().map(|code| boxes.local(*code)).fold(Bounds::EMPTY, Bounds::union))
}

fn corners(bounds: &Bounds) -> [[f64; 3]; 2] {
    if bounds.is_empty() { [[0.0; 3]; 2] } else { [bounds.low.to_array(), bounds.high.to_array()] }
}

fn parts(motion: &PartsMotion, start: f64) -> Vec<Part> {
    let part = |(index, part): (usize, &cif_scene::Part)| Part {
        name: part.name.clone(),
        first: part.splats.start,
        count: part.splats.len(),
        track: track(&part.track, part.pivot, start),
        joint: part.joint.and_then(|joint| {
            Some(Joint {
                kind: joint.kind.to_string(),
                base: motion.parts.get(joint.base)?.name.clone(),
                axis: joint.axis.to_array(),
                anchor: joint.anchor.to_array(),
                range: motion.joint_range(index),
            })
        }),
    };
    motion.parts.iter().enumerate().map(part).collect()
}

fn splats(splats: &GraphSplats, block: &mut Block) -> Splats {
    let row = 3 * coefficient_count(splats.sh_degree);
    let of = |range: std::ops::Range<usize>| -> Vec<f32> {
        splats.sh_coefficients.chunks_exact(row).flat_map(|row| &row[range.clone()]).copied().collect()
    };
    Splats {
        count: splats.len(),
        centres: block.exact(splats.means.as_flattened()),
        orientations: block.fine(splats.orientations.as_flattened()),
        scales: block.rounded(splats.scales.as_flattened()),
        opacities: block.exact(&splats.opacities),
        degree: splats.sh_degree,
        base: block.rounded(&of(0..3)),
        higher: (splats.sh_degree > 0).then(|| block.coarse(&of(3..row))),
    }
}

/// Points of a capture, as round splats of one size.
#[must_use]
pub fn points(positions: &[[f32; 3]], colors: &[[u8; 3]], width: f32) -> (Node, Vec<u8>) {
    let mut block = Block::default();
    let band_0 = cif_geometry::spherical_harmonics::BAND_0 as f32;
    let base: Vec<f32> =
        colors.as_flattened().iter().map(|value| (f32::from(*value) / 255.0 - 0.5) / band_0).collect();
    let count = positions.len();
    let bounds = Bounds::around(positions.iter().map(|point| DVec3::from_array(point.map(f64::from))));
    let node = Node {
        kind: Kind::Points,
        id: None,
        name: "points".into(),
        path: String::new(),
        label: "points".into(),
        category: String::new(),
        color: [128; 3],
        motion: "static".into(),
        rotation: None,
        mean_occupancy: 1.0,
        extent: corners(&bounds),
        track: track(&[], DVec3::ZERO, 0.0),
        parts: Vec::new(),
        visibility: Vec::new(),
        splats: Splats {
            count,
            centres: block.exact(positions.as_flattened()),
            orientations: block.fine(&[1.0, 0.0, 0.0, 0.0].repeat(count)),
            scales: block.rounded(&vec![width; 3 * count]),
            opacities: block.rounded(&vec![1.0; count]),
            degree: 0,
            base: block.rounded(&base),
            higher: None,
        },
        deformation: None,
        opacities: None,
        harmonics: None,
    };
    (node, block.into_bytes())
}
