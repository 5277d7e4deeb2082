//! Data that all stages share with Rust: the view, splats, work counts, and the constants of WGSL.

use cif_field::SortMetric;
use cif_field::gaussians::SH_FLOATS;
use cif_geometry::spherical_harmonics::{BAND_0, BAND_1, BAND_2, BAND_3};
use cif_geometry::{PinholeCamera, quaternion};

use super::gaussians::PACKED_SH_WORDS;
use super::kernel::{Constant, MAX_WORKGROUPS, Snippet, constants, structures};
use super::layout::Shared;
use crate::constants::{
    JACOBIAN_MARGIN, LOG_SCALE_RANGE, MAX_ALPHA, MAX_COVARIANCE, MAX_POSITION_GRADIENT, MIN_ALPHA,
    MIN_ANTIALIASING, MIN_COVERAGE, MIN_LABEL_PROBABILITY, MIN_TRANSMITTANCE, TILE,
};
use crate::{GeometryPath, InstanceNormalisation, OccupancySource, RenderSettings};

/// Elements that a workgroup of the prefix sum takes.
pub(crate) const SCAN_BLOCK: usize = 1024;
/// Elements that a workgroup of the radix sort takes.
pub(crate) const SORT_BLOCK: usize = 2048;
/// Numbers kept per (tile, splat) pair by the backward pass.
pub(crate) const PAIR_SUMS: usize = 12;
/// Those of them that gradients take.
const GRADIENT_SUMS: usize = 10;
/// Channels of values that a dispatch blends.
pub(super) const BLEND_CHANNELS: usize = 4;
/// Depth key of what is not visible.
const NOT_VISIBLE: u32 = u32::MAX;
/// Bits of the passes that draw something.
pub const COLOR_PASS: u32 = 1;
/// As above.
pub const INSTANCE_PASS: u32 = 2;
/// "The count comes with the parameters, not from the work counts."
pub(crate) const NONE: u32 = u32::MAX;

pub(super) const OCCUPANCY_NONE: u32 = 0;
const OCCUPANCY_OWN: u32 = 1;
const OCCUPANCY_OPACITY: u32 = 2;

/// Elements of the work counts, which kernels fill and indirect dispatches read.
pub(crate) mod work {
    /// Gaussians that draw something.
    pub(crate) const VISIBLE: usize = 0;
    /// Pairs that there are, at most 2^32 - 1.
    pub(crate) const WANTED_PAIRS: usize = 1;
    /// Label slots that there are, likewise.
    pub(crate) const WANTED_SLOTS: usize = 2;
    /// Pairs that are drawn: all, or none when they do not fit.
    pub(crate) const PAIRS: usize = 3;
    /// Digit counts of the sort of pairs.
    pub(crate) const DIGITS: usize = 4;
    /// Workgroups, three numbers each.
    pub(crate) const BY_PAIR: usize = 8;
    pub(crate) const BY_SORT_BLOCK: usize = 12;
    pub(crate) const BY_DIGIT_BLOCK: usize = 16;
    pub(crate) const BY_RANK: usize = 20;
    /// Length of the array.
    pub(crate) const LEN: usize = 24;
}

crate::shared_struct! {
    /// A camera, the settings of a render and the sizes of what it works on.
    pub struct View {
        /// Rows of R_v, and t_v in the last column.
        pub rotation: [[f32; 4]; 3],
        /// Camera centre, world, metres.
        pub centre: [f32; 4],
        /// Colour behind everything.
        pub background: [f32; 4],
        /// Focal lengths, pixels.
        pub focal: [f32; 2],
        /// Principal point, pixels.
        pub principal: [f32; 2],
        /// Limits of x / z and y / z inside the Jacobian.
        pub ratio_low: [f32; 2],
        /// As above.
        pub ratio_high: [f32; 2],
        /// Width and height, pixels.
        pub size: [u32; 2],
        /// Columns and rows of the tiles that are drawn.
        pub tiles: [u32; 2],
        /// Near plane, metres.
        pub near: f32,
        /// Gaussians N.
        pub gaussians: u32,
        /// Instances K.
        pub instances: u32,
        /// Active spherical-harmonics degree.
        pub sh_degree: u32,
        /// 1 with the antialiasing factor.
        pub antialiased: u32,
        /// 1 to sort by distance, 0 by z.
        pub sort_by_distance: u32,
        /// Where the weight of the instance pass comes from: none, own, opacity.
        pub occupancy: u32,
        /// 1 when pixels carry labels.
        pub label_pixels: u32,
        /// 1 when the instance loss is differentiated, so that pairs have label slots.
        pub label_slots: u32,
        /// 1 under coverage normalisation.
        pub coverage_normalised: u32,
        /// Pairs and label slots that fit.
        pub pair_capacity: u32,
        /// As above.
        pub slot_capacity: u32,
        /// Loss weight of a labelled pixel.
        pub pixel_weight: f32,
        /// Share of the instance gradient that reaches scales and rotations: 0 or 1.
        pub full_geometry: f32,
        /// Share that reaches means.
        pub mean_geometry: f32,
        /// First row of tiles that is drawn; rows of tiles and of pixels that come out are counted from there.
        pub first_row: u32,
        /// Dilation added to both diagonal entries of a projected covariance, px^2.
        pub low_pass: f32,
        /// Pads to 8 bytes.
        pub unused: u32,
        /// Pads to 16 bytes.
        pub unused_pair: [u32; 2],
    }
}

