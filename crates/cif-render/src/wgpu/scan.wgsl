// Exclusive prefix sum in place, saturating at 2^32 - 1 so that an overflow shows: sums of blocks, their prefix sums
// by one workgroup, then every block from its own start.

#import constants
#import numbers
#import scan_parameters
@group(0) @binding(0) var<uniform> parameters: ScanParameters;
@group(0) @binding(1) var<storage, read> work: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

var<workgroup> partial: array<u32, 256>;

fn count() -> u32 {
    if (parameters.work_element == NONE) {
        return parameters.count;
    }
    return work[parameters.work_element];
}

fn saturating(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Inclusive over the workgroup; returns what lies before the invocation.
fn before(local: u32, value: u32) -> u32 {
    partial[local] = value;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var left = 0u;
        if (local >= step) {
            left = partial[local - step];
        }
        workgroupBarrier();
        partial[local] = saturating(partial[local], left);
        workgroupBarrier();
    }
    return select(0u, partial[max(local, 1u) - 1u], local > 0u);
}

// Sum of the four values of an invocation.
fn own_sum(block: u32, local: u32, total: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        let index = block * SCAN_BLOCK + local * 4u + k;
        if (index < total) {
            sum = saturating(sum, values[index]);
        }
    }
    return sum;
}

@compute @workgroup_size(256)
fn reduce(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    let sum = own_sum(block, local, total);
    let left = before(local, sum);
    if (local == 255u && block * SCAN_BLOCK < total) {
        sums[block] = saturating(left, sum);
    }
}

@compute @workgroup_size(256)
fn spine(@builtin(local_invocation_index) local: u32) {
    let blocks = (count() + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    var carry = 0u;
    for (var first = 0u; first < blocks; first += 256u) {
        let index = first + local;
        var sum = 0u;
        if (index < blocks) {
            sum = sums[index];
        }
        let left = before(local, sum);
        if (index < blocks) {
            sums[index] = saturating(carry, left);
        }
        carry = saturating(carry, partial[255]);
        workgroupBarrier();
    }
}

@compute @workgroup_size(256)
fn spread(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    let sum = own_sum(block, local, total);
    var running = before(local, sum);
    if (block * SCAN_BLOCK < total) {
        running = saturating(running, sums[block]);
    }
    for (var k = 0u; k < 4u; k += 1u) {
        let index = block * SCAN_BLOCK + local * 4u + k;
        if (index < total) {
            let value = values[index];
            values[index] = running;
            running = saturating(running, value);
        }
    }
}
