//! Names that are written into stages.

/// Oldest USD that stages are written and read with, (year, month).
pub const MINIMUM_USD: (u32, u32) = (25, 11);
/// Oldest USD with a schema of Gaussian splats; `import cif` adds one to those before, in which files are the same.
pub const SPLATS_USD: (u32, u32) = (26, 3);

/// Key in `customLayerData` under which everything of ours stands; marks a layer as ours.
pub const CIF: &str = "cif";
/// Program that wrote a layer, in `customLayerData`.
pub const GENERATOR: &str = "generator";
/// Version of the layout, in `customLayerData`.
pub const LAYOUT: &str = "layout";
/// Version of the layout described in the crate documentation.
pub const LAYOUT_VERSION: i32 = 2;
/// Role of a layer, in `customLayerData`: [`ROLE_ROOT`] or [`ROLE_PAYLOAD`].
pub const ROLE: &str = "role";
/// A layer that is opened.
pub const ROLE_ROOT: &str = "root";
/// A layer that holds the arrays of one instance.
pub const ROLE_PAYLOAD: &str = "payload";
/// Normalised times of the sampled time codes, in `customLayerData`.
pub const SAMPLE_TIMES: &str = "sampleTimes";
/// The sampled time codes, in `customLayerData`.
pub const SAMPLE_CODES: &str = "sampleCodes";
/// Colour behind everything, in `customLayerData`.
pub const BACKGROUND_COLOR: &str = "backgroundColor";
/// Labels of instances without a prim, in `customLayerData`.
pub const OMITTED: &str = "omitted";
/// Origin of the scene in the world of its capture as exported, in `customLayerData`; the prim [`WORLD`] is there.
pub const CAPTURE_OFFSET: &str = "captureOffset";
/// Units of the scene per unit of the capture, in `customLayerData`.
pub const CAPTURE_SCALE: &str = "captureScale";
/// Warnings of the export, in `customLayerData`.
pub const WARNINGS: &str = "warnings";
/// Number of windows of time, where the splats change from window to window.
pub const WINDOWS: &str = "windows";
/// Fingerprint of the exported field, in `customLayerData`.
pub const FIELD_FINGERPRINT: &str = "fieldFingerprint";
/// Options of the export as JSON, in `customLayerData`.
pub const OPTIONS: &str = "options";
/// Order in which the splats were blended, in `customLayerData`.
pub const SORT: &str = "sort";

/// True when the splats are drawn antialiased, in `customLayerData`; left out where that is not known.
pub const ANTIALIASED: &str = "antialiased";

/// Default prim.
pub const WORLD: &str = "/World";
/// Scope of the cameras.
pub const CAMERAS: &str = "/World/Cameras";
/// Gravity.
pub const PHYSICS_SCENE: &str = "/World/PhysicsScene";
/// Plane that simulators let things fall on.
pub const GROUND: &str = "/World/Ground";
/// Ending of the name of the splat prim of a node or part, after the name of the node, so that importers that name
/// what they make by the prim alone keep objects apart. Files of before have `Splats`: readers go by the type.
pub const SPLATS: &str = "splats";
/// Point proxy of a node or part.
pub const PROXY: &str = "Proxy";
/// The points below their proxy.
pub const PROXY_POINTS: &str = "Prototypes/Points";
/// Beginning of the name of the joint of a part.
pub const JOINT: &str = "Joint";
/// A part that turns about an axis of another.
pub const REVOLUTE_JOINT: &str = "PhysicsRevoluteJoint";
/// A part that slides along an axis of another.
pub const PRISMATIC_JOINT: &str = "PhysicsPrismaticJoint";
/// Joint that fixes a body to the world.
pub const HOLD: &str = "Hold";
/// Joint without freedom.
pub const FIXED_JOINT: &str = "PhysicsFixedJoint";
/// Convex hull of a node or part; further ones are numbered.
pub const COLLIDER: &str = "Collider";
/// Ending of the folder of payloads: `out.usda` has `out.payloads`, `out.usdc` has `out.usdc.payloads`.
pub const PAYLOADS: &str = "payloads";
/// Layer among the payloads that names what changes from window to window; the name of no node, as those of instances end
/// in a number.
pub const MANIFEST: &str = "windows.usdc";
/// Prim of a payload that every level of detail shares.
pub const COMMON: &str = "/Common";

