//! The WGSL files of training: their imports and entry points, and what they share with Rust.

use cif_field::gaussians::SH_FLOATS;
use cif_field::parameters::{OCCUPANCY_LOGITS, PLANES, Parameter, QUATERNIONS, TABLE};
use cif_geometry::quaternion::MIN_NORM;
use cif_render::constants::{MIN_LABEL_PROBABILITY, TILE};
use cif_render::wgpu::deform::FIXED_POINT;
use cif_render::wgpu::faults::FAULTS;
use cif_render::wgpu::gaussians::{GEOMETRY_FLOATS, geometry_column};
use cif_render::wgpu::poses::{GROUPS, QUATERNIONS as QUATERNION_PRODUCTS};
use cif_render::wgpu::view::INSTANCE_PASS;
use cif_render::wgpu::{
    Constant, Gpu, GpuError, GpuStatistics, Kernel, Layout, MAX_WORKGROUPS, Module, Shared, Snippet,
    constants, structures,
};

pub use cif_render::wgpu::faults as fault;

use crate::adam::{BETA_1, BETA_2, EPSILON};
use crate::exposure::WIDTH as EXPOSURE_FLOATS;
use crate::losses::displacement::{FREE, NO_ROTATION};
use crate::losses::held_out;
use crate::losses::ssim::{C1, C2};
use crate::poses;

cif_render::shared_struct! {
    /// Parameters of the loss kernels for a view.
    pub struct LossSettings {
        /// Pixels of the view.
        pub pixels: u32,
        /// Pixels of a row.
        pub width: u32,
        /// Where the results go.
        pub slot: u32,
        /// 1 when the view was drawn with labels.
        pub with_instances: u32,
        /// 1 under coverage normalisation.
        pub by_coverage: u32,
        /// Gradient of an absolute difference.
        pub absolute_weight: f32,
        /// Gradient of a pixel's similarity.
        pub similarity_weight: f32,
        /// 1 when pixels of some labels train nothing, 2 when the pixels that are judged by train nothing.
        pub leaves_out: u32,
        /// Rows of pixels.
        pub height: u32,
        /// Pads to 16 bytes.
        pub unused: u32,
        /// As above.
        pub unused_too: [u32; 2],
        /// Taps of the window of the similarity, from the centre outwards.
        pub window: [[f32; 4]; 2],
    }
}

cif_render::shared_struct! {
    /// Parameters of the optimiser's step of the Gaussians.
    pub struct GaussianRates {
        /// Rates of the geometry with the correction of the first moment; 0 keeps still.
        pub geometry: [[f32; 4]; 3],
        /// Correction of the second moment.
        pub geometry_second: [[f32; 4]; 3],
        /// Gaussians N.
        pub gaussians: u32,
        /// 1 when only visible rows move.
        pub visible_only: u32,
        /// 1 when raw quaternions become unit ones.
        pub renormalise: u32,
        /// Coefficients that move.
        pub sh_active: u32,
        /// Rate of the first three coefficients, corrected.
        pub sh_base: f32,
        /// Rate of the others, corrected.
        pub sh_rest: f32,
        /// Correction of the second moment of the coefficients.
        pub sh_second: f32,
        /// Limits of the occupancy logit.
        pub lowest_occupancy: f32,
        /// As above.
        pub highest_occupancy: f32,
        /// Pads to 16 bytes.
        pub unused: u32,
        /// As above.
        pub unused_too: [u32; 2],
    }
}

cif_render::shared_struct! {
    /// Parameters of the optimiser's step of a flat group.
    pub struct GroupRates {
        /// Floats.
        pub floats: u32,
        /// Parts that the gradient comes in.
        pub parts: u32,
        /// Rate with the correction of the first moment; 0 keeps still.
        pub rate: f32,
        /// Correction of the second moment.
        pub second: f32,
        /// Parameters stay within plus and minus this.
        pub limit: f32,
        /// Pads to 16 bytes.
        pub unused: u32,
        /// As above.
        pub unused_too: [u32; 2],
    }
}

cif_render::shared_struct! {
    /// Parameters of the optimiser's step of the planes.
    pub struct PlaneRates {
        /// Planes.
        pub planes: u32,
        /// Columns of all planes.
        pub columns: u32,
        /// Rate with the correction of the first moment; 0 keeps still.
        pub rate: f32,
        /// Correction of the second moment.
        pub second: f32,
    }
}

cif_render::shared_struct! {
    /// Which camera a view is of.
    pub struct ExposureSettings {
        /// Pixels of the view.
        pub pixels: u32,
        /// Number of the camera.
        pub camera: u32,
        /// Pads to 16 bytes.
        pub unused_0: u32,
        /// As above.
        pub unused_1: u32,
    }
}

