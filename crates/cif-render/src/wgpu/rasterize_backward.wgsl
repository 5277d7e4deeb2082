// Gradient of a tile, front to back: transmittances are replayed as the forward pass made them and never divided.
// See tile_backward for how it is summed. Rust twin: cpu/rasterize_backward.rs. Source: methods reference 3.2, 4.2.
//
// A pair's ten sums, with u = L d: v_sigma u0, v_sigma u1 (mean); v_sigma u0 u0, u0 u1, u1 u1 (covariance); v_colour;
// v_sigma of colour; weighted q. And per entry of its identity row the weighted responsibility for that label.

#import constants
#import variant
@group(0) @binding(4) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> identities: array<vec2u>;
@group(0) @binding(6) var<storage, read> cotangents: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> pair_sums: array<f32>;
@group(0) @binding(8) var<storage, read_write> label_mass: array<f32>;
#import identity

// Splats that are summed at a time, as many as workgroup memory holds, and their sums.
const BATCH: u32 = select(4u, 8u, INVOCATIONS > 64u && !WITH_INSTANCES);
const SUMS: u32 = GRADIENT_SUMS;
const WITH_LABELS: bool = WITH_INSTANCES;
#import tile_backward

// Weighted r of every splat of the batch, by pixel.
var<workgroup> responsibilities: array<f32, select(1u, BATCH * 256u, WITH_INSTANCES)>;
// Invocations that sum the responsibilities of a splat.
const PARTS: u32 = INVOCATIONS / BATCH;

struct Pixel {
    centre: vec2f,
    // Passes that still let light through.
    open: u32,
    label: u32,
    v_color: vec3f,
    // Q - E_i, and colour transmittance.
    remainder: f32,
    transmittance: f32,
    instance_transmittance: f32,
    // 1 - c_i, 1 / M_y, S_end / A.
    hidden: f32,
    inverse: f32,
    ratio: f32,
    // Position in the list of the tile after the last splat that supports the label.
    supported: u32,
}

struct Sums {
    // Moments 0, 1, 00, 01.
    first: vec4f,
    // 11, v_colour.
    second: vec4f,
    // v_sigma of colour, weighted q.
    third: vec2f,
}

fn pixel_of(tile: vec2u, quadrant: u32, local: u32) -> Pixel {
    var p: Pixel;
    let at = pixel_in_quadrant(tile, quadrant, local);
    p.centre = vec2f(at) + 0.5;
    p.transmittance = 1.0;
    p.instance_transmittance = 1.0;
    p.hidden = 1.0;
    if (all(at < view.size)) {
        let position = at.y * view.size.x + at.x;
        let color = cotangents[2u * position];
        let instance = cotangents[2u * position + 1u];
        p.v_color = color.xyz;
        p.remainder = color.w;
        p.inverse = instance.x;
        p.ratio = instance.y;
        p.label = u32(instance.z);
        p.supported = u32(instance.w);
        p.open = COLOR_PASS | select(0u, INSTANCE_PASS, WITH_INSTANCES && p.inverse > 0.0);
    }
    return p;
}

// What a splat does to a pixel at u: T alpha, v_sigma of colour, weighted q, weighted r; steps the pixel.
fn replay(
    splat: Staged,
    passes: u32,
    identity: f32,
    behind: u32,
    u: vec2f,
    p: ptr<function, Pixel>,
) -> vec4f {
    var shares_of_pixel = vec4f(0.0);
    let open = passes & (*p).open;
    if (open == 0u) {
        return shares_of_pixel;
    }
    let peak = exp(-0.5 * dot(u, u));
    if ((open & COLOR_PASS) != 0u) {
        let unclamped = splat.factor.w * peak;
        let alpha = min(MAX_ALPHA, unclamped);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).transmittance * alpha;
            let next = (*p).transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~COLOR_PASS;
            } else {
                let e = dot((*p).v_color, splat.color.xyz);
                (*p).remainder -= weight * e;
                shares_of_pixel.x = weight;
                if (unclamped <= MAX_ALPHA) {
                    let v_alpha = (*p).transmittance * e - (*p).remainder / (1.0 - alpha);
                    shares_of_pixel.y = -alpha * v_alpha;
                }
                (*p).transmittance = next;
            }
        }
    }
    if (WITH_INSTANCES && (open & INSTANCE_PASS) != 0u) {
        let unclamped = splat.color.w * peak;
        let alpha = min(MAX_ALPHA, unclamped);
        if (alpha >= MIN_ALPHA) {
            let weight = (*p).instance_transmittance * alpha;
            let next = (*p).instance_transmittance - weight;
            if (next < MIN_TRANSMITTANCE) {
                (*p).open &= ~INSTANCE_PASS;
            } else {
                let r = weight * (identity * (*p).inverse);
                // 1 - c_i, clamped against rounding at the tail.
                (*p).hidden = max((*p).hidden - r, 0.0);
                if (unclamped <= MAX_ALPHA) {
                    let q = r - alpha * ((*p).hidden + (*p).ratio) / (1.0 - alpha);
                    shares_of_pixel.z = q * view.pixel_weight;
                }
                shares_of_pixel.w = r * view.pixel_weight;
                (*p).instance_transmittance = next;
                // Nothing behind supports the label.
                if (view.coverage_normalised == 0u && behind >= (*p).supported) {
                    (*p).open &= ~INSTANCE_PASS;
                }
            }
        }
    }
    return shares_of_pixel;
}

