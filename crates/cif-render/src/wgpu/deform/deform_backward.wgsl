// Gradients of the deformation's network for a chunk of Gaussians: activations are computed anew, which is cheaper than
// keeping everyone's. Leaves, per block of ROWS Gaussians, the columns that deform_backward_weights multiplies and
// the gradient of the features that deform_planes_backward spreads. Blocks without a gradient are skipped. Source:
// methods reference 2.3; twins: DeformationAtTime::backward_block in cpu/deform.rs, reference/deform.rs.
//
// A block of `scratch` is one vector that says whether anything follows, then columns of ROW_QUADS vectors: features,
// trunk, its gradient, the features' gradient, then per head: hidden, its gradient, the outputs' gradients.

#import deformation
#import moment

@group(0) @binding(0) var<uniform> deformation: Deformation;
@group(0) @binding(1) var<uniform> moment: Moment;
@group(0) @binding(2) var<storage, read> canonical: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> planes: array<f32>;
@group(0) @binding(4) var<storage, read> lines: array<f32>;
@group(0) @binding(5) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> v_posed: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> v_posed_sh: array<f32>;
@group(0) @binding(8) var<storage, read_write> scratch: array<vec4<f32>>;

#import hexplane
#import network

const FEATURE_REGION: u32 = 0u;
const TRUNK_REGION: u32 = FEATURE_COLUMNS * ROW_QUADS;
const HIDDEN_REGION: u32 = TRUNK_REGION + WIDTH_QUADS * 4u * ROW_QUADS;
const V_TRUNK_REGION: u32 = HIDDEN_REGION + WIDTH_QUADS * 4u * ROW_QUADS;

// Gradient by output `output` of a head that starts at `component`.
fn v_output(component: u32, output: u32, row: u32) -> f32 {
    if row >= moment.gaussians {
        return 0.0;
    }
    if component == SH_COMPONENT {
        return v_posed_sh[row * 48u + output];
    }
    let at = component + output;
    return v_posed[row * 3u + at / 4u][at % 4u];
}

// By the bits, for NaN is no zero.
fn is_zero(v: vec4<f32>) -> bool {
    return all((bitcast<vec4<u32>>(v) & vec4<u32>(0x7fffffffu)) == vec4<u32>(0u));
}

fn is_active(row: u32) -> bool {
    if row >= moment.gaussians {
        return false;
    }
    let at = row * 3u;
    // Occupancy has no head.
    if !is_zero(v_posed[at]) || !is_zero(vec4<f32>(v_posed[at + 1u].xyz, 0.0)) || !is_zero(v_posed[at + 2u]) {
        return true;
    }
    if MOVES_SH {
        for (var k = 0u; k < 48u; k++) {
            if v_posed_sh[row * 48u + k] != 0.0 {
                return true;
            }
        }
    }
    return false;
}

// Copies a region to columns of the block.
fn keep(thread: u32, region: u32, columns: u32, block: u32, first_column: u32) {
    for (var k = thread; k < columns * ROW_QUADS; k += THREADS) {
        scratch[block + 1u + first_column * ROW_QUADS + k] = activations[region + k];
    }
}

// Zeroes gradients where the rectified activation is 0.
fn gate(gradients: vec4<f32>, values: vec4<f32>) -> vec4<f32> {
    return select(vec4<f32>(0.0), gradients, values > vec4<f32>(0.0));
}

