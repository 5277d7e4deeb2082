//! The least that the stages of a step have to move and to compute, from what the step works on: what the time of a
//! stage on a device, or of a part of a step on the processor, is compared with.
//!
//! Bytes count every array that a pass reads or writes once, as if caches held everything else; a sort counts its
//! passes. Operations count additions, multiplications, divisions, roots, exponentials and logarithms as one each, by
//! hand from the WGSL files. Identity rows are not counted in the raster stages, nor are label slots.

use cif_field::Deformation;
use cif_field::gaussians::SH_FLOATS;
use cif_render::Speed;
use cif_render::wgpu::deform::{SPLITS, Shape};

/// Workload of a step; sums over its views unless said otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepShape {
    /// Views.
    pub views: f64,
    /// Gaussians of the scene.
    pub gaussians: f64,
    /// Gaussians with a footprint in a view.
    pub visible: f64,
    /// (tile, Gaussian) pairs.
    pub pairs: f64,
    /// (pixel, Gaussian) pairs that blending evaluates.
    pub evaluated_pairs: f64,
    /// Pixels.
    pub pixels: f64,
    /// Tiles of one view.
    pub tiles: f64,
    /// Spherical-harmonics coefficients in use per colour channel.
    pub coefficients: f64,
    /// Entries of the identity rows of the scene; 0 in stages without.
    pub identity_entries: f64,
    /// True when the loss has the structural similarity.
    pub similarity: bool,
    /// Workload of the deformation; `None` where Gaussians do not move.
    pub deformation: Option<DeformationShape>,
}

/// Workload of a deformation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DeformationShape {
    /// Gaussians that are not held still.
    pub moving: f64,
    /// Features, levels times channels.
    pub features: f64,
    /// Weights and biases of the network.
    pub weights: f64,
    /// Nodes of all planes, times channels.
    pub planes: f64,
    /// Nodes of the lines in time at a moment, times channels.
    pub lines: f64,
    /// Bytes that the backward pass keeps of a Gaussian.
    pub scratch_bytes: f64,
}

impl DeformationShape {
    /// Of a deformation of `gaussians`; `None` where no device could run it.
    #[must_use]
    pub fn new(deformation: &Deformation, gaussians: usize) -> Option<Self> {
        let shape = Shape::new(deformation, u64::from(u32::MAX)).ok()?;
        let still = deformation.still.iter().filter(|still| **still).count();
        Some(Self {
            moving: gaussians.saturating_sub(still) as f64,
            features: deformation.config.features() as f64,
            weights: f64::from(shape.mlp_floats),
            planes: f64::from(shape.plane_floats),
            lines: shape.line_sources.len() as f64,
            scratch_bytes: 16.0 * f64::from(shape.block_quads) / f64::from(shape.backward_rows),
        })
    }
}

/// Least memory traffic and arithmetic of a stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Floor {
    /// Bytes read and written.
    pub bytes: f64,
    /// Floating-point operations.
    pub flops: f64,
}

impl Floor {
    /// The floor of a part of a step on the processor by its name, which does what some stages on a device do; `None` for
    /// parts that have none.
    #[must_use]
    pub fn of_part(part: &str, shape: &StepShape) -> Option<Self> {
        let stages: &[&str] = match part {
            "bin and sort" => &["sort by depth", "bin", "emit", "sort by tile", "ranges"],
            "project backward" => &["gather gradients", "project backward"],
            "deform backward" => {
                &["deform backward: network", "deform backward: planes", "deform backward: lines"]
            }
            "optimiser: network" => return Some(adam(shape.deformation.unwrap_or_default().weights)),
            "deform"
            | "project"
            | "rasterize"
            | "losses"
            | "rasterize backward"
            | "optimiser: Gaussians"
            | "optimiser: planes" => &[part],
            _ => return None,
        };
        let floors = stages.iter().filter_map(|stage| floor(stage, shape));
        Some(floors.fold(Self::default(), |sum, of| Self {
            bytes: sum.bytes + of.bytes,
            flops: sum.flops + of.flops,
        }))
    }

    /// Seconds that a device needs at the least.
    #[must_use]
    pub fn seconds(&self, speed: &Speed) -> f64 {
        (self.bytes / speed.bytes_per_second).max(self.flops / speed.flops_per_second)
    }

    /// True when memory, not arithmetic, sets the floor.
    #[must_use]
    pub fn is_by_memory(&self, speed: &Speed) -> bool {
        self.bytes / speed.bytes_per_second >= self.flops / speed.flops_per_second
    }
}

/// Bytes of the geometry of a Gaussian, of its spherical harmonics, and of a splat.
const GEOMETRY: f64 = 48.0;
const SH: f64 = 4.0 * SH_FLOATS as f64;
const SPLAT: f64 = 64.0;
/// Bytes of the sums of a pair.
const PAIR: f64 = 48.0;
/// Operations of `footprint_of`.
const FOOTPRINT: f64 = 220.0;
/// Operations of Adam for a parameter, and bytes: parameter, gradient and two moments, both ways.
const ADAM: f64 = 14.0;
const ADAM_BYTES: f64 = 32.0;