cif_render::shared_struct! {
    /// Parameters of the optimiser's step of exposures.
    pub struct ExposureRates {
        /// Cameras.
        pub cameras: u32,
        /// Rate with the correction of the first moment.
        pub rate: f32,
        /// Correction of the second moment.
        pub second: f32,
        /// Pads to 16 bytes.
        pub unused: u32,
    }
}

cif_render::shared_struct! {
    /// Parameters of the optimiser's step of poses.
    pub struct PoseRates {
        /// Rate of turns in radians, and of translations in sizes; 0 keeps still.
        pub rate: f32,
        /// Pads to 16 bytes.
        pub unused: u32,
        /// As above.
        pub unused_too: [u32; 2],
    }
}

cif_render::shared_struct! {
    /// Moments of a pose.
    pub struct PoseState {
        /// Decaying mean of the gradient by the turn, and steps done.
        pub first_turn: [f32; 4],
        /// Of the gradient by the translation, and the share of the rate.
        pub first_translation: [f32; 4],
        /// Decaying mean of the squares; one more float.
        pub second_turn: [f32; 4],
        /// As above.
        pub second_translation: [f32; 4],
    }
}

cif_render::shared_struct! {
    /// Parameters of the kernel that accumulates gradients.
    pub struct Accumulation {
        /// Floats, or rows.
        pub count: u32,
        /// Bit of the fault word for what no optimiser may take.
        pub fault: u32,
        /// 1 when the floats are geometry of Gaussians, whose bits differ.
        pub is_geometry: u32,
        /// Pads to 16 bytes.
        pub unused: u32,
    }
}

cif_render::shared_struct! {
    /// Parameters of the kernel that rearranges rows.
    pub struct Rearrangement {
        /// New rows.
        pub rows: u32,
        /// Floats of a row.
        pub width: u32,
        /// 1 when fresh rows are zeros.
        pub fresh_are_zero: u32,
        /// A float of every row that becomes zero; beyond the row for none.
        pub zero_column: u32,
        /// Bits of the floats that become zero in marked rows.
        pub restarted_columns: u32,
        /// Pads to 16 bytes.
        pub unused_0: u32,
        /// As above.
        pub unused_1: u32,
        /// As above.
        pub unused_2: u32,
    }
}

/// Bit of an origin that marks a fresh row.
pub const FRESH: u32 = 1 << 31;

/// Bit of an origin that marks a row of which some floats start afresh.
pub const RESTARTED: u32 = 1 << 30;

cif_render::shared_struct! {
    /// Parameters of the kernel that judges a step.
    pub struct Judgement {
        /// Slot of the view's losses.
        pub slot: u32,
        /// Fault bits that make steps wait.
        pub counts: u32,
        /// Fault bits that the host knows of.
        pub known: u32,
        /// 1 after the last view of a step.
        pub is_last: u32,
    }
}

cif_render::shared_struct! {
    /// Parameters of the loss that holds Gaussians to known motion.
    pub struct Motion {
        /// Weight and reach (metres) of the pull to a path.
        pub path: [f32; 2],
        /// Of the pull to the own place.
        pub place: [f32; 2],
        /// Factor of all gradients.
        pub scale: f32,
        /// Gaussians N.
        pub gaussians: u32,
        /// Pads to 16 bytes.
        pub unused: [f32; 2],
    }
}

/// Part of the step and name, as the CPU has them, of the lowest bit of a fault word.
#[must_use]
pub fn fault_name(found: u32) -> (&'static str, String) {
    let lowest = found.trailing_zeros();
    if let Some(parameter) = TABLE.get(lowest as usize) {
        return ("gradients", format!("gradient of {}", parameter.name));
    }
    let (part, name) = match 1_u32.checked_shl(lowest) {
        Some(fault::EXPOSURES) => ("gradients", "gradient of exposures"),
        Some(fault::POSES) => ("gradients", "gradient of poses"),
        Some(fault::COLOR_LOSS) => ("losses", "colour loss"),
        Some(fault::INSTANCE_LOSS) => ("losses", "instance loss"),
        _ => ("optimiser", "learning rate"),
    };
    (part, name.to_owned())
}

/// First float of a parameter in the geometry of a Gaussian.
fn column(parameter: &Parameter) -> Constant {
    Constant::Unsigned(geometry_column(parameter).expect("a parameter of the geometry") as u32)
}

/// Rows of a plane that a thread of the optimiser goes down; it reads four more for the differences at the ends.
pub(super) const BAND: usize = 8;