// Adds what a splat does to a pixel to its sums; returns the weighted r.
fn add(
    splat: Staged,
    values: vec4f,
    quadrant: u32,
    passes: u32,
    behind: u32,
    p: ptr<function, Pixel>,
    sums: ptr<function, Sums>,
) -> f32 {
    let u = whitened(splat.factor.xyz, splat.mean - (*p).centre);
    let share = replay(splat, passes, values[quadrant], behind, u, p);
    let v_mean = share.y + view.mean_geometry * share.z;
    let v_covariance = share.y + view.full_geometry * share.z;
    (*sums).first += vec4f(v_mean * u, v_covariance * u.x * u);
    (*sums).second += vec4f(v_covariance * u.y * u.y, share.x * (*p).v_color);
    (*sums).third += share.yz;
    return share.w;
}

// Sum of the values of the pixels that have a label.
fn of_label(label: u32, labels: vec4u, values: vec4f) -> f32 {
    let own = select(vec4f(0.0), values, labels == vec4u(label));
    return own.x + own.y + own.z + own.w;
}

// Label mass of the batch, from the responsibilities of all invocations: of four entries of every row at a time. Every
// invocation of the workgroup must come here.
fn sum_responsibilities(lane: Lane, count: u32, batch: u32, longest_row: u32) {
    let own = place_in_workgroup(lane) / PARTS;
    let part = place_in_workgroup(lane) % PARTS;
    let splat = batch + own;
    var entry = 0u;
    loop {
        let row_first = staged[splat].row_first + entry;
        let row_end = select(0u, staged[splat].row_end, own < count);
        var mass = vec4f(0.0);
        if (row_first < row_end) {
            let last = row_end - 1u;
            let row_labels = vec4u(
                identities[row_first].x,
                identities[min(row_first + 1u, last)].x,
                identities[min(row_first + 2u, last)].x,
                identities[min(row_first + 3u, last)].x,
            ) + 1u;
            // Of the pixels of four invocations.
            var at = part;
            loop {
                let first = own * 256u + 4u * at;
                let values = vec4f(
                    responsibilities[first],
                    responsibilities[first + 1u],
                    responsibilities[first + 2u],
                    responsibilities[first + 3u],
                );
                let found = labels_at(at);
                mass += vec4f(
                    of_label(row_labels.x, found, values),
                    of_label(row_labels.y, found, values),
                    of_label(row_labels.z, found, values),
                    of_label(row_labels.w, found, values),
                );
                continuing {
                    at += PARTS;
                    break if at >= 64u;
                }
            }
        }
        let sum = sum_of_four(lane, own, part, mass);
        if (part < 4u && row_first + part < row_end) {
            label_mass[staged[splat].slot + entry + part] = sum;
        }
        workgroupBarrier();
        continuing {
            entry += 4u;
            break if entry >= longest_row;
        }
    }
}

fn clear_row(entry: vec4u) {
    if (WITH_INSTANCES) {
        let row = row_range(entry.y & INDEX_MASK);
        for (var k = 0u; k < row.y - row.x; k += 1u) {
            label_mass[entry.z + k] = 0.0;
        }
    }
}

fn longest_of_rows() -> u32 {
    if (!WITH_INSTANCES) {
        return 0u;
    }
    return workgroupUniformLoad(&longest);
}

fn leave(sums: Sums, k: u32, lane: Lane) {
    leave_ten(k, sums.first, sums.second, sums.third, lane);
}

fn keep_responsibility(responsibility: f32, k: u32, pixel: u32) {
    if (WITH_INSTANCES) {
        responsibilities[256u * k + pixel] = responsibility;
    }
}

@compute @workgroup_size(INVOCATIONS)
fn rasterize_backward(
    @builtin(workgroup_id) workgroup: vec3u,
    #paste lane_builtins
) {
    #paste lane
    differentiate_tile(workgroup, lane);
}
