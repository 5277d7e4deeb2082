//! Authoring of a file: the glTF document of a scene graph, and the arrays of its buffer.

use std::collections::BTreeMap;
use std::ops::Range;

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_scene::{
    CameraTrack, Motion, MotionModel, Node, NodeKind, PoseSample, SceneGraph, Splats, VisibilitySample,
    naming,
};
use glam::{DQuat, DVec2, DVec3};
use serde_json::{Value, json};

use crate::arrays::Array;
use crate::document::{self, Document};
use crate::extras::{self, Cif, Extras};
use crate::names::GENERATOR;
use crate::rotation_keys::{self, Inserted, SamplerExtras};
use crate::{EXTENSION, GltfError, POINTER, VISIBILITY, conventions, loose};

/// A document and the arrays that follow each other in its only buffer.
pub(crate) struct Authored<'a> {
    pub(crate) document: Document,
    pub(crate) arrays: Vec<Array<'a>>,
    /// Bytes of the buffer.
    pub(crate) bytes: u64,
}

/// Builds the document of a graph, whose loose splats are given in frames of their own. The buffer has no URI yet.
///
/// # Errors
/// When arrays do not fit together, or values are not finite.
pub(crate) fn author<'a>(
    graph: &'a SceneGraph,
    loose: &'a BTreeMap<usize, Splats>,
) -> Result<Authored<'a>, GltfError> {
    let mut author = Author::new(graph)?;
    let mut children = Vec::new();
    for (position, node) in graph.nodes.iter().enumerate() {
        children.push(author.node(node, loose.get(&position))?);
    }
    let cameras: Vec<usize> =
        graph.cameras.iter().map(|track| author.camera(track)).collect::<Result<_, _>>()?;
    if !cameras.is_empty() {
        let name = author.unique("Cameras");
        let group = document::Node { name, children: cameras, ..document::Node::default() };
        children.push(author.push(group));
    }
    author.finish(children)
}

struct Author<'a> {
    graph: &'a SceneGraph,
    first_time_code: f64,
    names: naming::Names,
    document: Document,
    arrays: Vec<Array<'a>>,
    bytes: u64,
    channels: Vec<document::Channel>,
    samplers: Vec<document::Sampler>,
    /// Accessors of key times, by their bits: most tracks share them.
    inputs: BTreeMap<Vec<u32>, usize>,
}

impl<'a> Author<'a> {
    fn new(graph: &'a SceneGraph) -> Result<Self, GltfError> {
        let wrong = |what: &str| {
            Err(GltfError::Inconsistent { node: conventions::WORLD.to_owned(), what: what.to_owned() })
        };
        let codes = &graph.time_codes;
        if codes.samples.is_empty() || codes.samples.len() != codes.times.len() {
            return wrong("its time codes and times do not pair up");
        }
        if !(codes.frames_per_second > 0.0 && codes.frames_per_second.is_finite()) {
            return wrong("it has no frame rate");
        }
        if !(graph.meters_per_unit > 0.0 && graph.meters_per_unit.is_finite()) {
            return wrong("its unit has no length");
        }
        let mut names = naming::Names::default();
        names.take(conventions::WORLD.to_owned());
        Ok(Self {
            graph,
            first_time_code: first_time_code(graph),
            names,
            document: Document::default(),
            arrays: Vec::new(),
            bytes: 0,
            channels: Vec::new(),
            samplers: Vec::new(),
            inputs: BTreeMap::new(),
        })
    }

    /// A node name that no other node has: engines bind animation tracks by name.
    fn unique(&mut self, name: &str) -> String {
        self.names.take(name.to_owned())
    }

    fn push(&mut self, node: document::Node) -> usize {
        self.document.nodes.push(node);
        self.document.nodes.len() - 1
    }

