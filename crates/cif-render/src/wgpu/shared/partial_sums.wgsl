// Sums over the 64 invocations of a workgroup, in a fixed order, of what each of them leaves in workgroup memory. The
// module declares BATCH, how many splats are summed at a time, and SUMS, how many sums each of them has. Sums by subgroups
// would take ten instructions where this takes a store and a load. Twin: partial_sums_by_subgroups.wgsl.

// Of every splat of the batch and sum, by invocation.
var<workgroup> partial_sums: array<f32, BATCH * SUMS * 64u>;

// Leaves the part of the invocation in the four sums of a splat of the batch.
fn leave_four(k: u32, values: vec4f, lane: Lane) {
    leave_from(k * SUMS * 64u + lane.local, values);
}

// In the ten sums.
fn leave_ten(k: u32, first: vec4f, second: vec4f, third: vec2f, lane: Lane) {
    let at = k * SUMS * 64u + lane.local;
    leave_from(at, first);
    leave_from(at + 256u, second);
    partial_sums[at + 512u] = third.x;
    partial_sums[at + 576u] = third.y;
}

fn leave_from(at: u32, values: vec4f) {
    partial_sums[at] = values.x;
    partial_sums[at + 64u] = values.y;
    partial_sums[at + 128u] = values.z;
    partial_sums[at + 192u] = values.w;
}

// Stores the sums of a batch. Every invocation must come here, and meet before sums are left again.
fn store_sums(lane: Lane, count: u32, batch: u32) {
    let own = lane.local / (64u / BATCH);
    let part = lane.local % (64u / BATCH);
    if (own < count && part < SUMS) {
        pair_sums[staged[batch + own].pair * PAIR_SUMS + part] = sum_of(own * SUMS + part, lane.local);
    }
}

// Over all invocations; `index` counts the sums of all splats.
fn sum_of(index: u32, local: u32) -> f32 {
    let sums = index * 64u;
    var sum = vec4f(0.0);
    // Every invocation starts at another place, so that they read from different banks of memory.
    var at = local;
    loop {
        sum += vec4f(
            partial_sums[sums + at % 64u],
            partial_sums[sums + (at + 1u) % 64u],
            partial_sums[sums + (at + 2u) % 64u],
            partial_sums[sums + (at + 3u) % 64u],
        );
        continuing {
            at += 4u;
            break if at >= local + 64u;
        }
    }
    return (sum.x + sum.y) + (sum.z + sum.w);
}

// Sums of four values over the 64 / BATCH invocations that share a splat of the batch, `own`: that by number `part` for the
// first four of them. Every invocation must come here, and meet before sums are left again.
fn sum_of_four(lane: Lane, own: u32, part: u32, values: vec4f) -> f32 {
    let at = 4u * lane.local;
    partial_sums[at] = values.x;
    partial_sums[at + 1u] = values.y;
    partial_sums[at + 2u] = values.z;
    partial_sums[at + 3u] = values.w;
    workgroupBarrier();
    var sum = 0.0;
    if (part < 4u) {
        for (var k = 0u; k < 64u / BATCH; k += 1u) {
            sum += partial_sums[4u * (64u / BATCH * own + k) + part];
        }
    }
    return sum;
}