/// The floor of a stage by the name that its times have; `None` for a stage that is not known.
#[must_use]
pub fn floor(stage: &str, shape: &StepShape) -> Option<Floor> {
    let StepShape { views, visible: v, pairs: p, evaluated_pairs: e, pixels: x, .. } = *shape;
    // Over all views, and once.
    let (n, once) = (shape.gaussians * views, shape.gaussians);
    let c = shape.coefficients;
    let d = shape.deformation.unwrap_or_default();
    let moving = d.moving * views;
    let tile_bits = (shape.tiles.max(1.0).log2().floor() + 1.0).max(1.0);
    let of = |bytes: f64, flops: f64| Some(Floor { bytes, flops });
    match stage {
        // Rows in time of the lines, the weights in the order of the kernel, then nodes, geometry both ways.
        "deform" => of(
            views * (12.0 * d.lines + 16.0 * d.weights) + 2.0 * GEOMETRY * moving + looked_up(&d, views),
            moving * (2.0 * d.weights + 38.0 * d.features),
        ),
        "project" => of((GEOMETRY + SPLAT + 8.0) * n + 12.0 * c * v, FOOTPRINT * n + (100.0 + 6.0 * c) * v),
        // Counts read keys, the scatter reads and writes keys and values; four bits a pass.
        "sort by depth" => of(8.0 * 20.0 * n, 0.0),
        "sort by tile" => of((tile_bits / 4.0).ceil() * 20.0 * p, 0.0),
        // Splats and order; tile counts, both offsets, and two prefix sums of 12 bytes.
        "bin" => of((SPLAT + 44.0) * n, 30.0 * p),
        "emit" => of((SPLAT + 12.0) * v + 16.0 * p, 30.0 * p),
        "ranges" => of(32.0 * p + 8.0 * shape.tiles * views, 0.0),
        "rasterize" => of((16.0 + SPLAT) * p + 32.0 * x, 24.0 * e),
        "losses" => {
            let (bytes, flops) = if shape.similarity { (532.0, 1291.0) } else { (0.0, 0.0) };
            of((52.0 + bytes) * x, (20.0 + flops) * x)
        }
        "cotangents" => of(84.0 * x, 20.0 * x),
        "rasterize backward" => of((16.0 + SPLAT + PAIR) * p + 32.0 * x, 53.0 * e),
        "gather gradients" => of((8.0 + 48.0) * n + (8.0 + PAIR) * p + SPLAT * v, 10.0 * p),
        "project backward" => of(
            (2.0 * GEOMETRY + SPLAT + 48.0 + SH + 16.0) * n + 12.0 * c * v,
            (FOOTPRINT + 400.0 + 18.0 * c) * v,
        ),
        "identity backward" => {
            of(16.0 * shape.identity_entries * views, 4.0 * shape.identity_entries * views)
        }
        "identity" => of(20.0 * shape.identity_entries, 8.0 * shape.identity_entries),
        // View, total and sum; without deformation the geometry too, else it comes with its gradient.
        "accumulate" => {
            let geometry = if shape.deformation.is_some() { 0.0 } else { GEOMETRY };
            of(3.0 * (SH + geometry + 16.0) * n, 64.0 * n)
        }
        "guidance" => of(100.0 * n, 60.0 * n),
        // Activations anew, gradients by inputs and by weights; only what is seen has any.
        "deform backward: network" => {
            let active = moving.min(v);
            of(
                2.0 * GEOMETRY * moving + looked_up(&d, views) + 2.0 * d.scratch_bytes * active,
                6.0 * d.weights * active,
            )
        }
        // Sums of 8 bytes, both ways.
        "deform backward: planes" => {
            let active = moving.min(v);
            let sums = (18.0 * d.features * active).min((d.planes + d.lines) * views);
            of((3.0 * GEOMETRY + 4.0 * d.features) * active + 16.0 * sums, 120.0 * d.features * active)
        }
        "deform backward: lines" => of(40.0 * d.lines * views, 10.0 * d.lines * views),
        "optimiser: Gaussians" => {
            let floats = (12.0 + 3.0 * c) * once;
            let of_rows = if shape.identity_entries > 0.0 { shape.identity_entries } else { 0.0 };
            of(ADAM_BYTES * (floats + of_rows) + 16.0 * once, ADAM * (floats + of_rows))
        }
        "optimiser: planes" => of((ADAM_BYTES + 8.0) * d.planes, (ADAM + 20.0) * d.planes),
        "optimiser: network" => {
            let parts = f64::from(SPLITS);
            of((24.0 + 8.0 * parts) * d.weights, (ADAM + parts) * d.weights)
        }
        // Colours as the camera shows them, and their gradient back.
        "exposure" => of(96.0 * x, 30.0 * x),
        // One invocation: all latency.
        "judge" => of(0.0, 0.0),
        _ => None,
    }
}

/// The floor of Adam for so many parameters.
fn adam(parameters: f64) -> Floor {
    Floor { bytes: ADAM_BYTES * parameters, flops: ADAM * parameters }
}