    fn node(&mut self, node: &'a Node, loose: Option<&'a Splats>) -> Result<usize, GltfError> {
        check_splats(node)?;
        let name = self.unique(&node.name);
        let track = node.track();
        let rest = PoseSample { time_code: 0.0, translation: node.pivot, rotation: DQuat::IDENTITY };
        let first = track.first().unwrap_or(&rest);
        let hidden = node.visibility.first().is_some_and(|sample| !sample.visible);
        let index = self.push(document::Node {
            name: name.clone(),
            translation: Some(single(first.translation)),
            rotation: Some(conventions::gltf_quaternion(first.rotation)),
            scale: hidden.then_some([conventions::HIDDEN_SCALE; 3]),
            extensions: visibility(&node.visibility),
            extras: Some(Extras { cif: object_extras(node) }),
            ..document::Node::default()
        });
        let all = 0..node.splats.len();
        let error = rotation_keys::allowed_error(&node.report);
        match &node.motion {
            Motion::Static | Motion::Rigid(_) => {
                self.document.nodes[index].mesh = self.mesh(&name, &node.splats, all);
            }
            Motion::Parts(motion) => {
                for (position, part) in motion.parts.iter().enumerate() {
                    let rest =
                        PoseSample { time_code: 0.0, translation: part.pivot, rotation: DQuat::IDENTITY };
                    let first = part.track.first().unwrap_or(&rest);
                    let extras = extras::Part {
                        name: part.name.clone(),
                        part: position,
                        pivot: part.pivot.to_array(),
                        joint: part.joint,
                        range: motion.joint_range(position),
                    };
                    let child = self.part(index, &name, &node.splats, part.splats.clone(), first, extras);
                    self.pose_channels(child, &part.track, &node.name, error)?;
                }
            }
            Motion::Dense(motion) => {
                let own = loose.ok_or_else(|| GltfError::Dense { node: node.name.clone() })?;
                for splat in all {
                    let (track, sizes) = loose::path(motion, splat, own);
                    let extras = extras::Part {
                        name: format!("splat_{splat:03}"),
                        part: splat,
                        pivot: track[0].translation.to_array(),
                        joint: None,
                        range: None,
                    };
                    let child = self.part(index, &name, own, splat..splat + 1, &track[0], extras);
                    self.pose_channels(child, &track, &node.name, error)?;
                    self.size_channel(child, &track, sizes, &node.name)?;
                }
            }
        }
        self.pose_channels(index, track, &node.name, error)?;
        self.visibility_channel(index, &node.visibility, &node.name)?;
        Ok(index)
    }

    /// A node below that of the object `of`, with a range of splats.
    fn part(
        &mut self,
        parent: usize,
        of: &str,
        splats: &'a Splats,
        range: Range<usize>,
        first: &PoseSample,
        extras: extras::Part,
    ) -> usize {
        let name = self.unique(&format!("{of}_{}", extras.name));
        let mesh = self.mesh(&name, splats, range);
        let child = self.push(document::Node {
            name,
            mesh,
            translation: Some(single(first.translation)),
            rotation: Some(conventions::gltf_quaternion(first.rotation)),
            extras: Some(Extras { cif: Cif::Part(extras) }),
            ..document::Node::default()
        });
        self.document.nodes[parent].children.push(child);
        child
    }

