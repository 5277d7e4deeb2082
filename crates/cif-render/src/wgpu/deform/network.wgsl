// Layers of the deformation's network on a block of ROWS Gaussians, activations in workgroup memory. Source: methods
// reference 2.3; twins: cpu/deform.rs, cpu/matrix.rs.
//
// Activations are regions of `[columns, ROW_QUADS]` vectors of four Gaussians. Weights come from deform_prepare as
// `[inner, column quads]` vectors of four columns, padded with zeros, biases right behind them.
//
// A head is two vectors of `Deformation.heads`: (first component, outputs, hidden forward, hidden backward) and
// (output forward, output backward, 0, 0). Components number the posed geometry: centre 0..2, opacity 3, log-scales
// 4..6, occupancy 7, quaternion 8..11; SH_COMPONENT stands for the spherical harmonics.

const SH_COMPONENT: u32 = 12u;

// Adds nothing, a bias, or what is in the output.
const START_ZERO: u32 = 0u;
const START_BIAS: u32 = 1u;
const START_OUTPUT: u32 = 2u;

var<workgroup> activations: array<vec4<f32>, ACTIVATION_QUADS>;

// output = start + input weights; eight Gaussians by four columns per thread at a time.
fn multiply(
    thread: u32, input: u32, inner: u32, first_weight: u32, column_quads: u32, start: u32, rectify: bool, output: u32,
) {
    let row_groups = ROW_QUADS / 2u;
    for (var tile = thread; tile < row_groups * column_quads; tile += THREADS) {
        let rows = tile % row_groups * 2u;
        let column = tile / row_groups;
        let target_quad = output + column * 4u * ROW_QUADS + rows;
        var low: array<vec4<f32>, 4>;
        var high: array<vec4<f32>, 4>;
        if start == START_BIAS {
            let bias = weights[first_weight + inner * column_quads + column];
            for (var k = 0u; k < 4u; k++) {
                low[k] = vec4<f32>(bias[k]);
                high[k] = vec4<f32>(bias[k]);
            }
        } else if start == START_OUTPUT {
            for (var k = 0u; k < 4u; k++) {
                low[k] = activations[target_quad + k * ROW_QUADS];
                high[k] = activations[target_quad + k * ROW_QUADS + 1u];
            }
        }
        for (var k = 0u; k < inner; k++) {
            let weight = weights[first_weight + k * column_quads + column];
            let a = activations[input + k * ROW_QUADS + rows];
            let b = activations[input + k * ROW_QUADS + rows + 1u];
            low[0] += weight.x * a;
            low[1] += weight.y * a;
            low[2] += weight.z * a;
            low[3] += weight.w * a;
            high[0] += weight.x * b;
            high[1] += weight.y * b;
            high[2] += weight.z * b;
            high[3] += weight.w * b;
        }
        for (var k = 0u; k < 4u; k++) {
            if rectify {
                low[k] = max(low[k], vec4<f32>(0.0));
                high[k] = max(high[k], vec4<f32>(0.0));
            }
            activations[target_quad + k * ROW_QUADS] = low[k];
            activations[target_quad + k * ROW_QUADS + 1u] = high[k];
        }
    }
}

// Features of the block's Gaussians; the last Gaussian stands in behind the end.
fn block_features(thread: u32, first_row: u32, output: u32) {
    for (var item = thread; item < ROW_QUADS * FEATURES; item += THREADS) {
        let feature = item % FEATURES;
        let quad = item / FEATURES;
        var values: vec4<f32>;
        for (var k = 0u; k < 4u; k++) {
            let row = min(first_row + quad * 4u + k, moment.gaussians - 1u);
            values[k] = look_up(canonical[row * 3u].xyz, feature);
        }
        activations[output + feature * ROW_QUADS + quad] = values;
    }
}
