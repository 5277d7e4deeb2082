// Sums over the 256 invocations of a workgroup: over four neighbours of a subgroup first, each of which ends with some of
// the sums, then through workgroup memory. The module declares BATCH and SUMS, 4 or 10. Twin: partial_sums.wgsl.

// Of every splat of the batch and sum, by four invocations.
var<workgroup> partial_sums: array<f32, BATCH * SUMS * 64u>;

// Sums of four values over four neighbours; each of them ends with one.
fn quarter_of_four(values: vec4f, place: u32) -> f32 {
    let is_odd = (place & 1u) != 0u;
    let halves = select(values.xy, values.zw, is_odd)
        + subgroupShuffleXor(select(values.zw, values.xy, is_odd), 1u);
    let is_second = (place & 2u) != 0u;
    return select(halves.x, halves.y, is_second)
        + subgroupShuffleXor(select(halves.y, halves.x, is_second), 2u);
}

// Leaves the part of the invocation in the four sums of a splat of the batch. Every invocation of the subgroup must come
// here; where none has a part, by the bits, nothing is added up.
fn leave_four(k: u32, values: vec4f, lane: Lane) {
    let place = place_in_workgroup(lane);
    var sum = 0.0;
    if (subgroupAny(any(bitcast<vec4u>(values) != vec4u(0u)))) {
        sum = quarter_of_four(values, place);
    }
    let own = 2u * (place & 1u) + ((place >> 1u) & 1u);
    partial_sums[(k * SUMS + own) * 64u + place / 4u] = sum;
}

// In the ten sums.
fn leave_ten(k: u32, first: vec4f, second: vec4f, third: vec2f, lane: Lane) {
    let place = place_in_workgroup(lane);
    let is_odd = (place & 1u) != 0u;
    let is_second = (place & 2u) != 0u;
    var sums = vec2f(0.0);
    var last = 0.0;
    let bits = bitcast<vec4u>(first) | bitcast<vec4u>(second) | bitcast<vec2u>(third).xyxy;
    if (subgroupAny(any(bits != vec4u(0u)))) {
        let halves = select(first, second, is_odd)
            + subgroupShuffleXor(select(second, first, is_odd), 1u);
        sums = select(halves.xy, halves.zw, is_second)
            + subgroupShuffleXor(select(halves.zw, halves.xy, is_second), 2u);
        last = select(third.x, third.y, is_odd) + subgroupShuffleXor(select(third.y, third.x, is_odd), 1u);
        last += subgroupShuffleXor(last, 2u);
    }
    let at = (k * SUMS + 4u * (place & 1u) + (place & 2u)) * 64u + place / 4u;
    partial_sums[at] = sums.x;
    partial_sums[at + 64u] = sums.y;
    if (!is_second) {
        partial_sums[(k * SUMS + 8u + (place & 1u)) * 64u + place / 4u] = last;
    }
}

// Stores the sums of a batch. Every invocation must come here, and meet before sums are left again.
fn store_sums(lane: Lane, count: u32, batch: u32) {
    let place = place_in_workgroup(lane);
    let own = place / (INVOCATIONS / BATCH);
    let part = place % (INVOCATIONS / BATCH);
    // Four neighbours take a quarter of a sum each, every sum from another place on, so that they read from different
    // banks of memory.
    let index = part / 4u;
    let takes = own < count && index < SUMS;
    var sum = 0.0;
    if (takes) {
        let first = (own * SUMS + index) * 64u + 16u * (part % 4u);
        for (var k = 0u; k < 16u; k += 1u) {
            sum += partial_sums[first + (k + index) % 16u];
        }
    }
    sum = sum_of_neighbours(lane, sum);
    if (takes && part % 4u == 0u) {
        pair_sums[staged[batch + own].pair * PAIR_SUMS + index] = sum;
    }
}