    /// One mesh of one splat primitive; `None` for no splats, as primitives must not be empty.
    fn mesh(&mut self, name: &str, splats: &'a Splats, range: Range<usize>) -> Option<usize> {
        if range.is_empty() {
            return None;
        }
        let count = range.len();
        let mut attributes = BTreeMap::new();
        let extension = |name: &str| format!("{EXTENSION}:{name}");
        let means = &splats.means[range.clone()];
        let (min, max) = corners(means);
        let position = self.accessor(Array::Means(means), document::FLOAT, "VEC3", count);
        self.document.accessors[position].min = Some(min);
        self.document.accessors[position].max = Some(max);
        attributes.insert("POSITION".to_owned(), position);
        let colors = Array::Colors(splats, range.clone());
        let colors = self.accessor(colors, document::UNSIGNED_SHORT, "VEC4", count);
        self.document.accessors[colors].normalized = true;
        attributes.insert("COLOR_0".to_owned(), colors);
        let mut float = |name: String, array: Array<'a>, kind| {
            let accessor = self.accessor(array, document::FLOAT, kind, count);
            attributes.insert(name, accessor);
        };
        let orientations = Array::Orientations(&splats.orientations[range.clone()]);
        float(extension("ROTATION"), orientations, "VEC4");
        float(extension("SCALE"), Array::Scales(&splats.scales[range.clone()]), "VEC3");
        float(extension("OPACITY"), Array::Numbers(&splats.opacities[range.clone()]), "SCALAR");
        for degree in 0..=usize::from(splats.sh_degree) {
            for order in 0..2 * degree + 1 {
                let coefficient = Array::Coefficient(splats, range.clone(), degree * degree + order);
                float(extension(&format!("SH_DEGREE_{degree}_COEF_{order}")), coefficient, "VEC3");
            }
        }
        let occupancies = Array::Numbers(&splats.occupancies[range.clone()]);
        float(crate::OCCUPANCY.to_owned(), occupancies, "SCALAR");
        let identities = Array::Numbers(&splats.identity_probabilities[range.clone()]);
        float(crate::IDENTITY.to_owned(), identities, "SCALAR");
        if !splats.identities.is_empty() {
            let identities = &splats.identities[range.clone()];
            float(crate::INSTANCE_SHARES.to_owned(), Array::Shares(identities), "VEC4");
            let ids = self.accessor(Array::Ids(identities), document::UNSIGNED_SHORT, "VEC4", count);
            attributes.insert(crate::INSTANCE_IDS.to_owned(), ids);
        }
        let rows = self.accessor(Array::Rows(&splats.rows[range]), document::UNSIGNED_SHORT, "VEC2", count);
        attributes.insert(crate::ROW.to_owned(), rows);
        let extension: Value = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
        self.document.meshes.push(document::Mesh {
            name: name.to_owned(),
            primitives: vec![document::Primitive {
                mode: document::POINTS,
                attributes,
                extensions: BTreeMap::from([(EXTENSION, extension)]),
            }],
        });
        for accessor in position..self.document.accessors.len() {
            let view = self.document.accessors[accessor].buffer_view;
            self.document.buffer_views[view].target = Some(document::ARRAY_BUFFER);
        }
        Some(self.document.meshes.len() - 1)
    }

    fn camera(&mut self, track: &CameraTrack) -> Result<usize, GltfError> {
        let name = self.unique(&track.name);
        let mut poses: Vec<PoseSample> = Vec::with_capacity(track.samples.len());
        for sample in &track.samples {
            let (translation, rotation) = conventions::gltf_camera_pose(&sample.camera);
            let turned = poses.last().is_some_and(|before| before.rotation.dot(rotation) < 0.0);
            let rotation = if turned { -rotation } else { rotation };
            poses.push(PoseSample { time_code: sample.time_code, translation, rotation });
        }
        let wrong = |what: &str| GltfError::Inconsistent { node: track.name.clone(), what: what.to_owned() };
        let Some((first, pose)) = track.samples.first().zip(poses.first()) else {
            return Err(wrong("the camera has no view"));
        };
        let first = &first.camera;
        let sizes = track.samples.iter().all(|s| {
            let camera = &s.camera;
            camera.width > 0 && camera.height > 0 && camera.focal_px.cmpgt(DVec2::ZERO).all()
        });
        if !sizes {
            return Err(wrong("the camera has no focal length or no pixels"));
        }
        let (yfov, aspect_ratio) = conventions::perspective(first.width, first.height, first.focal_px);
        self.document.cameras.push(document::Camera {
            name: name.clone(),
            r#type: "perspective",
            perspective: document::Perspective { yfov, aspect_ratio, znear: conventions::NEAR_METERS },
        });
        let camera = self.document.cameras.len() - 1;
        let mut views: Vec<extras::View> = track.samples.iter().map(|sample| view(&sample.camera)).collect();
        if views.windows(2).all(|pair| pair[0] == pair[1]) {
            views.truncate(1);
        }
        let node = self.push(document::Node {
            name,
            camera: Some(camera),
            translation: Some(single(pose.translation)),
            rotation: Some(conventions::gltf_quaternion(pose.rotation)),
            extras: Some(Extras {
                cif: Cif::Camera(extras::Camera {
                    name: track.name.clone(),
                    label: track.label.clone(),
                    time_codes: track.samples.iter().map(|sample| sample.time_code).collect(),
                    views,
                }),
            }),
            ..document::Node::default()
        });
        let same = |pose: &PoseSample| {
            pose.translation == poses[0].translation && pose.rotation == poses[0].rotation
        };
        if !poses.iter().all(same) {
            self.pose_channels(node, &poses, &track.name, rotation_keys::LARGEST_ERROR)?;
        }
        Ok(node)
    }

    /// LINEAR translation and rotation. A single sample stands in the node itself. `error`: radians by which
    /// viewers that draw straight lines between quaternions may be off.
    fn pose_channels(
        &mut self,
        node: usize,
        track: &[PoseSample],
        name: &str,
        error: f64,
    ) -> Result<(), GltfError> {
        if track.len() < 2 {
            return Ok(());
        }
        let finite = |pose: &PoseSample| pose.translation.is_finite() && pose.rotation.is_finite();
        let translations: Vec<f32> =
            track.iter().flat_map(|pose| pose.translation.as_vec3().to_array()).collect();
        if !track.iter().all(finite) || !translations.iter().all(|value| value.is_finite()) {
            return Err(GltfError::Inconsistent {
                node: name.to_owned(),
                what: "its track is not finite".to_owned(),
            });
        }
        let times = self.key_times(track.iter().map(|pose| pose.time_code), name)?;
        let rotations: Vec<DQuat> = track.iter().map(|pose| pose.rotation).collect();
        let filled = rotation_keys::filled(&times, &rotations, error);
        let input = self.input(times);
        let output = self.accessor(Array::Keys(translations), document::FLOAT, "VEC3", track.len());
        self.channel(node, "translation", input, output, "LINEAR");
        let count = filled.seconds.len();
        let input = self.input(filled.seconds);
        let rotations =
            filled.rotations.iter().flat_map(|rotation| conventions::gltf_quaternion(*rotation)).collect();
        let output = self.accessor(Array::Keys(rotations), document::FLOAT, "VEC4", count);
        self.channel(node, "rotation", input, output, "LINEAR");
        if !filled.inserted.is_empty()
            && let Some(sampler) = self.samplers.last_mut()
        {
            sampler.extras = Some(SamplerExtras { cif: Inserted { inserted: filled.inserted } });
        }
        Ok(())
    }

    /// LINEAR scale at the samples of a track, of at least two; nothing where no size is given.
    fn size_channel(
        &mut self,
        node: usize,
        track: &[PoseSample],
        sizes: Vec<[f32; 3]>,
        name: &str,
    ) -> Result<(), GltfError> {
        if sizes.len() < 2 {
            return Ok(());
        }
        if !sizes.as_flattened().iter().all(|size| size.is_finite() && *size > 0.0) {
            let what = "a size of its splats is not finite".to_owned();
            return Err(GltfError::Inconsistent { node: name.to_owned(), what });
        }
        let times = self.key_times(track.iter().map(|pose| pose.time_code), name)?;
        let input = self.input(times);
        let count = sizes.len();
        let output = self.accessor(Array::Keys(sizes.into_flattened()), document::FLOAT, "VEC3", count);
        self.channel(node, "scale", input, output, "LINEAR");
        Ok(())
    }

    /// Steps of the visibility of the node, and of its scale for players that know no visibility.
    fn visibility_channel(
        &mut self,
        node: usize,
        samples: &[VisibilitySample],
        name: &str,
    ) -> Result<(), GltfError> {
        if samples.is_empty() {
            return Ok(());
        }
        let times = self.key_times(samples.iter().map(|sample| sample.time_code), name)?;
        let input = self.input(times);
        let scale = |sample: &VisibilitySample| if sample.visible { 1.0 } else { conventions::HIDDEN_SCALE };
        let scales = samples.iter().flat_map(|sample| [scale(sample); 3]).collect();
        let output = self.accessor(Array::Keys(scales), document::FLOAT, "VEC3", samples.len());
        self.channel(node, "scale", input, output, "STEP");
        let flags = samples.iter().map(|sample| sample.visible).collect();
        let output = self.accessor(Array::Flags(flags), document::UNSIGNED_BYTE, "SCALAR", samples.len());
        let pointer = json!({ "pointer": format!("/nodes/{node}/extensions/{VISIBILITY}/visible") });
        let extensions = BTreeMap::from([(POINTER, pointer)]);
        self.drive(document::Target { node: None, path: "pointer", extensions }, input, output, "STEP");
        Ok(())
    }

    fn channel(
        &mut self,
        node: usize,
        path: &'static str,
        input: usize,
        output: usize,
        interpolation: &'static str,
    ) {
        let target = document::Target { node: Some(node), path, extensions: BTreeMap::new() };
        self.drive(target, input, output, interpolation);
    }

    fn drive(&mut self, target: document::Target, input: usize, output: usize, interpolation: &'static str) {
        let sampler = self.samplers.len();
        self.samplers.push(document::Sampler { input, output, interpolation, extras: None });
        self.channels.push(document::Channel { sampler, target });
    }

    /// Key times, seconds.
    fn key_times(&self, codes: impl Iterator<Item = f64>, name: &str) -> Result<Vec<f32>, GltfError> {
        let rate = self.graph.time_codes.frames_per_second;
        let times: Vec<f32> =
            codes.map(|code| conventions::seconds(code, self.first_time_code, rate)).collect();
        let ascending = times.windows(2).all(|pair| pair[0] < pair[1]);
        if !ascending || !times.iter().all(|time| time.is_finite()) {
            return Err(GltfError::Inconsistent {
                node: name.to_owned(),
                what: "its time codes do not ascend in single precision".to_owned(),
            });
        }
        Ok(times)
    }

    /// Accessor of key times; at least one.
    fn input(&mut self, times: Vec<f32>) -> usize {
        let bits: Vec<u32> = times.iter().map(|time| time.to_bits()).collect();
        if let Some(&accessor) = self.inputs.get(&bits) {
            return accessor;
        }
        let count = times.len();
        let (min, max) = (f64::from(times[0]), f64::from(times[count - 1]));
        let accessor = self.accessor(Array::Keys(times), document::FLOAT, "SCALAR", count);
        self.document.accessors[accessor].min = Some(vec![min]);
        self.document.accessors[accessor].max = Some(vec![max]);
        self.inputs.insert(bits, accessor);
        accessor
    }

    fn accessor(&mut self, array: Array<'a>, component_type: u32, kind: &'static str, count: usize) -> usize {
        let byte_length = array.bytes();
        self.document.buffer_views.push(document::BufferView {
            buffer: 0,
            byte_offset: self.bytes,
            byte_length,
            target: None,
        });
        self.bytes += byte_length;
        self.arrays.push(array);
        self.document.accessors.push(document::Accessor {
            buffer_view: self.document.buffer_views.len() - 1,
            component_type,
            normalized: false,
            count,
            r#type: kind,
            min: None,
            max: None,
        });
        self.document.accessors.len() - 1
    }

    fn finish(mut self, children: Vec<usize>) -> Result<Authored<'a>, GltfError> {
        let world = self.world(children);
        self.document.scenes = vec![document::Scene { nodes: vec![world] }];
        self.document.asset = document::Asset { version: "2.0", generator: GENERATOR.to_owned() };
        self.document.extensions_used = vec![EXTENSION];
        if self.document.nodes.iter().any(|node| !node.extensions.is_empty()) {
            self.document.extensions_used.extend([VISIBILITY, POINTER]);
        }
        self.document.buffers = vec![document::Buffer { uri: None, byte_length: self.bytes }];
        if !self.channels.is_empty() {
            self.document.animations = vec![document::Animation {
                name: "motion",
                channels: self.channels,
                samplers: self.samplers,
            }];
        }
        let finite = |values: &[f32; 4]| values.iter().all(|value| value.is_finite());
        for node in &self.document.nodes {
            let translation = node.translation.as_ref().is_none_or(document::Translation::is_finite);
            if !translation || !node.rotation.as_ref().is_none_or(finite) {
                return Err(GltfError::Inconsistent {
                    node: node.name.clone(),
                    what: "its pose is not finite".to_owned(),
                });
            }
        }
        Ok(Authored { document: self.document, arrays: self.arrays, bytes: self.bytes })
    }

    fn world(&mut self, children: Vec<usize>) -> usize {
        let graph = self.graph;
        let codes = &graph.time_codes;
        let placed = conventions::gltf_from_scene(graph.up_axis, graph.meters_per_unit, &graph.frame);
        let scale = placed.scale as f32;
        let cif = Cif::World(Box::new(extras::World {
            generator: GENERATOR.to_owned(),
            layout: extras::LAYOUT,
            up_axis: graph.up_axis,
            meters_per_unit: graph.meters_per_unit,
            frame: graph.frame,
            frames_per_second: codes.frames_per_second,
            first_time_code: self.first_time_code,
            time_codes: codes.samples.clone(),
            times: codes.times.clone(),
            background_color: graph.background_color,
            sort_metric: graph.sort_metric,
            antialiased: graph.antialiased,
            omitted: graph.omitted.clone(),
            warnings: graph.warnings.clone(),
            field_fingerprint: graph.origin.field_fingerprint.clone(),
            options: graph.origin.options.clone(),
        }));
        let rotation = conventions::world_rotation(graph.up_axis);
        self.push(document::Node {
            name: conventions::WORLD.to_owned(),
            children,
            translation: (placed.translation != DVec3::ZERO)
                .then_some(document::Translation::Double(placed.translation.to_array())),
            rotation: (rotation != [0.0, 0.0, 0.0, 1.0]).then_some(rotation),
            scale: (scale != 1.0).then_some([scale; 3]),
            extras: Some(Extras { cif }),
            ..document::Node::default()
        })
    }
}