const CONSTANTS: Snippet = Snippet {
    name: "constants",
    text: || {
        constants(&[
            ("BETA_1", Constant::Float(BETA_1)),
            ("BETA_2", Constant::Float(BETA_2)),
            ("EPSILON", Constant::Float(EPSILON)),
            ("SMALLEST_SECOND", Constant::Float(f32::MIN_POSITIVE)),
            ("MIN_NORM", Constant::Float(MIN_NORM as f32)),
            ("FLOAT_SPACING", Constant::Float(f32::EPSILON)),
            ("MIN_LABEL_PROBABILITY", Constant::Float(MIN_LABEL_PROBABILITY)),
            ("TILE", Constant::Unsigned(TILE)),
            ("INSTANCE_PASS", Constant::Unsigned(INSTANCE_PASS)),
            ("SSIM_C1", Constant::Float(C1)),
            ("SSIM_C2", Constant::Float(C2)),
            ("FREE", Constant::Unsigned(u32::from(FREE))),
            ("NO_ROTATION", Constant::Float(NO_ROTATION as f32)),
            ("SH_FLOATS", Constant::Unsigned(SH_FLOATS as u32)),
            ("GEOMETRY_FLOATS", Constant::Unsigned(GEOMETRY_FLOATS as u32)),
            ("OCCUPANCY_COLUMN", column(&OCCUPANCY_LOGITS)),
            ("QUATERNION_COLUMN", column(&QUATERNIONS)),
            ("FRESH", Constant::Unsigned(FRESH)),
            ("RESTARTED", Constant::Unsigned(RESTARTED)),
            ("EXPOSURE_FLOATS", Constant::Unsigned(EXPOSURE_FLOATS as u32)),
            ("PAIRS_WORD", Constant::Unsigned(GpuStatistics::PAIRS as u32)),
            ("WANTED_PAIRS_WORD", Constant::Unsigned(GpuStatistics::WANTED_PAIRS as u32)),
            ("JUDGED_SPACING", Constant::Unsigned(held_out::SPACING)),
            ("JUDGED_COLUMN", Constant::Unsigned(held_out::FIRST.0)),
            ("JUDGED_ROW", Constant::Unsigned(held_out::FIRST.1)),
            ("PLANES_FAULT", Constant::Unsigned(fault::bit(&PLANES))),
            ("MAX_WORKGROUPS", Constant::Unsigned(MAX_WORKGROUPS)),
            ("BAND", Constant::Unsigned(BAND as u32)),
            ("POSE_DECAY_1", Constant::Float(poses::DECAY[0] as f32)),
            ("POSE_DECAY_2", Constant::Float(poses::DECAY[1] as f32)),
            ("POSE_SHARE_1", Constant::Float((1.0 - poses::DECAY[0]) as f32)),
            ("POSE_SHARE_2", Constant::Float((1.0 - poses::DECAY[1]) as f32)),
            ("POSE_EPSILON", Constant::Float(poses::EPSILON as f32)),
            ("POSE_TURN_RATE", Constant::Float(poses::TURN_RATE as f32)),
            ("POSE_STEPS", Constant::Float(poses::COUNTED_STEPS as f32)),
        ])
    },
};

const LOSS_SETTINGS: Snippet =
    Snippet { name: "loss_settings", text: || structures(&[LossSettings::layout()]) };
const GAUSSIAN_RATES: Snippet =
    Snippet { name: "gaussian_rates", text: || structures(&[GaussianRates::layout()]) };
const GROUP_RATES: Snippet = Snippet { name: "group_rates", text: || structures(&[GroupRates::layout()]) };
const PLANE_RATES: Snippet = Snippet { name: "plane_rates", text: || structures(&[PlaneRates::layout()]) };
const EXPOSURE_SETTINGS: Snippet =
    Snippet { name: "exposure_settings", text: || structures(&[ExposureSettings::layout()]) };
const EXPOSURE_RATES: Snippet =
    Snippet { name: "exposure_rates", text: || structures(&[ExposureRates::layout()]) };
const POSE_RATES: Snippet =
    Snippet { name: "pose_rates", text: || structures(&[PoseRates::layout(), PoseState::layout()]) };
const ACCUMULATION: Snippet =
    Snippet { name: "accumulation", text: || structures(&[Accumulation::layout()]) };
const REARRANGEMENT: Snippet =
    Snippet { name: "rearrangement", text: || structures(&[Rearrangement::layout()]) };
const JUDGEMENT: Snippet = Snippet { name: "judgement", text: || structures(&[Judgement::layout()]) };
const MOTION: Snippet = Snippet { name: "motion", text: || structures(&[Motion::layout()]) };
const ADAM: Snippet = Snippet { name: "adam", text: || include_str!("adam.wgsl").to_owned() };

/// Colour loss, and the value of the instance loss.
pub const LOSSES: Module = Module {
    name: "losses",
    text: include_str!("losses.wgsl"),
    imports: &[CONSTANTS, LOSS_SETTINGS],
    entries: &["losses", "total"],
};

/// Pixels that train nothing.
pub const LEAVE_OUT: Module = Module {
    name: "leave_out",
    text: include_str!("leave_out.wgsl"),
    imports: &[CONSTANTS, LOSS_SETTINGS],
    entries: &["leave_out"],
};

