// One pass of a stable radix sort by 4 bits of 32-bit keys, each with a value: counts per block and digit, then every
// element to its place, by a prefix sum of the counts, digit by digit: where there are few blocks each of them adds up
// what lies before it, else the prefix sum has been made before. Rust twin: cpu/bin.rs, `sort_by_depth`, and
// the counting sort of `TileLists::build`.

#import constants
#import numbers
#import sort_parameters
@group(0) @binding(0) var<uniform> parameters: SortParameters;
@group(0) @binding(1) var<storage, read> work: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_values: array<u32>;

const ITEMS: u32 = SORT_BLOCK / 256u;

// Digits 2 w and 2 w + 1 of word w share 32 bits: a block has fewer than 2^16 elements.
var<workgroup> packed: array<u32, 2048>;
var<workgroup> chunks: array<u32, 256>;

fn count() -> u32 {
    if (parameters.work_element == NONE) {
        return parameters.count;
    }
    return work[parameters.work_element];
}

fn digit_of(key: u32) -> u32 {
    return (key >> parameters.shift) & 15u;
}

// Counts the digits of an invocation's elements into `packed[word * 256 + invocation]`.
fn count_own(first: u32, total: u32, local: u32) {
    for (var word = 0u; word < 8u; word += 1u) {
        packed[word * 256u + local] = 0u;
    }
    for (var k = 0u; k < ITEMS; k += 1u) {
        let index = first + local * ITEMS + k;
        if (index < total) {
            let digit = digit_of(keys[index]);
            packed[(digit >> 1u) * 256u + local] += 1u << ((digit & 1u) * 16u);
        }
    }
}

// Sums of eight neighbouring invocations: `chunks[word * 32 + chunk]`, one per invocation.
fn sum_chunk(local: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < 8u; k += 1u) {
        sum += packed[local * 8u + k];
    }
    return sum;
}

@compute @workgroup_size(256)
fn histogram(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    let blocks = (total + SORT_BLOCK - 1u) / SORT_BLOCK;
    count_own(block * SORT_BLOCK, total, local);
    workgroupBarrier();
    chunks[local] = sum_chunk(local);
    workgroupBarrier();
    if (local < 16u && block < blocks) {
        var sum = 0u;
        for (var k = 0u; k < 32u; k += 1u) {
            sum += chunks[(local >> 1u) * 32u + k];
        }
        counts[local * blocks + block] = (sum >> ((local & 1u) * 16u)) & 0xffffu;
    }
}

// First place of the block's elements, by digit.
var<workgroup> starts: array<u32, 16>;

// Elements before this block's with the same digit or a smaller one, from the counts. Every invocation must come here.
fn find_starts(block: u32, blocks: u32, local: u32) {
    if (parameters.is_summed != 0u) {
        if (local < 16u && block < blocks) {
            starts[local] = counts[local * blocks + block];
        }
        return;
    }
    // Sixteen invocations per digit: its elements, and those of the blocks before.
    var all = 0u;
    var before = 0u;
    for (var other = local & 15u; other < blocks; other += 16u) {
        let elements = counts[(local >> 4u) * blocks + other];
        all += elements;
        before += select(0u, elements, other < block);
    }
    packed[local] = all;
    packed[256u + local] = before;
    workgroupBarrier();
    if (local < 16u) {
        all = 0u;
        before = 0u;
        for (var k = 0u; k < 16u; k += 1u) {
            all += packed[16u * local + k];
            before += packed[256u + 16u * local + k];
        }
        chunks[local] = all;
        starts[local] = before;
    }
    workgroupBarrier();
    if (local < 16u) {
        var start = starts[local];
        for (var digit = 0u; digit < local; digit += 1u) {
            start += chunks[digit];
        }
        starts[local] = start;
    }
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let block = item_of(workgroup, 0u, 1u);
    let total = count();
    let blocks = (total + SORT_BLOCK - 1u) / SORT_BLOCK;
    let first = block * SORT_BLOCK;
    find_starts(block, blocks, local);
    count_own(first, total, local);
    workgroupBarrier();
    chunks[local] = sum_chunk(local);
    workgroupBarrier();
    // What lies before each invocation of the block, per digit.
    var running = 0u;
    for (var k = local & ~31u; k < local; k += 1u) {
        running += chunks[k];
    }
    for (var k = 0u; k < 8u; k += 1u) {
        let own = packed[local * 8u + k];
        packed[local * 8u + k] = running;
        running += own;
    }
    workgroupBarrier();
    for (var k = 0u; k < ITEMS; k += 1u) {
        let index = first + local * ITEMS + k;
        if (index < total) {
            let key = keys[index];
            let digit = digit_of(key);
            let word = (digit >> 1u) * 256u + local;
            let half = (digit & 1u) * 16u;
            let place = starts[digit] + ((packed[word] >> half) & 0xffffu);
            packed[word] += 1u << half;
            sorted_keys[place] = key;
            sorted_values[place] = values[index];
        }
    }
}
