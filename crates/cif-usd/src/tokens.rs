//! Names that are written into stages.

/// Oldest usd-core that knows Gaussian splats, (year, month).
pub const MINIMUM_USD: (u32, u32) = (26, 3);

/// Key in `customLayerData` and `customData` under which everything of ours stands; marks a layer as ours.
pub const CIF: &str = "cif";
/// Version of the layout described in the crate documentation.
pub const LAYOUT_VERSION: i32 = 1;
/// Normalised times of the sampled time codes, in `customLayerData`.
pub const SAMPLE_TIMES: &str = "sampleTimes";
/// The sampled time codes, in `customLayerData`.
pub const SAMPLE_CODES: &str = "sampleCodes";

/// Default prim.
pub const WORLD: &str = "/World";
/// Scope of the cameras.
pub const CAMERAS: &str = "/World/Cameras";
/// Splat prim of a node.
pub const SPLATS: &str = "Splats";
/// Point proxy of a node.
pub const PROXY: &str = "Proxy";

/// Model kind of the root.
pub const KIND_ASSEMBLY: &str = "assembly";
/// Model kind of a node.
pub const KIND_COMPONENT: &str = "component";

/// Taxonomy of category and human label.
pub const TAXONOMY_CLASS: &str = "class";
/// Taxonomy of the unique instance name.
pub const TAXONOMY_INSTANCE: &str = "instance";
/// Human label, as a property that importers without semantics keep.
pub const USER_LABEL: &str = "userProperties:label";

/// Spherical-harmonics coefficients.
pub const SH_COEFFICIENTS: &str = "radiance:sphericalHarmonicsCoefficients";
/// Interpolation with one value per splat.
pub const VERTEX: &str = "vertex";
/// Purpose of the point proxies.
pub const PURPOSE_PROXY: &str = "proxy";
/// Projection that the splats were trained with.
pub const PERSPECTIVE: &str = "perspective";
/// Sorting by camera-space depth.
pub const SORT_Z_DEPTH: &str = "zDepth";
/// Sorting by distance to the camera centre.
pub const SORT_CAMERA_DISTANCE: &str = "cameraDistance";
/// Primvar of occupancies.
pub const PRIMVAR_OCCUPANCY: &str = "cif:occupancy";
/// Primvar of the probability of the instance.
pub const PRIMVAR_IDENTITY: &str = "cif:identity";