/// Visibility of a node at first; nothing for one that is always visible.
fn visibility(samples: &[VisibilitySample]) -> BTreeMap<&'static str, Value> {
    samples.first().map(|first| (VISIBILITY, json!({ "visible": first.visible }))).into_iter().collect()
}

fn single(translation: DVec3) -> document::Translation {
    document::Translation::Single(translation.as_vec3().to_array())
}

/// The earliest time code of anything: it is at 0 seconds.
fn first_time_code(graph: &SceneGraph) -> f64 {
    let nodes = graph.nodes.iter().flat_map(|node| {
        let parts = match &node.motion {
            Motion::Parts(motion) => motion.parts.as_slice(),
            _ => &[],
        };
        let shape = match &node.motion {
            Motion::Dense(motion) => motion.samples.first().map(|sample| sample.time_code),
            _ => None,
        };
        let poses = node.track().first().into_iter().chain(parts.iter().filter_map(|p| p.track.first()));
        let visibility = node.visibility.first().map(|sample| sample.time_code);
        poses.map(|pose| pose.time_code).chain(visibility).chain(shape)
    });
    let cameras = graph.cameras.iter().filter_map(|track| track.samples.first()).map(|s| s.time_code);
    nodes.chain(cameras).fold(graph.time_codes.start(), f64::min)
}

