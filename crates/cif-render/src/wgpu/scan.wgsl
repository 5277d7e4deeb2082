// Exclusive prefix sum in place, saturating at 2^32 - 1 so that an overflow shows: sums of blocks, their prefix sums
// by one workgroup, then every block from its own start.

#import constants
#import numbers
#import scan_parameters
@group(0) @binding(0) var<uniform> parameters: ScanParameters;
@group(0) @binding(1) var<storage, read> work: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

const INVOCATIONS: u32 = 256u;
#import workgroup

fn count() -> u32 {
    if (parameters.work_element == NONE) {
        return parameters.count;
    }
    return work[parameters.work_element];
}

// Sum of the four values of a rank.
fn own_sum(block: u32, rank: u32, total: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        let index = block * SCAN_BLOCK + rank * 4u + k;
        if (index < total) {
            sum = saturating(sum, values[index]);
        }
    }
    return sum;
}

@compute @workgroup_size(256)
fn reduce(
    @builtin(workgroup_id) workgroup: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    // The sum of all is the same in any order.
    let sums_before = before_in_workgroup(lane, own_sum(block, local, total));
    if (local == 0u && block * SCAN_BLOCK < total) {
        sums[block] = sums_before.y;
    }
}

@compute @workgroup_size(256)
fn spine(
    #paste lane_builtins
) {
    #paste lane
    let rank = rank_of(lane);
    let blocks = (count() + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    var carry = 0u;
    for (var first = 0u; first < blocks; first += 256u) {
        let index = first + rank;
        var sum = 0u;
        if (index < blocks) {
            sum = sums[index];
        }
        let sums_before = before_in_workgroup(lane, sum);
        if (index < blocks) {
            sums[index] = saturating(carry, sums_before.x);
        }
        carry = saturating(carry, sums_before.y);
    }
}

@compute @workgroup_size(256)
fn spread(
    @builtin(workgroup_id) workgroup: vec3u,
    #paste lane_builtins
) {
    #paste lane
    let rank = rank_of(lane);
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    let sum = own_sum(block, rank, total);
    var running = before_in_workgroup(lane, sum).x;
    if (block * SCAN_BLOCK < total) {
        running = saturating(running, sums[block]);
    }
    for (var k = 0u; k < 4u; k += 1u) {
        let index = block * SCAN_BLOCK + rank * 4u + k;
        if (index < total) {
            let value = values[index];
            values[index] = running;
            running = saturating(running, value);
        }
    }
}
