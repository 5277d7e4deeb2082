// Sums over the 64 invocations of a workgroup, in a fixed order, of what each of them leaves in workgroup memory. The
// module declares BATCH, how many splats are summed at a time, and SUMS, how many sums each of them has.

// Of every splat of the batch and sum, by invocation.
var<workgroup> partial_sums: array<f32, BATCH * SUMS * 64u>;

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