fn object_extras(node: &Node) -> Cif {
    let object = extras::Object {
        name: node.name.clone(),
        label: node.label.clone(),
        category: node.category.clone(),
        taxonomies: node.taxonomies.clone(),
        embedding: node.embedding.clone(),
        pivot: node.pivot.to_array(),
        motion: node.report.clone(),
        source_frames: node.source_frames,
        mean_occupancy: node.mean_occupancy,
    };
    match node.kind {
        NodeKind::Instance { id, index } => Cif::Instance(Box::new(extras::Instance { id, index, object })),
        NodeKind::Background => Cif::Background(Box::new(object)),
    }
}

fn view(camera: &cif_geometry::PinholeCamera) -> extras::View {
    extras::View {
        width: camera.width,
        height: camera.height,
        focal_px: camera.focal_px.to_array(),
        principal_px: camera.principal_px.to_array(),
    }
}

/// Smallest and largest coordinates, exact in single precision.
fn corners(means: &[[f32; 3]]) -> (Vec<f64>, Vec<f64>) {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for mean in means {
        for axis in 0..3 {
            low[axis] = low[axis].min(mean[axis]);
            high[axis] = high[axis].max(mean[axis]);
        }
    }
    (low.map(f64::from).to_vec(), high.map(f64::from).to_vec())
}

