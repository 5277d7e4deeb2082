// Writes the (tile, splat) pairs of every splat, front to back: the tile as sort key, the pair's own index as value,
// and for each pair its splat with the passes that draw it there and the first of its label slots. The count of a
// splat's pairs decides; should rounding ever find fewer tiles than were counted, the rest go behind the last tile.
// Rust twin: cpu/bin.rs, `TileLists::build`.

#import constants
#import numbers
#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> depth_order: array<u32>;
@group(0) @binding(3) var<storage, read> pair_offsets: array<u32>;
@group(0) @binding(4) var<storage, read> slot_offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> pair_indices: array<u32>;
@group(0) @binding(7) var<storage, read_write> pairs: array<vec2u>;
#import tiles

@compute @workgroup_size(64)
fn emit(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
    let rank = item_of(workgroup, local, 64u);
    if (rank >= view.gaussians) {
        return;
    }
    var pair = pair_offsets[rank];
    let end = pair_offsets[rank + 1u];
    if (pair == end) {
        return;
    }
    let row = depth_order[rank];
    let splat = splats[row];
    let range = tile_range(splat);
    var slot = slot_offsets[rank];
    let slots = (slot_offsets[rank + 1u] - slot) / (end - pair);
    for (var y = range.y; y < range.w; y += 1u) {
        for (var x = range.x; x < range.z; x += 1u) {
            let passes = passes_in_tile(splat, x, y);
            if (passes != 0u && pair < end) {
                tile_keys[pair] = (y - view.first_row) * view.tiles.x + x;
                pair_indices[pair] = pair;
                pairs[pair] = vec2u((passes << PASS_SHIFT) | row, slot);
                pair += 1u;
                slot += slots;
            }
        }
    }
    for (; pair < end; pair += 1u) {
        tile_keys[pair] = view.tiles.x * view.tiles.y;
        pair_indices[pair] = pair;
        pairs[pair] = vec2u(NO_SPLAT, 0u);
    }
}
