//! Shape of a deformation: constants with which its kernels are compiled, and the offsets of its parameters.

use cif_field::Deformation as FieldDeformation;
use cif_field::deformation::{HeadKind, HeadLayout, LinearLayout, MlpLayout, PLANES, PlaneLayout};
use cif_field::parameters;

use crate::wgpu::faults::bit;
use crate::wgpu::gaussians::geometry_column;
use crate::wgpu::{Constant, GpuError, constants};

crate::shared_struct! {
    /// Shape of a deformation: a uniform of the kernels.
    pub struct Deformation {
        /// Low corner of the box in two parts, whose sum is exact to double precision; metres.
        pub low: [f32; 4],
        /// Second part.
        pub low_rest: [f32; 4],
        /// Nodes per metre, per level and axis.
        pub slope: [[f32; 4]; 8],
        /// Last node, per level and axis.
        pub last: [[f32; 4]; 8],
        /// First floats of the planes xy, xz, yz of a level.
        pub planes: [[u32; 4]; 8],
        /// First floats of the lines x, y, z of a level.
        pub lines: [[u32; 4]; 8],
        /// Two per head: (first component, outputs, hidden forward, hidden backward) and (output forward, output
        /// backward, 0, 0); see `network.wgsl`.
        pub heads: [[u32; 4]; 10],
    }
}

crate::shared_struct! {
    /// Where in time a view is, and which Gaussians a stage works on.
    pub struct Moment {
        /// Stored row of the time planes below the time.
        pub time_row: u32,
        /// The fraction above it.
        pub time_fraction: f32,
        /// Gaussians N.
        pub gaussians: u32,
        /// First Gaussian of the chunk that the backward stages work on.
        pub first: u32,
    }
}

crate::shared_struct! {
    /// Layers whose weight gradients are products of scratch columns.
    pub struct Layers {
        /// Two per layer: (column of the outputs' gradients, column of the inputs, outputs, inputs) and (first
        /// weight, first bias, first tile, tiles along the inputs).
        pub rows: [[u32; 4]; 22],
    }
}

/// Threads of the workgroups that run the network.
const THREADS: u32 = 64;

/// Bytes of workgroup memory that activations may take: the core limit.
const ACTIVATION_BYTES: u32 = 16_384;

/// Gaussians that a workgroup takes, most first; whole groups of eight.
const ROWS: [u32; 3] = [32, 16, 8];

/// Most bytes that the scratch of a chunk takes, where the device allows as much.
const SCRATCH_BYTES: u64 = 64 << 20;

/// Most Gaussians of a chunk, so that a few dispatches fill the device.
const CHUNK_ROWS: u64 = 32_768;

/// Parts that weight gradients are summed in.
pub const SPLITS: u32 = 32;

/// Weights of a tile along either side.
const TILE: u32 = 32;

/// Padding in the table of weights.
const NOTHING: u32 = u32::MAX;

/// Component that stands for the spherical harmonics; the others number the posed geometry.
const SH_COMPONENT: u32 = 12;

/// Everything that follows from a deformation's configuration and box.
#[derive(Clone, Debug)]
pub struct Shape {
    /// Uniform of the kernels.
    pub block: Deformation,
    /// Uniform of the weight gradients.
    pub layers: Layers,
    /// Tiles of all layers.
    pub tiles: u32,
    /// Per float of the lines: first float of the time plane, floats of one of its rows.
    pub line_sources: Vec<[u32; 2]>,
    /// Per prepared weight: float of the network, or padding.
    pub weight_sources: Vec<u32>,
    /// Floats of all planes.
    pub plane_floats: u32,
    /// Floats of the network.
    pub mlp_floats: u32,
    /// Gaussians per workgroup of the forward pass.
    pub forward_rows: u32,
    /// Gaussians per workgroup of the backward pass.
    pub backward_rows: u32,
    /// Gaussians per chunk of the backward pass.
    pub chunk_rows: u32,
    /// Vectors of scratch per workgroup of the backward pass.
    pub block_quads: u32,
    /// True when a head moves the spherical harmonics.
    pub moves_sh: bool,
    levels: u32,
    channels: u32,
    width: u32,
    heads: u32,
    trunk_forward: u32,
    trunk_backward: u32,
}

/// Columns padded to whole vectors.
fn quads(columns: usize) -> u32 {
    (columns as u32).div_ceil(4)
}

/// Prepared weights as they grow.
#[derive(Default)]
struct WeightTable(Vec<u32>);

impl WeightTable {
    /// Weights `[inputs, output quads]` and biases behind them; returns the first vector.
    fn forward(&mut self, layer: &LinearLayout) -> u32 {
        let row = 4 * quads(layer.outputs) as usize;
        let start = self.0.len();
        self.0.resize(start + (layer.inputs + 1) * row, NOTHING);
        for output in 0..layer.outputs {
            for input in 0..layer.inputs {
                self.0[start + input * row + output] =
                    (layer.weights.start + output * layer.inputs + input) as u32;
            }
            self.0[start + layer.inputs * row + output] = (layer.biases.start + output) as u32;
        }
        start as u32 / 4
    }

