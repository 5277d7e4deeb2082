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

// True where a thread multiplies two vectors of Gaussians at a time, which share the weights that are read; one leaves no
// thread idle where a workgroup has few Gaussians.
const IN_PAIRS: bool = ROW_QUADS * WIDTH_QUADS >= 2u * THREADS;

// Four columns of a vector of Gaussians, or of two.
struct Products {
    low: array<vec4<f32>, 4>,
    high: array<vec4<f32>, 4>,
}

// Adds the products of an inner column, whose place among the activations is given.
fn add_products(at: u32, weight: vec4<f32>, products: ptr<function, Products>) {
    let a = activations[at];
    (*products).low[0] += weight.x * a;
    (*products).low[1] += weight.y * a;
    (*products).low[2] += weight.z * a;
    (*products).low[3] += weight.w * a;
    if IN_PAIRS {
        let b = activations[at + 1u];
        (*products).high[0] += weight.x * b;
        (*products).high[1] += weight.y * b;
        (*products).high[2] += weight.z * b;
        (*products).high[3] += weight.w * b;
    }
}

// output = start + input weights; a vector of Gaussians, or two, by four columns per thread at a time.
fn multiply(
    thread: u32, input: u32, inner: u32, first_weight: u32, column_quads: u32, start: u32, rectify: bool, output: u32,
) {
    let each = select(1u, 2u, IN_PAIRS);
    let row_groups = ROW_QUADS / each;
    for (var tile = thread; tile < row_groups * column_quads; tile += THREADS) {
        let rows = tile % row_groups * each;
        let column = tile / row_groups;
        let target_quad = output + column * 4u * ROW_QUADS + rows;
        var products: Products;
        if start == START_BIAS {
            let bias = weights[first_weight + inner * column_quads + column];
            for (var k = 0u; k < 4u; k++) {
                products.low[k] = vec4<f32>(bias[k]);
                products.high[k] = vec4<f32>(bias[k]);
            }
        } else if start == START_OUTPUT {
            for (var k = 0u; k < 4u; k++) {
                products.low[k] = activations[target_quad + k * ROW_QUADS];
                if IN_PAIRS {
                    products.high[k] = activations[target_quad + k * ROW_QUADS + 1u];
                }
            }
        }
        // Four weights at a time, so that none waits for the memory of the one before.
        let from_weight = first_weight + column;
        let from_input = input + rows;
        var k = 0u;
        for (; k + 4u <= inner; k += 4u) {
            let w0 = weights[from_weight + k * column_quads];
            let w1 = weights[from_weight + (k + 1u) * column_quads];
            let w2 = weights[from_weight + (k + 2u) * column_quads];
            let w3 = weights[from_weight + (k + 3u) * column_quads];
            add_products(from_input + k * ROW_QUADS, w0, &products);
            add_products(from_input + (k + 1u) * ROW_QUADS, w1, &products);
            add_products(from_input + (k + 2u) * ROW_QUADS, w2, &products);
            add_products(from_input + (k + 3u) * ROW_QUADS, w3, &products);
        }
        for (; k < inner; k++) {
            add_products(from_input + k * ROW_QUADS, weights[from_weight + k * column_quads], &products);
        }
        for (var k = 0u; k < 4u; k++) {
            if rectify {
                products.low[k] = max(products.low[k], vec4<f32>(0.0));
                products.high[k] = max(products.high[k], vec4<f32>(0.0));
            }
            activations[target_quad + k * ROW_QUADS] = products.low[k];
            if IN_PAIRS {
                activations[target_quad + k * ROW_QUADS + 1u] = products.high[k];
            }
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