/// Bytes of nodes that are looked up: four of three planes per feature, or all there are.
fn looked_up(d: &DeformationShape, views: f64) -> f64 {
    views * (48.0 * d.features * d.moving).min(4.0 * (d.planes + d.lines))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape() -> StepShape {
        StepShape {
            views: 2.0,
            gaussians: 1000.0,
            visible: 1200.0,
            pairs: 5000.0,
            evaluated_pairs: 400_000.0,
            pixels: 2.0 * 64.0 * 48.0,
            tiles: 12.0,
            coefficients: 4.0,
            similarity: true,
            ..StepShape::default()
        }
    }

    #[test]
    fn floors_follow_from_the_counts() {
        let shape = shape();
        let found = |stage: &str| floor(stage, &shape).unwrap();
        // 120 bytes a Gaussian and view, and three colours of four coefficients of what is seen.
        let project = Floor { bytes: 120.0 * 2000.0 + 48.0 * 1200.0, flops: 220.0 * 2000.0 + 124.0 * 1200.0 };
        assert_eq!(found("project"), project);
        assert_eq!(found("sort by depth").bytes, 8.0 * 20.0 * 2000.0);
        // Twelve tiles and none: four bits, one pass.
        assert_eq!(found("sort by tile").bytes, 20.0 * 5000.0);
        let many = StepShape { tiles: 256.0, ..shape };
        assert_eq!(floor("sort by tile", &many).unwrap().bytes, 3.0 * 20.0 * 5000.0);
        assert_eq!(found("rasterize"), Floor { bytes: 80.0 * 5000.0 + 32.0 * 6144.0, flops: 9.6e6 });
        assert_eq!(found("losses").bytes, 584.0 * 6144.0);
        let plain = StepShape { similarity: false, ..shape };
        assert_eq!(floor("losses", &plain).unwrap(), Floor { bytes: 52.0 * 6144.0, flops: 20.0 * 6144.0 });
        // 24 floats a Gaussian, once a step, and whether it was seen.
        let adam = Floor { bytes: (32.0 * 24.0 + 16.0) * 1000.0, flops: 14.0 * 24.0 * 1000.0 };
        assert_eq!(found("optimiser: Gaussians"), adam);
        assert_eq!(found("optimiser: planes"), Floor::default(), "nothing moves");
        assert_eq!(floor("unheard of", &shape), None);
    }

    #[test]
    fn deformations_are_counted_by_what_moves() {
        let d = DeformationShape {
            moving: 600.0,
            features: 8.0,
            weights: 1000.0,
            planes: 50_000.0,
            lines: 300.0,
            scratch_bytes: 400.0,
        };
        let shape = StepShape { deformation: Some(d), ..shape() };
        let found = |stage: &str| floor(stage, &shape).unwrap();
        assert_eq!(found("deform").flops, 1200.0 * (2000.0 + 304.0));
        // 600 x 8 features look up 48 bytes each: more than the 4 x 50 300 that there are, in either view.
        let looked_up = 2.0 * 201_200.0_f64.min(48.0 * 8.0 * 600.0);
        assert_eq!(found("deform").bytes, 2.0 * (3600.0 + 16_000.0) + 96.0 * 1200.0 + looked_up);
        assert_eq!(found("deform backward: network").flops, 6000.0 * 1200.0);
        assert_eq!(found("optimiser: planes").bytes, 40.0 * 50_000.0);
        assert_eq!(found("optimiser: network").bytes, (24.0 + 256.0) * 1000.0);
        // The geometry's gradient is then part of the deformation's.
        assert_eq!(found("accumulate").bytes, 3.0 * 208.0 * 2000.0);
        assert_eq!(
            floor("accumulate", &StepShape { deformation: None, ..shape }).unwrap().bytes,
            3.0 * 256.0 * 2000.0
        );
    }

    #[test]
    fn parts_on_the_processor_do_what_stages_do() {
        let shape = shape();
        let stages = ["gather gradients", "project backward"].map(|stage| floor(stage, &shape).unwrap());
        let part = Floor::of_part("project backward", &shape).unwrap();
        assert_eq!(part.bytes, stages[0].bytes + stages[1].bytes);
        assert_eq!(part.flops, stages[0].flops + stages[1].flops);
        assert_eq!(Floor::of_part("rasterize", &shape), floor("rasterize", &shape));
        assert_eq!(Floor::of_part("other", &shape), None);
        let moving = StepShape {
            deformation: Some(DeformationShape { weights: 10.0, ..Default::default() }),
            ..shape
        };
        assert_eq!(Floor::of_part("optimiser: network", &moving).unwrap().bytes, 320.0);
    }

    #[test]
    fn the_slower_of_memory_and_arithmetic_is_the_floor() {
        let speed = Speed { bytes_per_second: 100.0, flops_per_second: 1000.0 };
        let floor = Floor { bytes: 50.0, flops: 100.0 };
        assert!(floor.is_by_memory(&speed) && (floor.seconds(&speed) - 0.5).abs() < 1e-12);
        let floor = Floor { flops: 2000.0, ..floor };
        assert!(!floor.is_by_memory(&speed) && (floor.seconds(&speed) - 2.0).abs() < 1e-12);
    }
}