    /// Weights `[outputs, input quads]`; returns the first vector.
    fn backward(&mut self, layer: &LinearLayout) -> u32 {
        let row = 4 * quads(layer.inputs) as usize;
        let start = self.0.len();
        self.0.resize(start + layer.outputs * row, NOTHING);
        for output in 0..layer.outputs {
            for input in 0..layer.inputs {
                self.0[start + output * row + input] =
                    (layer.weights.start + output * layer.inputs + input) as u32;
            }
        }
        start as u32 / 4
    }
}

/// First component of what a head writes.
fn component(head: &HeadLayout) -> u32 {
    geometry_column(&head.kind.parameter()).map_or(SH_COMPONENT, |column| column as u32)
}

/// Most Gaussians whose `columns` of activations fit a workgroup.
fn fitting_rows(columns: u32) -> Option<u32> {
    ROWS.into_iter().find(|rows| u64::from(*rows) * u64::from(columns) * 4 <= u64::from(ACTIVATION_BYTES))
}

impl Shape {
    /// # Errors
    /// When the network's activations do not fit a workgroup.
    ///
    /// `largest_binding`: what the device binds, bytes.
    pub fn new(deformation: &FieldDeformation, largest_binding: u64) -> Result<Self, GpuError> {
        let config = &deformation.config;
        let (levels, plane_floats) = config.plane_layout();
        let mlp = config.mlp_layout();
        let (features, width) = (config.features() as u32, config.width);
        let (feature_columns, width_columns) = (features.next_multiple_of(4), width.next_multiple_of(4));
        let forward_columns = feature_columns.max(width_columns) + width_columns;
        let backward_columns = feature_columns + 3 * width_columns;
        let too_wide = || GpuError::NetworkTooWide {
            rows: ROWS[ROWS.len() - 1],
            features: feature_columns,
            width: width_columns,
            bytes: u64::from(ROWS[ROWS.len() - 1]) * u64::from(backward_columns) * 4,
            limit: ACTIVATION_BYTES,
        };
        let forward_rows = fitting_rows(forward_columns).ok_or_else(too_wide)?;
        let backward_rows = fitting_rows(backward_columns).ok_or_else(too_wide)?;

        let mut table = WeightTable::default();
        let trunk_forward = table.forward(&mlp.trunk);
        let trunk_backward = table.backward(&mlp.trunk);
        let mut block = Deformation::default();
        for (index, head) in mlp.heads.iter().enumerate() {
            block.heads[2 * index] = [
                component(head),
                head.output.outputs as u32,
                table.forward(&head.hidden),
                table.backward(&head.hidden),
            ];
            block.heads[2 * index + 1] = [table.forward(&head.output), table.backward(&head.output), 0, 0];
        }
        let line_sources = place_planes(&mut block, deformation, &levels);
        let (layers, tiles, columns) = layers(&mlp, features, width);
        let block_quads = 1 + columns * backward_rows / 4;
        let block_bytes = u64::from(block_quads) * 16;
        let blocks = (CHUNK_ROWS / u64::from(backward_rows))
            .min(SCRATCH_BYTES.min(largest_binding) / block_bytes)
            .max(1) as u32;
        Ok(Self {
            block,
            layers,
            tiles,
            line_sources,
            weight_sources: table.0,
            plane_floats: plane_floats as u32,
            mlp_floats: mlp.len as u32,
            forward_rows,
            backward_rows,
            chunk_rows: blocks * backward_rows,
            block_quads,
            moves_sh: mlp.heads.iter().any(|head| head.kind == HeadKind::Sh),
            levels: levels.len() as u32,
            channels: config.channels,
            width,
            heads: mlp.heads.len() as u32,
            trunk_forward,
            trunk_backward,
        })
    }

    /// Declarations for the kernels of the forward pass.
    pub fn forward_declarations(&self) -> String {
        let (features, width) = (quads(self.features() as usize) * 4, quads(self.width as usize) * 4);
        self.declarations(self.forward_rows, features.max(width) + width)
    }

    /// Declarations for the kernels of the backward pass.
    pub fn backward_declarations(&self) -> String {
        let (features, width) = (quads(self.features() as usize) * 4, quads(self.width as usize) * 4);
        self.declarations(self.backward_rows, features + 3 * width)
    }

    fn features(&self) -> u32 {
        self.levels * self.channels
    }

