// Carries the features' gradients of a chunk to the nodes of planes and lines and to the canonical centres, and adds
// the direct path of the geometry. Prefix and suffix products, never a division: a value may be 0. Source: methods
// reference 2.2; twins: look_up_rows_backward and scatter_plane in cpu/deform.rs, reference/deform.rs.

#import deformation
#import moment

@group(0) @binding(0) var<uniform> deformation: Deformation;
@group(0) @binding(1) var<uniform> moment: Moment;
@group(0) @binding(2) var<storage, read> canonical: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> planes: array<f32>;
@group(0) @binding(4) var<storage, read> lines: array<f32>;
@group(0) @binding(5) var<storage, read> scratch: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> v_posed: array<vec4<f32>>;
// Nodes of the planes, then of the lines.
@group(0) @binding(7) var<storage, read_write> sums: array<atomic<u32>>;
@group(0) @binding(8) var<storage, read_write> v_canonical: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> faults: array<atomic<u32>>;

#import hexplane
#import fixed_point
#import faults

// Threads per Gaussian, and Gaussians per workgroup of 64.
const LANES: u32 = 16u;
const TOGETHER: u32 = 4u;

var<workgroup> slopes: array<vec3<f32>, 64>;

// Adds a plane's gradient to its four nodes; returns d value / d (column, row) coordinates, in nodes.
fn spread(first: u32, columns: u32, column: AxisTap, row: AxisTap, v: f32) -> vec2<f32> {
    let f = column.fraction;
    let g = row.fraction;
    let next = first + columns * CHANNELS;
    add_fixed(first, (1.0 - f) * (1.0 - g) * v);
    add_fixed(first + CHANNELS, f * (1.0 - g) * v);
    add_fixed(next, (1.0 - f) * g * v);
    add_fixed(next + CHANNELS, f * g * v);
    let a = planes[first];
    let b = planes[first + CHANNELS];
    let c = planes[next];
    let d = planes[next + CHANNELS];
    return v * vec2<f32>((1.0 - g) * (b - a) + g * (d - c), (1.0 - f) * (c - a) + f * (d - b));
}

fn spread_line(first: u32, tap: AxisTap, v: f32) -> f32 {
    add_fixed(PLANE_FLOATS + first, (1.0 - tap.fraction) * v);
    add_fixed(PLANE_FLOATS + first + CHANNELS, tap.fraction * v);
    return v * (lines[first + CHANNELS] - lines[first]);
}

fn feature_backward(position: vec3<f32>, feature: u32, v_feature: f32) -> vec3<f32> {
    let taps = feature_taps(position, feature);
    var values = plane_values(taps);
    var v: array<f32, 6>;
    var running = v_feature;
    for (var k = 0u; k < 6u; k++) {
        v[k] = running;
        running *= values[k];
    }
    running = 1.0;
    for (var k = 0u; k < 6u; k++) {
        v[5u - k] *= running;
        running *= values[5u - k];
    }
    let xy = spread(taps.planes.x, taps.columns_x, taps.x, taps.y, v[0]);
    let xz = spread(taps.planes.y, taps.columns_x, taps.x, taps.z, v[1]);
    let yz = spread(taps.planes.z, taps.columns_y, taps.y, taps.z, v[2]);
    let along_x = xy.x + xz.x + spread_line(taps.lines.x, taps.x, v[3]);
    let along_y = xy.y + yz.x + spread_line(taps.lines.y, taps.y, v[4]);
    let along_z = xz.y + yz.y + spread_line(taps.lines.z, taps.z, v[5]);
    return vec3<f32>(along_x * taps.x.slope, along_y * taps.y.slope, along_z * taps.z.slope);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let local_row = (group.y * groups.x + group.x) * TOGETHER + thread / LANES;
    let row = moment.first + local_row;
    let mine = local_row < CHUNK_ROWS && row < moment.gaussians;
    let block = local_row / ROWS * BLOCK_QUADS;
    var slope = vec3<f32>(0.0);
    if mine {
        if scratch[block].x != 0.0 {
            let position = canonical[row * 3u].xyz;
            let quad = local_row % ROWS / 4u;
            for (var feature = thread % LANES; feature < FEATURES; feature += LANES) {
                let at = block + 1u + (V_FEATURE_COLUMN + feature) * ROW_QUADS + quad;
                let v_feature = scratch[at][local_row % 4u];
                // By its bits, for NaN is a fault that add_fixed finds.
                if (bitcast<u32>(v_feature) & 0x7fffffffu) != 0u {
                    slope += feature_backward(position, feature, v_feature);
                }
            }
        }
    }
    slopes[thread] = slope;
    workgroupBarrier();
    if mine && thread % LANES == 0u {
        var total = vec3<f32>(0.0);
        for (var lane = 0u; lane < LANES; lane++) {
            total += slopes[thread + lane];
        }
        var found = 0u;
        for (var k = 0u; k < 3u; k++) {
            let at = row * 3u + k;
            let sum = v_canonical[at] + v_posed[at] + select(vec4<f32>(0.0), vec4<f32>(total, 0.0), k == 0u);
            v_canonical[at] = sum;
            for (var lane = 0u; lane < 4u; lane++) {
                found |= select(0u, geometry_fault(4u * k + lane), is_beyond(sum[lane]));
            }
        }
        if found != 0u {
            atomicOr(&faults[0], found);
        }
    }
}