crate::shared_struct! {
    /// A Gaussian as a view sees it; radius 0 where it draws nothing.
    pub struct Splat {
        /// Projected centre, pixels.
        pub mean: [f32; 2],
        /// Half-widths of the drawn ellipse, pixels.
        pub extent: [f32; 2],
        /// L00, L01, L11 of the conic `L^T L`, px^-1, and opacity after antialiasing.
        pub factor: [f32; 4],
        /// Blended colour, and occupancy (or opacity when instances blend with it).
        pub color: [f32; 4],
        /// Largest sigma that the colour and the instance pass draw.
        pub reach: [f32; 2],
        /// Camera z, metres.
        pub depth: f32,
        /// 3 standard deviations of the larger axis, pixels.
        pub radius: f32,
    }
}

crate::shared_struct! {
    /// Parameters of a prefix sum.
    pub struct ScanParameters {
        /// Elements, unless the work counts say it.
        pub count: u32,
        /// Element of the work counts that says how many.
        pub work_element: u32,
        /// Pads to 16 bytes.
        pub unused: [u32; 2],
    }
}

crate::shared_struct! {
    /// Parameters of a pass of a radix sort.
    pub struct SortParameters {
        /// Elements, unless the work counts say it.
        pub count: u32,
        /// Element of the work counts that says how many.
        pub work_element: u32,
        /// First of the four bits.
        pub shift: u32,
        /// 1 where counts are prefix sums, 0 where they are counts.
        pub is_summed: u32,
    }
}

impl View {
    /// A camera with settings, for N Gaussians; without labels, gradients and room for pairs.
    #[must_use]
    pub fn new(camera: &PinholeCamera, settings: &RenderSettings, gaussians: usize) -> Self {
        let pose = &camera.camera_from_world;
        let translation = pose.translation.as_vec3();
        let rotation = [0, 1, 2].map(|row| {
            let r = pose.rotation.row(row).as_vec3();
            [r.x, r.y, r.z, translation[row]]
        });
        let centre = camera.centre().as_vec3();
        let focal = camera.focal_px.as_vec2().to_array();
        let principal = camera.principal_px.as_vec2().to_array();
        let size = [camera.width as f32, camera.height as f32];
        let margin = [0, 1].map(|axis| JACOBIAN_MARGIN * 0.5 * size[axis] / focal[axis]);
        let [red, green, blue] = settings.background;
        let geometry = settings.instances.unwrap_or_default().geometry;
        let normalisation = settings.instances.unwrap_or_default().normalisation;
        Self {
            rotation,
            centre: [centre.x, centre.y, centre.z, 0.0],
            background: [red, green, blue, 0.0],
            focal,
            principal,
            ratio_low: [0, 1].map(|axis| -(principal[axis] / focal[axis] + margin[axis])),
            ratio_high: [0, 1].map(|axis| (size[axis] - principal[axis]) / focal[axis] + margin[axis]),
            size: [camera.width, camera.height],
            tiles: [camera.width.div_ceil(TILE), camera.height.div_ceil(TILE)],
            near: settings.near,
            low_pass: settings.low_pass,
            gaussians: gaussians as u32,
            sh_degree: u32::from(settings.sh_degree),
            antialiased: u32::from(settings.antialiased),
            sort_by_distance: u32::from(settings.sort_metric == SortMetric::Distance),
            occupancy: match settings.instances.map(|instances| instances.occupancy) {
                None => OCCUPANCY_NONE,
                Some(OccupancySource::Own) => OCCUPANCY_OWN,
                Some(OccupancySource::Opacity) => OCCUPANCY_OPACITY,
            },
            coverage_normalised: u32::from(normalisation == InstanceNormalisation::Coverage),
            full_geometry: f32::from(u8::from(geometry == GeometryPath::Full)),
            mean_geometry: f32::from(u8::from(geometry != GeometryPath::Off)),
            ..Self::default()
        }
    }

