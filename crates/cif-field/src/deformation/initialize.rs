//! Parameters of a fresh deformation. Source: methods reference 1.1 and 2.3.

use cif_geometry::Bounds;
use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{Deformation, DeformationConfig, LinearLayout, is_time_plane};
use crate::error::ConfigError;

/// Range of fresh spatial planes.
const SPATIAL_RANGE: std::ops::Range<f32> = 0.1..0.5;

/// Smallest side of the box, as a share of the scene extent (methods reference 7, row 23).
const MIN_SIDE: f64 = 1e-3;

/// Widens each side of a box, about its middle, to at least 1e-3 of the scene extent, so that a flat point
/// cloud can be normalised. An extent of zero counts as the box's longest side, and that as 1 m where zero.
#[must_use]
pub fn widen_bounds(bounds: Bounds, extent: f64) -> Bounds {
    let reference = [extent, bounds.size().max_element(), 1.0]
        .into_iter()
        .find(|length| *length > 0.0 && length.is_finite())
        .unwrap_or(1.0);
    let centre = bounds.centre();
    // Far from the origin, steps of f32 are the floor: the box is read in single precision.
    let steps = centre.abs() * f64::from(f32::EPSILON) * 64.0;
    let half = (bounds.size() / 2.0).max(DVec3::splat(reference * MIN_SIDE / 2.0)).max(steps);
    let keep = (bounds.size() / 2.0).cmpeq(half);
    if bounds.is_empty() {
        return Bounds { low: -half, high: half };
    }
    Bounds {
        low: DVec3::select(keep, bounds.low, centre - half),
        high: DVec3::select(keep, bounds.high, centre + half),
    }
}

impl Deformation {
    /// A fresh deformation of the points in `bounds` (metres), widened by [`widen_bounds`] with the scene
    /// extent (metres): spatial planes uniform in [0.1, 0.5], time planes 1, weights Xavier-uniform, biases
    /// uniform in `±1/sqrt(inputs)`. The motion starts small but not zero, as in the base code, unless
    /// `zero_initial_heads` sets the output layers to zero. Equal seeds give equal parameters.
    ///
    /// # Errors
    /// When a setting is out of range.
    pub fn new(
        config: DeformationConfig,
        bounds: Bounds,
        extent: f64,
        seed: u64,
        zero_initial_heads: bool,
    ) -> Result<Self, ConfigError> {
        config.validate()?;
        let mut rng = Pcg64::seed_from_u64(seed);
        let (levels, floats) = config.plane_layout();
        let mut planes = vec![1.0; floats];
        for layouts in &levels {
            for (plane, layout) in layouts.iter().enumerate() {
                if !is_time_plane(plane) {
                    let floats = layout.rows * layout.columns * config.channels as usize;
                    planes[layout.offset..layout.offset + floats]
                        .fill_with(|| rng.random_range(SPATIAL_RANGE));
                }
            }
        }
        let layout = config.mlp_layout();
        let mut mlp = vec![0.0; layout.len];
        let mut draw = |linear: &LinearLayout| {
            let weight = (6.0 / (linear.inputs + linear.outputs) as f32).sqrt();
            mlp[linear.weights.clone()].fill_with(|| rng.random_range(-weight..=weight));
            let bias = 1.0 / (linear.inputs as f32).sqrt();
            mlp[linear.biases.clone()].fill_with(|| rng.random_range(-bias..=bias));
        };
        draw(&layout.trunk);
        for head in &layout.heads {
            draw(&head.hidden);
            draw(&head.output);
        }
        if zero_initial_heads {
            for head in &layout.heads {
                mlp[head.output.weights.start..head.output.biases.end].fill(0.0);
            }
        }
        Ok(Self { config, bounds: widen_bounds(bounds, extent), planes, mlp, still: Vec::new() })
    }
}
