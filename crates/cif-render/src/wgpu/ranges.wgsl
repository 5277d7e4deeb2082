// From tile-sorted pairs: the range of every tile, and entries that hold all that a tile reads of a pair: its index,
// its splat and passes, its first label slot. Ranges start out as zeros. Rust twin: cpu/bin.rs, `TileLists`.

#import constants
#import numbers
#import view
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> work: array<u32>;
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(3) var<storage, read> pair_indices: array<u32>;
@group(0) @binding(4) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(5) var<storage, read_write> entries: array<vec4u>;
@group(0) @binding(6) var<storage, read_write> tile_ranges: array<vec2u>;

@compute @workgroup_size(256)
fn ranges(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let position = item_of(workgroup, local, 256u);
    let count = work[WORK_PAIRS];
    if (position >= count) {
        return;
    }
    let pair = pair_indices[position];
    entries[position] = vec4u(pair, pairs[pair], 0u);
    let tile = tile_keys[position];
    if (tile >= view.tiles.x * view.tiles.y) {
        return;
    }
    if (position == 0u || tile_keys[position - 1u] != tile) {
        tile_ranges[tile].x = position;
    }
    if (position + 1u == count || tile_keys[position + 1u] != tile) {
        tile_ranges[tile].y = position + 1u;
    }
}
