//! Gradients by the pose of a group of Gaussians that moves as a whole. Source: methods reference of motion, 2.3.
//!
//! A Gaussian of a group has its centre x, quaternion q and harmonics s in the frame of the group; posed they are
//! `X = R (x - p) + c`, `Q = r q` and the turned harmonics. A turn is differentiated by a tangent vector w of
//! `R exp(w)`, in the frame of the group, where all it takes is what reaches the Gaussians in that frame; by the
//! tangent of `exp(w) R`, in the world, it is `R` times that.

use std::sync::OnceLock;

use cif_field::gaussians::SH_FLOATS;
use cif_geometry::quaternion::multiply;
use cif_geometry::spherical_harmonics::{COEFFICIENTS, HarmonicsRotation};
use glam::DVec3;

/// Angle over which turns of harmonics are differentiated, radians: their entries are trigonometric polynomials of
/// degree 3, so both errors of central differences stay below 1e-9.
const STEP: f64 = 1e-5;

/// Change of coefficients by a turn about each axis, `[axis][to][from]`.
type Generators = [[[f32; COEFFICIENTS]; COEFFICIENTS]; 3];

/// Gradient by a pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseGradient {
    /// By the tangent vector of the turn.
    pub turn: DVec3,
    /// By the translation.
    pub translation: DVec3,
}

/// A Gaussian of a group, in the frame of the group.
#[derive(Clone, Copy, Debug)]
pub struct GroupedGaussian<'a> {
    /// Centre relative to the pivot.
    pub offset: [f32; 3],
    /// Raw quaternion (w, x, y, z).
    pub quaternion: [f32; 4],
    /// Coefficients of spherical harmonics.
    pub sh: &'a [f32; SH_FLOATS],
}

impl PoseGradient {
    /// Adds a Gaussian of the group, given the gradients by its parameters in the frame of the group; harmonics only
    /// where they are differentiated.
    pub fn add(
        &mut self,
        gaussian: &GroupedGaussian<'_>,
        v_mean: [f32; 3],
        v_quaternion: [f32; 4],
        v_sh: Option<&[f32; SH_FLOATS]>,
    ) {
        let GroupedGaussian { offset, quaternion, sh } = *gaussian;
        let v_mean = DVec3::from_array(v_mean.map(f64::from));
        self.translation += v_mean;
        self.turn += DVec3::from_array(offset.map(f64::from)).cross(v_mean);
        let (q, v) = (quaternion.map(f64::from), v_quaternion.map(f64::from));
        for axis in 0..3 {
            let mut unit = [0.0; 4];
            unit[axis + 1] = 1.0;
            let turned = multiply(unit, q);
            self.turn[axis] += 0.5 * turned.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
        }
        if let Some(v_sh) = v_sh {
            for (axis, generator) in generators().iter().enumerate() {
                self.turn[axis] += f64::from(turn_of_harmonics(generator, sh, v_sh));
            }
        }
    }

    /// Adds another gradient.
    pub fn sum(self, other: Self) -> Self {
        Self { turn: self.turn + other.turn, translation: self.translation + other.translation }
    }
}

/// `v . (L s)` over the bands of all channels.
fn turn_of_harmonics(
    generator: &[[f32; COEFFICIENTS]; COEFFICIENTS],
    sh: &[f32; SH_FLOATS],
    v_sh: &[f32; SH_FLOATS],
) -> f32 {
    let mut sum = 0.0;
    for (first, end) in [(1, 4), (4, 9), (9, 16)] {
        for to in first..end {
            let v = &v_sh[3 * to..3 * to + 3];
            if *v == [0.0; 3] {
                continue;
            }
            for from in first..end {
                let s = &sh[3 * from..3 * from + 3];
                sum += generator[to][from] * (v[0] * s[0] + v[1] * s[1] + v[2] * s[2]);
            }
        }
    }
    sum
}

fn generators() -> &'static Generators {
    static GENERATORS: OnceLock<Generators> = OnceLock::new();
    GENERATORS.get_or_init(|| {
        std::array::from_fn(|axis| {
            let turned = |angle: f64| {
                let mut unit = [(0.5 * angle).cos(), 0.0, 0.0, 0.0];
                unit[axis + 1] = (0.5 * angle).sin();
                HarmonicsRotation::from_quaternion(unit)
            };
            let (ahead, behind) = (turned(STEP), turned(-STEP));
            let mut generator = [[0.0; COEFFICIENTS]; COEFFICIENTS];
            for from in 0..COEFFICIENTS {
                let column = |rotation: &HarmonicsRotation<f64>| {
                    let mut coefficients = [0.0; SH_FLOATS];
                    coefficients[3 * from] = 1.0;
                    rotation.rotate(&mut coefficients);
                    coefficients
                };
                let (plus, minus) = (column(&ahead), column(&behind));
                for to in 0..COEFFICIENTS {
                    generator[to][from] = ((plus[3 * to] - minus[3 * to]) / (2.0 * STEP)) as f32;
                }
            }
            generator
        })
    })
}
