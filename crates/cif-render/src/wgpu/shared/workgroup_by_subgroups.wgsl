// What the invocations of a workgroup do together, by subgroups of any size, full or not, in whatever order the device
// numbers them: only their results meet in workgroup memory, and a barrier or two take the place of nine or sixteen. The
// module declares INVOCATIONS. Every invocation must come to every function. Twin: workgroup.wgsl.

struct Lane {
    local: u32,
    // The subgroup, and how many there are.
    subgroup: u32,
    subgroups: u32,
    // Invocations of the subgroup before this one.
    place: u32,
}

// By subgroup.
var<workgroup> shared_sums: array<vec4f, INVOCATIONS>;
var<workgroup> shared_counts: array<u32, INVOCATIONS>;

// Sum over the workgroup, for every invocation; in the same order each time.
fn sum_of_workgroup(lane: Lane, value: vec4f) -> vec4f {
    let own = subgroupAdd(value);
    if (lane.place == 0u) {
        shared_sums[lane.subgroup] = own;
    }
    workgroupBarrier();
    var sum = vec4f(0.0);
    for (var k = 0u; k < lane.subgroups; k += 1u) {
        sum += shared_sums[k];
    }
    workgroupBarrier();
    return sum;
}

// Place of the invocation by subgroup and then within it, where all subgroups are full: eight from a multiple of eight on
// are of one subgroup.
fn place_in_workgroup(lane: Lane) -> u32 {
    return lane.subgroup * (INVOCATIONS / lane.subgroups) + lane.place;
}

// Sum over neighbours, for each of them: those whose places differ in the bits from `low` up to below `high`.
fn sum_of_neighbours(lane: Lane, value: f32, low: u32, high: u32) -> f32 {
    var sum = value;
    for (var bit = low; bit < high; bit *= 2u) {
        sum += subgroupShuffleXor(sum, bit);
    }
    return sum;
}

// Place of the invocation in the order of `before_in_workgroup`: by subgroup, then within it.
fn rank_of(lane: Lane) -> u32 {
    let invocations = subgroupAdd(1u);
    if (lane.place == 0u) {
        shared_counts[lane.subgroup] = invocations;
    }
    workgroupBarrier();
    var rank = lane.place;
    for (var k = 0u; k < lane.subgroup; k += 1u) {
        rank += shared_counts[k];
    }
    workgroupBarrier();
    return rank;
}

fn saturating(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Sum of the values of smaller rank, and of all; saturating.
fn before_in_workgroup(lane: Lane, value: u32) -> vec2u {
    // By halves, which no subgroup overflows.
    let low = subgroupExclusiveAdd(value & 0xffffu);
    let high = subgroupExclusiveAdd(value >> 16u) + (low >> 16u);
    let left = select((high << 16u) | (low & 0xffffu), 0xffffffffu, high > 0xffffu);
    let own = subgroupMax(saturating(left, value));
    if (lane.place == 0u) {
        shared_counts[lane.subgroup] = own;
    }
    workgroupBarrier();
    var first = 0u;
    var all = 0u;
    for (var k = 0u; k < lane.subgroups; k += 1u) {
        first = select(first, all, k == lane.subgroup);
        all = saturating(all, shared_counts[k]);
    }
    workgroupBarrier();
    return vec2u(saturating(first, left), all);
}