// Gradient of a hidden layer, in its place: output weights times the outputs' gradients, gated.
fn hidden_backward(thread: u32, first_row: u32, component: u32, outputs: u32, first_weight: u32) {
    for (var item = thread; item < ROW_QUADS * WIDTH_QUADS; item += THREADS) {
        let quad = item % ROW_QUADS;
        let column = item / ROW_QUADS;
        var sums: array<vec4<f32>, 4>;
        for (var output = 0u; output < outputs; output++) {
            let weight = weights[first_weight + output * WIDTH_QUADS + column];
            var v: vec4<f32>;
            for (var k = 0u; k < 4u; k++) {
                v[k] = v_output(component, output, first_row + quad * 4u + k);
            }
            sums[0] += weight.x * v;
            sums[1] += weight.y * v;
            sums[2] += weight.z * v;
            sums[3] += weight.w * v;
        }
        for (var k = 0u; k < 4u; k++) {
            let at = HIDDEN_REGION + (column * 4u + k) * ROW_QUADS + quad;
            activations[at] = gate(sums[k], activations[at]);
        }
    }
}

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let local_block = group.y * groups.x + group.x;
    let block = local_block * BLOCK_QUADS;
    let first_row = moment.first + local_block * ROWS;
    // Flags of the Gaussians lie where the features will.
    if thread < ROWS {
        activations[thread] = vec4<f32>(select(0.0, 1.0, is_active(first_row + thread)));
    }
    workgroupBarrier();
    if thread == 0u {
        var found = vec4<f32>(0.0);
        for (var k = 0u; k < ROWS; k++) {
            found = max(found, activations[k]);
        }
        activations[0] = found;
        scratch[block] = found;
    }
    if workgroupUniformLoad(&activations[0]).x == 0.0 {
        return;
    }
    block_features(thread, first_row, FEATURE_REGION);
    workgroupBarrier();
    keep(thread, FEATURE_REGION, FEATURES, block, FEATURE_COLUMN);
    multiply(thread, FEATURE_REGION, FEATURES, TRUNK_FORWARD, WIDTH_QUADS, START_BIAS, true, TRUNK_REGION);
    workgroupBarrier();
    keep(thread, TRUNK_REGION, WIDTH, block, TRUNK_COLUMN);
    for (var k = thread; k < WIDTH_QUADS * 4u * ROW_QUADS; k += THREADS) {
        activations[V_TRUNK_REGION + k] = vec4<f32>(0.0);
    }
    var column = HEADS_COLUMN;
    for (var head = 0u; head < HEADS; head++) {
        let at = deformation.heads[head * 2u];
        let output = deformation.heads[head * 2u + 1u];
        multiply(thread, TRUNK_REGION, WIDTH, at.z, WIDTH_QUADS, START_BIAS, true, HIDDEN_REGION);
        workgroupBarrier();
        keep(thread, HIDDEN_REGION, WIDTH, block, column);
        for (var k = thread; k < at.y * ROW_QUADS; k += THREADS) {
            var v: vec4<f32>;
            for (var lane = 0u; lane < 4u; lane++) {
                v[lane] = v_output(at.x, k / ROW_QUADS, first_row + k % ROW_QUADS * 4u + lane);
            }
            scratch[block + 1u + (column + 2u * WIDTH) * ROW_QUADS + k] = v;
        }
        workgroupBarrier();
        hidden_backward(thread, first_row, at.x, at.y, output.y);
        workgroupBarrier();
        keep(thread, HIDDEN_REGION, WIDTH, block, column + WIDTH);
        multiply(thread, HIDDEN_REGION, WIDTH, at.w, WIDTH_QUADS, START_OUTPUT, false, V_TRUNK_REGION);
        workgroupBarrier();
        column += 2u * WIDTH + at.y;
    }
    for (var k = thread; k < WIDTH * ROW_QUADS; k += THREADS) {
        activations[V_TRUNK_REGION + k] = gate(activations[V_TRUNK_REGION + k], activations[TRUNK_REGION + k]);
    }
    workgroupBarrier();
    keep(thread, V_TRUNK_REGION, WIDTH, block, V_TRUNK_COLUMN);
    multiply(thread, V_TRUNK_REGION, WIDTH, TRUNK_BACKWARD, FEATURE_COLUMNS / 4u, START_ZERO, false, FEATURE_REGION);
    workgroupBarrier();
    keep(thread, FEATURE_REGION, FEATURES, block, V_FEATURE_COLUMN);
}
