// Known numbers through everything that a workgroup does together, for the host to compare. Rust twin: workgroup.rs,
// `differences`.

@group(0) @binding(0) var<storage, read_write> found: array<vec4u>;

const INVOCATIONS: u32 = 256u;
#import workgroup

@compute @workgroup_size(256)
fn self_check(
    #paste lane_builtins
) {
    #paste lane
    let rank = rank_of(lane);
    // As long as the number says, so that invocations have to come together again.
    var number = 0.0;
    for (var k = 0u; k < local; k += 1u) {
        number += 1.0;
    }
    // Exact in single precision, in any order.
    let sum = sum_of_workgroup(lane, vec4f(number, 1.0, 0.25 * f32(local % 7u), -number * number));
    let small = before_in_workgroup(lane, 3u * rank + 1u);
    // Overflows shortly before the end.
    let large = before_in_workgroup(lane, 0x01010101u + rank);
    let place = place_in_workgroup(lane);
    let neighbours = sum_of_neighbours(lane, f32(place), 1u, 8u);
    found[3u * local] = bitcast<vec4u>(sum);
    found[3u * local + 1u] = vec4u(rank, small, large.x);
    found[3u * local + 2u] = vec4u(large.y, place, bitcast<u32>(neighbours), 0u);
}
