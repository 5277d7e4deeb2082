// Sums over the 256 invocations of a workgroup: over eight neighbours of a subgroup first, each of which ends with one or
// two of the sums, then through workgroup memory. The module declares BATCH and SUMS, 4 or 10. Twin: partial_sums.wgsl.

// Of every splat of the batch and sum, by eight invocations.
var<workgroup> partial_sums: array<f32, BATCH * SUMS * 32u>;

// Sums of four values over four neighbours; each of them ends with one, see `quarter`.
fn quarter_of_four(values: vec4f, place: u32) -> f32 {
    let is_odd = (place & 1u) != 0u;
    let halves = select(values.xy, values.zw, is_odd)
        + subgroupShuffleXor(select(values.zw, values.xy, is_odd), 1u);
    let is_second = (place & 2u) != 0u;
    return select(halves.x, halves.y, is_second)
        + subgroupShuffleXor(select(halves.y, halves.x, is_second), 2u);
}

// Which of the four.
fn quarter(place: u32) -> u32 {
    return 2u * (place & 1u) + ((place >> 1u) & 1u);
}

// Leaves the part of the invocation in the four sums of a splat of the batch. Every invocation of the subgroup must come
// here; where none has a part, by the bits, nothing is added up.
fn leave_four(k: u32, values: vec4f, lane: Lane) {
    let place = place_in_workgroup(lane);
    var sum = 0.0;
    if (subgroupAny(any(bitcast<vec4u>(values) != vec4u(0u)))) {
        sum = sum_of_neighbours(lane, quarter_of_four(values, place), 4u, 8u);
    }
    if ((place & 4u) == 0u) {
        partial_sums[(k * SUMS + quarter(place)) * 32u + place / 8u] = sum;
    }
}

// In the ten sums.
fn leave_ten(k: u32, first: vec4f, second: vec4f, third: vec2f, lane: Lane) {
    let place = place_in_workgroup(lane);
    let is_odd = (place & 1u) != 0u;
    let is_second = (place & 2u) != 0u;
    let is_upper = (place & 4u) != 0u;
    var sum = 0.0;
    var last = 0.0;
    let bits = bitcast<vec4u>(first) | bitcast<vec4u>(second) | bitcast<vec2u>(third).xyxy;
    if (subgroupAny(any(bits != vec4u(0u)))) {
        let halves = select(first, second, is_odd)
            + subgroupShuffleXor(select(second, first, is_odd), 1u);
        let quarters = select(halves.xy, halves.zw, is_second)
            + subgroupShuffleXor(select(halves.zw, halves.xy, is_second), 2u);
        sum = select(quarters.x, quarters.y, is_upper)
            + subgroupShuffleXor(select(quarters.y, quarters.x, is_upper), 4u);
        last = select(third.x, third.y, is_odd) + subgroupShuffleXor(select(third.y, third.x, is_odd), 1u);
        last = sum_of_neighbours(lane, last, 2u, 8u);
    }
    let own = 4u * (place & 1u) + (place & 2u) + ((place >> 2u) & 1u);
    partial_sums[(k * SUMS + own) * 32u + place / 8u] = sum;
    if ((place & 6u) == 0u) {
        partial_sums[(k * SUMS + 8u + (place & 1u)) * 32u + place / 8u] = last;
    }
}

// Stores the sums of a batch. Every invocation must come here, and meet before sums are left again.
fn store_sums(lane: Lane, count: u32, batch: u32) {
    let place = place_in_workgroup(lane);
    let own = place / (INVOCATIONS / BATCH);
    let part = place % (INVOCATIONS / BATCH);
    // Two neighbours take a half of a sum each, every sum from another place on, so that they read from different banks of
    // memory.
    let index = part / 2u;
    let takes = own < count && index < SUMS;
    var sum = 0.0;
    if (takes) {
        let first = (own * SUMS + index) * 32u + 16u * (part % 2u);
        for (var k = 0u; k < 16u; k += 1u) {
            sum += partial_sums[first + (k + index) % 16u];
        }
    }
    sum = sum_of_neighbours(lane, sum, 1u, 2u);
    if (takes && part % 2u == 0u) {
        pair_sums[staged[batch + own].pair * PAIR_SUMS + index] = sum;
    }
}

// Sums of four values over the INVOCATIONS / BATCH invocations that share a splat of the batch, `own`: that by number `part`
// for the first four of them. Every invocation must come here, and meet before sums are left again.
fn sum_of_four(lane: Lane, own: u32, part: u32, values: vec4f) -> f32 {
    let size = INVOCATIONS / lane.subgroups;
    let place = place_in_workgroup(lane);
    let sum = sum_of_neighbours(lane, quarter_of_four(values, place), 4u, min(size, INVOCATIONS / BATCH));
    let parts = max(INVOCATIONS / BATCH / size, 1u);
    if (part % size < 4u) {
        partial_sums[4u * (own * parts + part / size) + quarter(place)] = sum;
    }
    workgroupBarrier();
    var total = 0.0;
    if (part < 4u) {
        for (var k = 0u; k < parts; k += 1u) {
            total += partial_sums[4u * (own * parts + k) + part];
        }
    }
    return total;
}