    /// Rows of pixels that are drawn.
    #[must_use]
    pub fn rows(&self) -> u32 {
        (self.tiles[1] * TILE).min(self.size[1] - self.first_row * TILE)
    }

    /// Pixels that are drawn.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.size[0] as usize * self.rows() as usize
    }

    /// Tiles that are drawn.
    #[must_use]
    pub fn tile_count(&self) -> usize {
        self.tiles[0] as usize * self.tiles[1] as usize
    }
}

/// Every constant that WGSL reads.
fn shared_constants() -> String {
    use Constant::{Float, Unsigned};
    let single = |value: f64| Float(value as f32);
    let mut named = vec![
        ("MIN_ALPHA", Float(MIN_ALPHA)),
        ("MAX_ALPHA", Float(MAX_ALPHA)),
        ("MIN_TRANSMITTANCE", Float(MIN_TRANSMITTANCE)),
        ("MIN_ANTIALIASING", Float(MIN_ANTIALIASING)),
        ("LOG_SCALE_LOW", Float(LOG_SCALE_RANGE.0)),
        ("LOG_SCALE_HIGH", Float(LOG_SCALE_RANGE.1)),
        ("MAX_COVARIANCE", Float(MAX_COVARIANCE)),
        ("MIN_LABEL_PROBABILITY", Float(MIN_LABEL_PROBABILITY)),
        ("MIN_COVERAGE", Float(MIN_COVERAGE)),
        ("MAX_POSITION_GRADIENT", Float(MAX_POSITION_GRADIENT)),
        ("MIN_QUATERNION_NORM", single(quaternion::MIN_NORM)),
        ("TILE", Unsigned(TILE)),
        ("HALF_TILE", Unsigned(TILE / 2)),
        ("SH_FLOATS", Unsigned(SH_FLOATS as u32)),
        ("PACKED_SH_WORDS", Unsigned(PACKED_SH_WORDS as u32)),
        ("MAX_WORKGROUPS", Unsigned(MAX_WORKGROUPS)),
        ("SCAN_BLOCK", Unsigned(SCAN_BLOCK as u32)),
        ("SORT_BLOCK", Unsigned(SORT_BLOCK as u32)),
        ("PAIR_SUMS", Unsigned(PAIR_SUMS as u32)),
        ("GRADIENT_SUMS", Unsigned(GRADIENT_SUMS as u32)),
        ("BLEND_CHANNELS", Unsigned(BLEND_CHANNELS as u32)),
        ("COLOR_PASS", Unsigned(COLOR_PASS)),
        ("INSTANCE_PASS", Unsigned(INSTANCE_PASS)),
        ("NOT_VISIBLE", Unsigned(NOT_VISIBLE)),
        ("NONE", Unsigned(NONE)),
        ("OCCUPANCY_OWN", Unsigned(OCCUPANCY_OWN)),
        ("OCCUPANCY_OPACITY", Unsigned(OCCUPANCY_OPACITY)),
        ("BAND_0", single(BAND_0)),
        ("BAND_1", single(BAND_1)),
    ];
    for (name, value) in [
        ("WORK_VISIBLE", work::VISIBLE),
        ("WORK_WANTED_PAIRS", work::WANTED_PAIRS),
        ("WORK_WANTED_SLOTS", work::WANTED_SLOTS),
        ("WORK_PAIRS", work::PAIRS),
        ("WORK_DIGITS", work::DIGITS),
        ("WORK_BY_PAIR", work::BY_PAIR),
        ("WORK_BY_SORT_BLOCK", work::BY_SORT_BLOCK),
        ("WORK_BY_DIGIT_BLOCK", work::BY_DIGIT_BLOCK),
        ("WORK_BY_RANK", work::BY_RANK),
    ] {
        named.push((name, Unsigned(value as u32)));
    }
    let bands_2 = ["BAND_2_0", "BAND_2_1", "BAND_2_2", "BAND_2_3", "BAND_2_4"];
    let bands_3 = ["BAND_3_0", "BAND_3_1", "BAND_3_2", "BAND_3_3", "BAND_3_4", "BAND_3_5", "BAND_3_6"];
    named.extend(bands_2.into_iter().zip(BAND_2.map(single)));
    named.extend(bands_3.into_iter().zip(BAND_3.map(single)));
    constants(&named)
}

