// The optimiser's step of the hexplanes with the gradient of their regularisers, in two sweeps: the first adds up the
// gradient of every node, for which it reads nodes of the rows above and below, the second moves the nodes. A thread goes
// down a column for a band of BAND rows. Rust twin: adam/planes.rs. Source: methods reference 1.4 and 11 (idea 13).

#import constants
#import plane_rates

@group(0) @binding(0) var<uniform> rates: PlaneRates;
@group(0) @binding(1) var<storage, read_write> planes: array<f32>;
@group(0) @binding(2) var<storage, read_write> sums: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read_write> first_moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> second_moments: array<f32>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(5) var<storage, read_write> faults: array<atomic<u32>>;

// Two per plane: first float, rows, floats per row and first column; bits of the gradient factors of the second
// difference and of the distance from 1.
@group(0) @binding(6) var<storage, read> places: array<vec4u>;

#import fixed_point
#import adam

// The part of a column that a thread goes down.
struct Band {
    // First float of the column, floats from a row to the next, and rows of the plane.
    first: u32,
    row_len: u32,
    rows: u32,
    // Rows of the band, empty where the plane has no more.
    begin: u32,
    end: u32,
    // Places and factors of the plane.
    plane: u32,
}

fn band_of(group: vec3u, local: u32) -> Band {
    let item = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    let column = item % rates.columns;
    let begin = item / rates.columns * BAND;
    var plane = 0u;
    while plane + 1u < rates.planes && column >= places[2u * plane + 2u].w {
        plane++;
    }
    let place = places[2u * plane];
    return Band(place.x + column - place.w, place.z, place.y, begin, min(begin + BAND, place.y), plane);
}

// Node of a row, of the nearest one where there is none; its value then does not matter.
fn node(band: Band, row: u32) -> f32 {
    return planes[band.first + min(row, band.rows - 1u) * band.row_len];
}

@compute @workgroup_size(64)
fn add_up(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let band = band_of(group, local);
    if band.begin >= band.end {
        return;
    }
    let smooth_factor = bitcast<f32>(places[2u * band.plane + 1u].x);
    let sparse_factor = bitcast<f32>(places[2u * band.plane + 1u].y);
    var above_2 = node(band, max(band.begin, 2u) - 2u);
    var above_1 = node(band, max(band.begin, 1u) - 1u);
    var current = node(band, band.begin);
    var below_1 = node(band, band.begin + 1u);
    for (var row = band.begin; row < band.end; row++) {
        let at = band.first + row * band.row_len;
        let below_2 = node(band, row + 2u);
        var g = fixed_sum(at);
        // Whether the second difference starting at this row, one above, two above exists.
        if row + 2u < band.rows {
            g += smooth_factor * (below_2 - 2.0 * below_1 + current);
        }
        if row >= 1u && row + 1u < band.rows {
            g += -2.0 * smooth_factor * (below_1 - 2.0 * current + above_1);
        }
        if row >= 2u {
            g += smooth_factor * (current - 2.0 * above_1 + above_2);
        }
        g += sparse_factor * (select(0.0, 1.0, current > 1.0) - select(0.0, 1.0, current < 1.0));
        // For the second sweep, in the place of the sum.
        atomicStore(&sums[2u * at], bitcast<u32>(g));
        above_2 = above_1;
        above_1 = current;
        current = below_1;
        below_1 = below_2;
    }
}

@compute @workgroup_size(64)
fn move_nodes(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let band = band_of(group, local);
    let moves = rates.rate > 0.0 && atomicLoad(&faults[1]) == 0u;
    for (var row = band.begin; row < band.end; row++) {
        let at = band.first + row * band.row_len;
        let g = bitcast<f32>(atomicLoad(&sums[2u * at]));
        clear_fixed(at);
        if moves {
            let moved =
                move_by(planes[at], g, first_moments[at], second_moments[at], rates.rate, rates.second);
            planes[at] = moved.parameter;
            first_moments[at] = moved.first;
            second_moments[at] = moved.second;
        }
    }
}
