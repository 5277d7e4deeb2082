// The optimiser's step of the hexplanes with the gradient of their regularisers, in one sweep. A thread goes down one
// column of one plane, so that it meets the old values of the rows above and below. Rust twin: adam/planes.rs. Source:
// methods reference 1.4 and 11 (idea 13).

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

@compute @workgroup_size(64)
fn adam_planes(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let column = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    if column >= rates.columns {
        return;
    }
    var plane = 0u;
    while plane + 1u < rates.planes && column >= places[2u * plane + 2u].w {
        plane++;
    }
    let place = places[2u * plane];
    let smooth_factor = bitcast<f32>(places[2u * plane + 1u].x);
    let sparse_factor = bitcast<f32>(places[2u * plane + 1u].y);
    let first = place.x + column - place.w;
    let row_len = place.z;
    var above_2 = 0.0;
    var above_1 = 0.0;
    var current = planes[first];
    var below_1 = planes[first + min(1u, place.y - 1u) * row_len];
    let moves = rates.rate > 0.0 && atomicLoad(&faults[1]) == 0u;
    for (var row = 0u; row < place.y; row++) {
        let at = first + row * row_len;
        let below_2 = planes[first + min(row + 2u, place.y - 1u) * row_len];
        var g = take_fixed(at);
        // Whether the second difference starting at this row, one above, two above exists.
        if row + 2u < place.y {
            g += smooth_factor * (below_2 - 2.0 * below_1 + current);
        }
        if row >= 1u && row + 1u < place.y {
            g += -2.0 * smooth_factor * (below_1 - 2.0 * current + above_1);
        }
        if row >= 2u {
            g += smooth_factor * (current - 2.0 * above_1 + above_2);
        }
        g += sparse_factor * (select(0.0, 1.0, current > 1.0) - select(0.0, 1.0, current < 1.0));
        if moves {
            let moved = move_by(current, g, first_moments[at], second_moments[at], rates.rate, rates.second);
            planes[at] = moved.parameter;
            first_moments[at] = moved.first;
            second_moments[at] = moved.second;
        }
        above_2 = above_1;
        above_1 = current;
        current = below_1;
        below_1 = below_2;
    }
}
