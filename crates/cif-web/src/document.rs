//! A scene as the page reads it: a JSON document, and arrays in a block of bytes next to it.
//!
//! Frames are those of scene graphs: world as captured, right-handed; cameras look along +z with x right and y down; the
//! centre of the first pixel is (0.5, 0.5); quaternions are (w, x, y, z). Times are time codes, which are frames as
//! captured.

use serde::Serialize;

/// Version of the document; the page refuses others.
pub const VERSION: u32 = 1;

/// A scene, with the images that it may be compared with.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Document {
    /// [`VERSION`].
    pub version: u32,
    /// Name of the file or folder that is shown.
    pub title: String,
    /// Unit vector that points up in the world.
    pub up: [f64; 3],
    /// Metres per world unit; `None` where that is not known.
    pub meters_per_unit: Option<f64>,
    /// Colour behind everything, display-referred RGB in [0, 1].
    pub background: [f32; 3],
    /// Order in which splats are blended: by `z` of the camera, or by `distance` to its centre.
    pub sort: &'static str,
    /// True when the opacity of splats is lowered by as much as the low-pass filter widens them.
    pub antialiased: bool,
    /// Splats nearer than this are not drawn, world units.
    pub near: f32,
    /// The times that are played.
    pub timeline: Timeline,
    /// Objects, and the background last.
    pub nodes: Vec<Node>,
    /// Recorded cameras.
    pub cameras: Vec<Camera>,
    /// Images of the capture, by camera and time.
    pub views: Vec<View>,
    /// Stage that edits are a layer over; `None` where none holds the nodes at their paths.
    pub stage: Option<String>,
    /// Length of the block of bytes.
    pub bytes: usize,
    /// True when the page shall ask how far the run is that the scene comes from.
    pub live: bool,
}

/// Times of a scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Timeline {
    /// First time code.
    pub start: f64,
    /// Last time code.
    pub end: f64,
    /// Time codes per second.
    pub per_second: f64,
    /// Time codes at which the scene was sampled, ascending.
    pub samples: Vec<f64>,
}

/// Kinds of nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// An object of the scene.
    Instance,
    /// Everything that belongs to no object.
    Background,
    /// Points of a capture that nothing was trained on yet.
    Points,
}

/// An object of the scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Node {
    /// Kind of node.
    pub kind: Kind,
    /// Mask value; `None` for what is no instance.
    pub id: Option<u16>,
    /// Unique name.
    pub name: String,
    /// Path of its prim in the stage that is shown, or in the one that `cif export` writes.
    pub path: String,
    /// Human name.
    pub label: String,
    /// Class.
    pub category: String,
    /// Colour in pictures of instances.
    pub color: [u8; 3],
    /// Motion model: `static`, `rigid`, `parts` or `dense`.
    pub motion: String,
    /// Evidence for its rotation, such as `observed`; `None` where it is not known.
    pub rotation: Option<String>,
    /// Opacity-weighted mean of the occupancies.
    pub mean_occupancy: f32,
    /// Smallest and largest corner of what can be seen of it at any time, local frame; the origin where nothing can.
    pub extent: [[f64; 3]; 2],
    /// `world_from_local`.
    pub track: Track,
    /// Rigid parts, whose ranges partition the splats; empty where the node has none.
    pub parts: Vec<Part>,
    /// Changes of visibility, each of which holds until the next; before the first one it counts. Empty: always visible.
    pub visibility: Vec<Visibility>,
    /// Its splats.
    pub splats: Splats,
    /// Splats that move in the local frame; `None` where they stay.
    pub deformation: Option<Deformation>,
    /// Opacities over time, `[samples, splats]`; `None` where they stay.
    pub opacities: Option<Samples>,
    /// Coefficients over time, `[samples, splats, (degree + 1)^2, 3]`; `None` where they stay.
    pub harmonics: Option<Samples>,
}

/// Poses over time: linear in translation, spherical in rotation between samples, held outside them.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Track {
    /// Ascending time codes, at least one.
    pub codes: Vec<f64>,
    /// Translation x, y, z and unit quaternion w, x, y, z at each of them.
    pub poses: Vec<[f64; 7]>,
}

