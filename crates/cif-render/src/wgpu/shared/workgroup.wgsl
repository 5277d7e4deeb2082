// What the invocations of a workgroup do together, through workgroup memory. The module declares INVOCATIONS, how many
// they are. Every invocation must come to every function. Twin: workgroup_by_subgroups.wgsl.

struct Lane {
    local: u32,
}

var<workgroup> shared_sums: array<vec4f, INVOCATIONS>;
var<workgroup> shared_counts: array<u32, INVOCATIONS>;

// Sum over the workgroup, for every invocation; in the same order each time.
fn sum_of_workgroup(lane: Lane, value: vec4f) -> vec4f {
    shared_sums[lane.local] = value;
    workgroupBarrier();
    for (var half = INVOCATIONS / 2u; half > 0u; half /= 2u) {
        if (lane.local < half) {
            shared_sums[lane.local] += shared_sums[lane.local + half];
        }
        workgroupBarrier();
    }
    let sum = shared_sums[0];
    workgroupBarrier();
    return sum;
}

// Place of the invocation.
fn place_in_workgroup(lane: Lane) -> u32 {
    return lane.local;
}

// Sum over neighbours, for each of them: those whose places differ in the bits from `low` up to below `high`.
fn sum_of_neighbours(lane: Lane, value: f32, low: u32, high: u32) -> f32 {
    var sum = value;
    for (var bit = low; bit < high; bit *= 2u) {
        shared_sums[lane.local].x = sum;
        workgroupBarrier();
        sum += shared_sums[lane.local ^ bit].x;
        workgroupBarrier();
    }
    return sum;
}

// Place of the invocation in the order of `before_in_workgroup`.
fn rank_of(lane: Lane) -> u32 {
    return lane.local;
}

fn saturating(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Sum of the values of smaller rank, and of all; saturating.
fn before_in_workgroup(lane: Lane, value: u32) -> vec2u {
    shared_counts[lane.local] = value;
    workgroupBarrier();
    for (var step = 1u; step < INVOCATIONS; step *= 2u) {
        var left = 0u;
        if (lane.local >= step) {
            left = shared_counts[lane.local - step];
        }
        workgroupBarrier();
        shared_counts[lane.local] = saturating(shared_counts[lane.local], left);
        workgroupBarrier();
    }
    let left = select(0u, shared_counts[max(lane.local, 1u) - 1u], lane.local > 0u);
    let all = shared_counts[INVOCATIONS - 1u];
    workgroupBarrier();
    return vec2u(left, all);
}