/// Splats.
pub const GAUSSIAN_SPLAT: &str = "ParticleField3DGaussianSplat";

/// Model kind of the root.
pub const KIND_ASSEMBLY: &str = "assembly";
/// Model kind of a node.
pub const KIND_COMPONENT: &str = "component";

/// Schema of what no standard schema holds about an instance.
pub const INSTANCE_API: &str = "CifInstanceAPI";
/// Schema of [`EXTENTS_HINT`].
pub const GEOM_MODEL_API: &str = "GeomModelAPI";
/// Box of a model, for those who do not look at what is inside: `[low, high]`, local frame.
pub const EXTENTS_HINT: &str = "extentsHint";
/// Semantic labels in a taxonomy.
pub const LABELS_API: &str = "SemanticsLabelsAPI";
/// Properties of semantic labels, before the taxonomy.
pub const LABELS: &str = "semantics:labels";
/// Properties of labels by the `SemanticsAPI` of earlier tools, before the name of the label.
pub const OLDER_LABELS: &str = "semantic";
/// Ends of the properties of [`OLDER_LABELS`] that hold a label.
pub const OLDER_LABEL: [&str; 2] = [":params:semanticData", ":params:semanticLabel"];
/// End of the property of [`OLDER_LABELS`] that holds its taxonomy.
pub const OLDER_TAXONOMY: &str = ":params:semanticType";
/// Taxonomy of category and human label.
pub const TAXONOMY_CLASS: &str = "class";
/// Taxonomy of the unique instance name.
pub const TAXONOMY_INSTANCE: &str = "instance";
/// Human label, as a property that importers without semantics keep.
pub const USER_LABEL: &str = "userProperties:label";
/// Width of the captured pictures, pixels; property of cameras.
pub const IMAGE_WIDTH: &str = "userProperties:imageWidth";
/// Height of the captured pictures, pixels; property of cameras.
pub const IMAGE_HEIGHT: &str = "userProperties:imageHeight";
/// Time codes at which a camera was recorded.
pub const CAMERA_CODES: &str = "cif:timeCodes";
/// Position of a part among those of its instance.
pub const PART_INDEX: &str = "cif:partIndex";
/// Appearance of an instance: a vector of length 1.
pub const EMBEDDING: &str = "cif:embedding";
/// Model that made it.
pub const EMBEDDING_MODEL: &str = "cif:embedding:model";
/// Origin of a part's frame at the reference time, in the frame of its instance.
pub const PART_PIVOT: &str = "cif:partPivot";

/// Properties of [`INSTANCE_API`].
pub mod instance {
    /// `instance` or `background`.
    pub const KIND: &str = "cif:kind";
    /// Mask value.
    pub const ID: &str = "cif:id";
    /// Position in the table of instances.
    pub const INDEX: &str = "cif:index";
    /// Label when exported.
    pub const LABEL: &str = "cif:label";
    /// Class when exported.
    pub const CATEGORY: &str = "cif:category";
    /// Origin of the local frame at the reference time, world.
    pub const PIVOT: &str = "cif:pivot";
    /// First and last captured frame.
    pub const SOURCE_FRAMES: &str = "cif:sourceFrames";
    /// Opacity-weighted mean occupancy.
    pub const MEAN_OCCUPANCY: &str = "cif:meanOccupancy";
    /// Chosen motion model.
    pub const MODEL: &str = "cif:motion:model";
    /// Evidence for the rotations of a rigid instance: `observed` or `assumed`.
    pub const ROTATION: &str = "cif:motion:rotation";
    /// Largest residual allowed.
    pub const TOLERANCE: &str = "cif:motion:tolerance";
    /// Size of the instance.
    pub const SIZE: &str = "cif:motion:size";
    /// Root of the mean squared residual.
    pub const RESIDUAL_RMS: &str = "cif:motion:residualRms";
    /// Residual that was held against the tolerance.
    pub const RESIDUAL_DECISIVE: &str = "cif:motion:residualDecisive";
    /// Largest residual.
    pub const RESIDUAL_MAX: &str = "cif:motion:residualMax";
    /// Share of the weight above the tolerance.
    pub const OUTLIER_SHARE: &str = "cif:motion:outlierShare";
    /// Number of time samples.
    pub const SAMPLES: &str = "cif:motion:samples";
    /// The whole motion report as JSON.
    pub const REPORT: &str = "cif:motion:report";