/// A rigid part of a node.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Part {
    /// Name, unique in the node.
    pub name: String,
    /// First splat.
    pub first: usize,
    /// Number of splats.
    pub count: usize,
    /// `node_from_part`.
    pub track: Track,
    /// Its joint; `None` where it is free.
    pub joint: Option<Joint>,
}

/// A joint of a part.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Joint {
    /// `revolute` or `prismatic`.
    pub kind: String,
    /// Name of the part that it moves on.
    pub base: String,
    /// Unit direction of the axis, frame of the part.
    pub axis: [f64; 3],
    /// A point of the axis, frame of the part.
    pub anchor: [f64; 3],
    /// Smallest and largest value from the first pose on, radians or world units; `None` where it does not move.
    pub range: Option<[f64; 2]>,
}

/// A change of visibility.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Visibility {
    /// Time code.
    pub code: f64,
    /// True when the node can be seen from here on.
    pub visible: bool,
}

/// Splats of a node, in its local frame or in that of their part.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Splats {
    /// Number of splats.
    pub count: usize,
    /// Centres, `[count, 3]`.
    pub centres: Array,
    /// Unit quaternions (w, x, y, z), `[count, 4]`.
    pub orientations: Array,
    /// Standard deviations along the axes, `[count, 3]`.
    pub scales: Array,
    /// Opacities in [0, 1], `[count]`.
    pub opacities: Array,
    /// Degree of the spherical harmonics, 0 to 3.
    pub degree: u8,
    /// Coefficients of degree 0, `[count, 3]`: colour = 0.5 + 0.28209 c.
    pub base: Array,
    /// Coefficients of higher degrees, `[count, (degree + 1)^2 - 1, 3]`; `None` for degree 0.
    pub higher: Option<Array>,
}

/// Splats that move in the local frame: between samples centres and scales are linear, orientations linear and
/// normalised; held outside them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Deformation {
    /// Ascending time codes.
    pub codes: Vec<f64>,
    /// Centres less those of [`Splats::centres`], `[codes, count, 3]`.
    pub offsets: Array,
    /// Unit quaternions, `[codes, count, 4]`.
    pub orientations: Array,
    /// Standard deviations, `[codes, count, 3]`; `None` where they stay.
    pub scales: Option<Array>,
}

/// Values over time: linear between samples, held outside them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Samples {
    /// Ascending time codes.
    pub codes: Vec<f64>,
    /// Values of one sample after the other.
    pub values: Array,
}

/// Numbers in the block of bytes, little-endian, from a multiple of four on: `value = stored * scale`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Array {
    /// First byte.
    pub at: usize,
    /// Number of values.
    pub length: usize,
    /// How they are stored.
    pub kind: Kept,
    /// Factor.
    pub scale: f32,
}

/// Types of stored numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kept {
    /// Single precision.
    F32,
    /// The upper half of single precision: 8 bits of precision.
    Bf16,
    /// Signed 16-bit integers.
    I16,
    /// Signed 8-bit integers.
    I8,
}

/// A recorded camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Camera {
    /// Name.
    pub name: String,
    /// Ascending time codes, at least one.
    pub samples: Vec<Shot>,
}

/// A pinhole camera at a time code.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Shot {
    /// Time code.
    pub code: f64,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels.
    pub principal: [f64; 2],
    /// `world_from_camera`: centre x, y, z and unit quaternion w, x, y, z.
    pub pose: [f64; 7],
}

/// An image of the capture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct View {
    /// Unique name.
    pub name: String,
    /// Name of its camera.
    pub camera: String,
    /// `train` or `val`.
    pub split: &'static str,
    /// The camera, and when.
    #[serde(flatten)]
    pub shot: Shot,
    /// Address of the image, relative to the page.
    pub image: String,
    /// Address of its mask as a picture, relative to the page; clear where nothing is labelled. `None` without a mask.
    pub mask: Option<String>,
}