    /// Declarations for kernels that take `rows` Gaussians per workgroup.
    fn declarations(&self, rows: u32, activation_columns: u32) -> String {
        let (features, width) = (self.features(), self.width);
        let (feature_columns, width_columns) = (features.next_multiple_of(4), width.next_multiple_of(4));
        let unsigned = [
            ("LEVELS", self.levels),
            ("CHANNELS", self.channels),
            ("FEATURES", features),
            ("FEATURE_COLUMNS", feature_columns),
            ("FIRST_COLUMNS", feature_columns.max(width_columns)),
            ("WIDTH", width),
            ("WIDTH_QUADS", width_columns / 4),
            ("HEADS", self.heads),
            ("LAYERS", 1 + 2 * self.heads),
            ("ROWS", rows),
            ("ROW_QUADS", rows / 4),
            ("THREADS", THREADS),
            ("ACTIVATION_QUADS", activation_columns * rows / 4),
            ("TRUNK_FORWARD", self.trunk_forward),
            ("TRUNK_BACKWARD", self.trunk_backward),
            ("FEATURE_COLUMN", 0),
            ("TRUNK_COLUMN", features),
            ("V_TRUNK_COLUMN", features + width),
            ("V_FEATURE_COLUMN", features + 2 * width),
            ("HEADS_COLUMN", 2 * (features + width)),
            ("BLOCK_QUADS", self.block_quads),
            ("CHUNK_ROWS", self.chunk_rows),
            ("SPLITS", SPLITS),
            ("LINE_FLOATS", self.line_sources.len() as u32),
            ("WEIGHT_FLOATS", self.weight_sources.len() as u32),
            ("PLANE_FLOATS", self.plane_floats),
            ("MLP_FLOATS", self.mlp_floats),
            ("PLANES_FAULT", bit(&parameters::PLANES)),
        ]
        .map(|(name, value)| (name, Constant::Unsigned(value)));
        format!("{}const MOVES_SH: bool = {};\n", constants(&unsigned), self.moves_sh)
    }
}

/// Fills in the box and the places of planes and lines; returns where each float of the lines comes from.
fn place_planes(
    block: &mut Deformation,
    deformation: &FieldDeformation,
    levels: &[[PlaneLayout; PLANES]],
) -> Vec<[u32; 2]> {
    let (config, bounds) = (&deformation.config, &deformation.bounds);
    let channels = config.channels as usize;
    let mut sources = Vec::new();
    for axis in 0..3 {
        let low = bounds.low[axis];
        block.low[axis] = low as f32;
        block.low_rest[axis] = (low - f64::from(low as f32)) as f32;
    }
    for (level, layouts) in levels.iter().enumerate() {
        for axis in 0..3 {
            let last = (config.nodes(level, axis) - 1) as f64;
            block.last[level][axis] = last as f32;
            block.slope[level][axis] = (last / (bounds.high[axis] - bounds.low[axis])) as f32;
        }
        // In storage order xy, xz, xt, yz, yt, zt.
        for (place, plane) in [0, 1, 3].into_iter().enumerate() {
            block.planes[level][place] = layouts[plane].offset as u32;
        }
        for (place, plane) in [2, 4, 5].into_iter().enumerate() {
            block.lines[level][place] = sources.len() as u32;
            let row = layouts[plane].columns * channels;
            sources.extend((0..row).map(|k| [(layouts[plane].offset + k) as u32, row as u32]));
        }
    }
    sources
}

/// Layers with their scratch columns, tiles of all layers, and scratch columns of a block.
fn layers(mlp: &MlpLayout, features: u32, width: u32) -> (Layers, u32, u32) {
    let mut layers = Layers::default();
    let (mut tiles, mut count) = (0, 0);
    let mut add = |layer: &LinearLayout, v_outputs: u32, inputs: u32| {
        let along_inputs = (layer.inputs as u32).div_ceil(TILE);
        layers.rows[2 * count] = [v_outputs, inputs, layer.outputs as u32, layer.inputs as u32];
        layers.rows[2 * count + 1] =
            [layer.weights.start as u32, layer.biases.start as u32, tiles, along_inputs];
        tiles += (layer.outputs as u32).div_ceil(TILE) * along_inputs;
        count += 1;
    };
    add(&mlp.trunk, features + width, 0);
    let mut column = 2 * (features + width);
    for head in &mlp.heads {
        add(&head.hidden, column + width, features);
        add(&head.output, column + 2 * width, column);
        column += 2 * width + head.output.outputs as u32;
    }
    (layers, tiles, column)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{ALL_HEADS, SyntheticConfig, generate};

    #[test]
    fn a_network_too_wide_for_a_workgroup_is_refused_with_the_arithmetic() {
        let scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..SyntheticConfig::default() });
        let mut deformation = scene.field.deformation.expect("heads were asked for");
        assert!(Shape::new(&deformation, 1 << 27).is_ok());
        deformation.config.width = 254;
        let error = Shape::new(&deformation, 1 << 27).expect_err("too wide").to_string();
        assert!(
            error.contains("8 Gaussians x (8 features + 3 x width 256) x 4 bytes = 24832 bytes"),
            "{error}"
        );
        assert!(error.contains("16384"), "{error}");
    }

    #[test]
    fn wide_networks_take_fewer_gaussians_at_a_time() {
        assert_eq!([128, 129, 256, 257, 512].map(fitting_rows), [32, 16, 16, 8, 8].map(Some));
        assert_eq!(fitting_rows(513), None);
    }
}