    /// Every property with its type.
    pub const ALL: [(&str, &str); 18] = [
        (KIND, "token"),
        (ID, "int"),
        (INDEX, "int"),
        (LABEL, "string"),
        (CATEGORY, "string"),
        (PIVOT, "double3"),
        (SOURCE_FRAMES, "int2"),
        (MEAN_OCCUPANCY, "float"),
        (MODEL, "token"),
        (ROTATION, "token"),
        (TOLERANCE, "double"),
        (SIZE, "double"),
        (RESIDUAL_RMS, "double"),
        (RESIDUAL_DECISIVE, "double"),
        (RESIDUAL_MAX, "double"),
        (OUTLIER_SHARE, "double"),
        (SAMPLES, "int"),
        (REPORT, "string"),
    ];

    /// Value of [`KIND`] of an instance.
    pub const KIND_INSTANCE: &str = "instance";
    /// Value of [`KIND`] of the background.
    pub const KIND_BACKGROUND: &str = "background";
}

/// Variant sets of an instance.
pub mod variants {
    /// Variant set for simulators: no body, a kinematic or a dynamic one.
    pub const PHYSICS: &str = "physics";
    /// No body: only the colliders, at rest.
    pub const NONE: &str = "none";
    /// A body on its recorded track.
    pub const KINEMATIC: &str = "kinematic";
    /// A body that starts at the initial pose with the initial velocity.
    pub const DYNAMIC: &str = "dynamic";
    /// Variant set of the levels of detail.
    pub const LOD: &str = "lod";
    /// All splats.
    pub const FULL: &str = "full";
    /// The more important half.
    pub const HALF: &str = "half";
    /// The most important quarter.
    pub const QUARTER: &str = "quarter";
}

/// Spherical-harmonics coefficients.
pub const SH_COEFFICIENTS: &str = "radiance:sphericalHarmonicsCoefficients";
/// Spherical-harmonics degree.
pub const SH_DEGREE: &str = "radiance:sphericalHarmonicsDegree";
/// Interpolation with one value per splat.
pub const VERTEX: &str = "vertex";
/// Interpolation with one value per corner of a face.
pub const FACE_VARYING: &str = "faceVarying";
/// Purpose of the point proxies.
pub const PURPOSE_PROXY: &str = "proxy";
/// Purpose of the colliders.
pub const PURPOSE_GUIDE: &str = "guide";
/// Projection that the splats were trained with.
pub const PERSPECTIVE: &str = "perspective";
/// Sorting by camera-space depth.
pub const SORT_Z_DEPTH: &str = "zDepth";
/// Sorting by distance to the camera centre.
pub const SORT_CAMERA_DISTANCE: &str = "cameraDistance";
/// View-independent colours.
pub const DISPLAY_COLOR: &str = "primvars:displayColor";
/// Primvar of occupancies.
pub const PRIMVAR_OCCUPANCY: &str = "primvars:cif:occupancy";
/// Primvar of the probability of the instance.
pub const PRIMVAR_IDENTITY: &str = "primvars:cif:identity";
/// Primvar of the instances that every splat may belong to, as ids, most probable first; 0 for an unused place.
/// `elementSize` of them per splat.
pub const PRIMVAR_INSTANCE_IDS: &str = "primvars:cif:instanceIds";
/// Primvar next to [`PRIMVAR_INSTANCE_IDS`]: probability of each instance times the share of the splat's image that
/// was labelled. The remainder to 1 was seen outside of every mask.
pub const PRIMVAR_INSTANCE_SHARES: &str = "primvars:cif:instanceShares";
/// Primvar of the row of every splat in the field.
pub const PRIMVAR_ROW: &str = "primvars:cif:row";
/// Primvar of the splat that a proxy point sits on, counted over the node.
pub const PRIMVAR_SPLAT: &str = "primvars:cif:splat";
/// Checksum of the display colours as written, by which a recolouring is recognised.
pub const COLOR_CHECKSUM: &str = "cif:displayColorChecksum";

/// Value of `visibility` where a prim can be seen.
pub const INHERITED: &str = "inherited";
/// Value of `visibility` where it cannot.
pub const INVISIBLE: &str = "invisible";
