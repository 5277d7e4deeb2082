// Counts the tiles of every splat, takes the counts into depth order, and after their prefix sum plans the work on
// pairs: how many there are and how many workgroups they need. Rust twin: cpu/bin.rs. Source: methods reference 3.1
// (exact tile test).

#import constants
#import numbers
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> depth_order: array<u32>;
@group(0) @binding(3) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(4) var<storage, read_write> tile_counts: array<u32>;
// [N + 1] pairs, and label slots of pairs, before each rank.
@group(0) @binding(5) var<storage, read_write> pair_offsets: array<u32>;
@group(0) @binding(6) var<storage, read_write> slot_offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> work: array<atomic<u32>>;
#import tiles

// Whether the drawn ellipse holds a whole rectangle relative to the mean: it is convex, so its corners decide.
fn covers(splat: Splat, first: vec2f, last: vec2f) -> bool {
    let factor = splat.factor.xyz;
    let furthest = max(
        max(sigma_at(factor, first), sigma_at(factor, vec2f(last.x, first.y))),
        max(sigma_at(factor, vec2f(first.x, last.y)), sigma_at(factor, last)),
    );
    return furthest <= max(splat.reach.x, splat.reach.y);
}

@compute @workgroup_size(64)
fn count(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = item_of(workgroup, local, 64u);
    if (row >= view.gaussians) {
        return;
    }
    let splat = splats[row];
    var tiles = 0u;
    if (splat.radius > 0.0) {
        let range = tile_range(splat);
        let first = vec2f(range.xy * TILE) + 0.5 - splat.mean;
        let last = vec2f(range.zw * TILE) - 0.5 - splat.mean;
        if (covers(splat, first, last)) {
            tiles = (range.z - range.x) * (range.w - range.y);
        }
        for (var y = select(range.y, range.w, tiles > 0u); y < range.w; y += 1u) {
            for (var x = range.x; x < range.z; x += 1u) {
                tiles += select(0u, 1u, passes_in_tile(splat, x, y) != 0u);
            }
        }
        atomicAdd(&work[WORK_VISIBLE], 1u);
    }
    tile_counts[row] = tiles;
}

@compute @workgroup_size(64)
fn gather(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank > view.gaussians) {
        return;
    }
    var pairs = 0u;
    var slots = 0u;
    if (rank < view.gaussians) {
        let row = depth_order[rank];
        pairs = tile_counts[row];
        if (view.label_slots != 0u) {
            slots = pairs * (row_offsets[row + 1u] - row_offsets[row]);
        }
    }
    pair_offsets[rank] = pairs;
    slot_offsets[rank] = slots;
}

fn plan_workgroups(at: u32, groups: u32) {
    let x = min(groups, MAX_WORKGROUPS);
    atomicStore(&work[at], x);
    atomicStore(&work[at + 1u], (groups + max(x, 1u) - 1u) / max(x, 1u));
    atomicStore(&work[at + 2u], 1u);
}

@compute @workgroup_size(1)
fn plan() {
    let wanted_pairs = pair_offsets[view.gaussians];
    let wanted_slots = slot_offsets[view.gaussians];
    // Lists that do not fit are not drawn at all, and the host is informed.
    let fits = wanted_pairs <= view.pair_capacity && wanted_slots <= view.slot_capacity;
    let pairs = select(0u, wanted_pairs, fits);
    let sort_blocks = (pairs + SORT_BLOCK - 1u) / SORT_BLOCK;
    atomicStore(&work[WORK_WANTED_PAIRS], wanted_pairs);
    atomicStore(&work[WORK_WANTED_SLOTS], wanted_slots);
    atomicStore(&work[WORK_PAIRS], pairs);
    atomicStore(&work[WORK_DIGITS], 16u * sort_blocks);
    plan_workgroups(WORK_BY_PAIR, (pairs + 255u) / 256u);
    plan_workgroups(WORK_BY_SORT_BLOCK, sort_blocks);
    plan_workgroups(WORK_BY_DIGIT_BLOCK, (16u * sort_blocks + SCAN_BLOCK - 1u) / SCAN_BLOCK);
    // One invocation per rank, or none when the lists do not fit.
    plan_workgroups(WORK_BY_RANK, select(0u, (view.gaussians + 63u) / 64u, fits));
}