/// Refuses arrays that do not fit together and values that no viewer can draw.
fn check_splats(node: &Node) -> Result<(), GltfError> {
    let splats = &node.splats;
    let wrong = |what: &str| Err(GltfError::Inconsistent { node: node.name.clone(), what: what.to_owned() });
    let n = splats.len();
    if splats.sh_degree > 3 {
        return wrong("spherical harmonics end at degree 3");
    }
    let lengths = [
        splats.orientations.len(),
        splats.scales.len(),
        splats.opacities.len(),
        splats.occupancies.len(),
        splats.identity_probabilities.len(),
        splats.rows.len(),
        if splats.identities.is_empty() { n } else { splats.identities.len() },
        splats.sh_coefficients.len() / (3 * coefficient_count(splats.sh_degree)),
    ];
    if lengths.iter().any(|&length| length != n) {
        return wrong("the arrays of its splats have different lengths");
    }
    let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
    if !finite(splats.means.as_flattened())
        || !finite(splats.orientations.as_flattened())
        || !finite(splats.scales.as_flattened())
        || !finite(&splats.opacities)
        || !finite(&splats.sh_coefficients)
    {
        return wrong("a splat has a value that is not finite");
    }
    if let Motion::Parts(motion) = &node.motion {
        let mut next = 0;
        for part in &motion.parts {
            if part.splats.start != next || part.splats.end < next {
                return wrong("its parts do not share out its splats in order");
            }
            next = part.splats.end;
        }
        if next != n {
            return wrong("its parts do not share out its splats in order");
        }
    }
    debug_assert_eq!(node.model() == MotionModel::Dense, matches!(node.motion, Motion::Dense(_)));
    Ok(())
}