/// Constants.
pub const CONSTANTS: Snippet = Snippet { name: "constants", text: shared_constants };
/// [`View`] and [`Splat`].
pub const VIEW: Snippet = Snippet { name: "view", text: || structures(&[View::layout(), Splat::layout()]) };
/// Finite numbers, the logistic function, items of folded dispatches.
pub const NUMBERS: Snippet =
    Snippet { name: "numbers", text: || include_str!("shared/numbers.wgsl").to_owned() };
/// Spherical harmonics.
pub const HARMONICS: Snippet =
    Snippet { name: "harmonics", text: || include_str!("shared/harmonics.wgsl").to_owned() };
/// WGSL function by which projection reads spherical harmonics, from 32-bit floats.
pub(crate) const COEFFICIENTS: Snippet =
    Snippet { name: "coefficients", text: || include_str!("shared/coefficients.wgsl").to_owned() };
/// As above, from 16-bit floats.
pub(crate) const PACKED_COEFFICIENTS: Snippet =
    Snippet { name: "coefficients", text: || include_str!("shared/packed_coefficients.wgsl").to_owned() };
/// WGSL functions by which projection turns directions of view into the frame of harmonics: nowhere.
pub(crate) const DIRECTIONS: Snippet =
    Snippet { name: "directions", text: || include_str!("shared/directions.wgsl").to_owned() };
/// As above, into the frames of groups.
pub(crate) const TURNED_DIRECTIONS: Snippet =
    Snippet { name: "directions", text: || include_str!("shared/turned_directions.wgsl").to_owned() };
/// The same with the turns that they read.
pub(crate) const TURNS: Snippet = Snippet {
    name: "directions",
    text: || {
        let turned = (TURNED_DIRECTIONS.text)();
        format!("@group(0) @binding(6) var<storage, read> turns: array<vec4f>;\n{turned}")
    },
};
/// Gradients of splats as the backward projection reads them.
pub(crate) const SPLAT_GRADIENTS: Snippet =
    Snippet { name: "splat_gradients", text: || include_str!("shared/splat_gradients.wgsl").to_owned() };
/// As above, with gradients by turns kept in them.
pub(crate) const TORQUES: Snippet =
    Snippet { name: "splat_gradients", text: || include_str!("shared/torques.wgsl").to_owned() };
pub(crate) const FOOTPRINT: Snippet =
    Snippet { name: "footprint", text: || include_str!("shared/footprint.wgsl").to_owned() };
pub(crate) const SPLAT: Snippet =
    Snippet { name: "splat", text: || include_str!("shared/splat.wgsl").to_owned() };
pub(crate) const TILES: Snippet =
    Snippet { name: "tiles", text: || include_str!("shared/tiles.wgsl").to_owned() };
pub(crate) const TILE_STAGING: Snippet =
    Snippet { name: "tile_staging", text: || include_str!("shared/tile_staging.wgsl").to_owned() };
pub(crate) const BATCH_SUMS: Snippet =
    Snippet { name: "batch_sums", text: || include_str!("shared/batch_sums.wgsl").to_owned() };
pub(crate) const IDENTITY: Snippet =
    Snippet { name: "identity", text: || include_str!("shared/identity.wgsl").to_owned() };
/// Declares that the instance pass is drawn, or is not: what a kernel does not do costs nothing then.
pub(crate) const WITH_INSTANCES: Snippet =
    Snippet { name: "variant", text: || "const WITH_INSTANCES: bool = true;\n".to_owned() };
/// As above.
pub(crate) const COLOR_ONLY: Snippet =
    Snippet { name: "variant", text: || "const WITH_INSTANCES: bool = false;\n".to_owned() };
pub(crate) const SCAN_PARAMETERS: Snippet =
    Snippet { name: "scan_parameters", text: || structures(&[ScanParameters::layout()]) };
pub(crate) const SORT_PARAMETERS: Snippet =
    Snippet { name: "sort_parameters", text: || structures(&[SortParameters::layout()]) };