/// Structural similarity.
pub const SSIM: Module = Module {
    name: "ssim",
    text: include_str!("ssim.wgsl"),
    imports: &[CONSTANTS, LOSS_SETTINGS],
    entries: &["blur_rows", "compare", "blur_maps", "add_gradient"],
};

/// Exposure of colours per camera, and its backward pass.
pub const EXPOSURE: Module = Module {
    name: "exposure",
    text: include_str!("exposure.wgsl"),
    imports: &[CONSTANTS, FAULTS, EXPOSURE_SETTINGS],
    entries: &["expose", "pull_back", "add_gradient"],
};

/// Optimiser of exposures.
pub const ADAM_EXPOSURES: Module = Module {
    name: "adam_exposures",
    text: include_str!("adam_exposures.wgsl"),
    imports: &[CONSTANTS, EXPOSURE_RATES, ADAM],
    entries: &["adam_exposures"],
};

/// Optimiser of poses.
pub const ADAM_POSES: Module = Module {
    name: "adam_poses",
    text: include_str!("adam_poses.wgsl"),
    imports: &[CONSTANTS, GROUPS, QUATERNION_PRODUCTS, POSE_RATES],
    entries: &["adam_poses", "hold_joints"],
};

/// Optimiser of what Gaussians have.
pub const ADAM_GAUSSIANS: Module = Module {
    name: "adam_gaussians",
    text: include_str!("adam_gaussians.wgsl"),
    imports: &[CONSTANTS, GAUSSIAN_RATES, ADAM],
    entries: &["adam_geometry", "adam_sh"],
};

/// Optimiser of the network and of calibrations.
pub const ADAM_NETWORK: Module = Module {
    name: "adam_network",
    text: include_str!("adam_network.wgsl"),
    imports: &[CONSTANTS, GROUP_RATES, ADAM],
    entries: &["adam_network"],
};

/// Optimiser of the planes, with their regularisers.
pub const ADAM_PLANES: Module = Module {
    name: "adam_planes",
    text: include_str!("adam_planes.wgsl"),
    imports: &[CONSTANTS, PLANE_RATES, FIXED_POINT, ADAM],
    entries: &["add_up", "move_nodes"],
};

/// Sums over the views of a step, and statistics.
pub const ACCUMULATE: Module = Module {
    name: "accumulate",
    text: include_str!("accumulate.wgsl"),
    imports: &[CONSTANTS, ACCUMULATION, FAULTS],
    entries: &["add", "add_screen", "add_statistics"],
};

/// Changes of the set of Gaussians.
pub const REARRANGE: Module = Module {
    name: "rearrange",
    text: include_str!("rearrange.wgsl"),
    imports: &[CONSTANTS, REARRANGEMENT],
    entries: &["rearrange"],
};

/// Judgement of steps.
pub const JUDGE: Module = Module {
    name: "judge",
    text: include_str!("judge.wgsl"),
    imports: &[CONSTANTS, FAULTS, JUDGEMENT],
    entries: &["judge"],
};

/// Probabilities of identities.
pub const IDENTITY: Module = Module {
    name: "identity",
    text: include_str!("identity.wgsl"),
    imports: &[CONSTANTS, ACCUMULATION],
    entries: &["identity"],
};

/// Known motion.
pub const DISPLACEMENT: Module = Module {
    name: "displacement",
    text: include_str!("displacement.wgsl"),
    imports: &[CONSTANTS, MOTION],
    entries: &["follow", "displace"],
};

/// Every WGSL file of this crate.
pub const MODULES: &[&Module] = &[
    &LOSSES,
    &LEAVE_OUT,
    &SSIM,
    &EXPOSURE,
    &ADAM_EXPOSURES,
    &ADAM_POSES,
    &ADAM_GAUSSIANS,
    &ADAM_NETWORK,
    &ADAM_PLANES,
    &ACCUMULATE,
    &JUDGE,
    &REARRANGE,
    &IDENTITY,
    &DISPLACEMENT,
];

/// Every structure that Rust and WGSL share.
pub const LAYOUTS: &[fn() -> Layout] = &[
    LossSettings::layout,
    GaussianRates::layout,
    GroupRates::layout,
    PlaneRates::layout,
    ExposureSettings::layout,
    ExposureRates::layout,
    PoseRates::layout,
    PoseState::layout,
    Accumulation::layout,
    Judgement::layout,
    Rearrangement::layout,
    Motion::layout,
];

/// The kernels of a module, as many as it has entry points.
pub(crate) fn entries<const N: usize>(gpu: &Gpu, module: &Module) -> Result<[Kernel; N], GpuError> {
    let kernels = Kernel::compile(gpu, module)?;
    Ok(<[Kernel; N]>::try_from(kernels).expect("as many kernels as entry points, and the module lists those"))
}
