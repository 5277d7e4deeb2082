// Splats of a tile in workgroup memory, in order, with the quadrants that each pass draws them in: two bits per
// quadrant, 0 and 1 above, 2 and 3 below. The walk declares INVOCATIONS, those of the workgroup. The module says which
// passes it draws, `drawn_passes`, and where the values of a Gaussian begin and end, `row_range`; its own bindings follow
// those below.

#import view
#import splat
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> entries: array<vec4u>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2u>;

const STAGED: u32 = INVOCATIONS / 4u;
// Bits of the instance pass.
const INSTANCE_IN_TILE: u32 = 170u;

struct Staged {
    mean: vec2f,
    depth: f32,
    // Of gradients alone.
    pair: u32,
    // Factor of the conic, and opacity.
    factor: vec4f,
    // Colour and occupancy.
    color: vec4f,
    // First label slot, of gradients alone, and the values of the Gaussian.
    slot: u32,
    row_first: u32,
    row_end: u32,
}

var<workgroup> staged: array<Staged, STAGED>;
var<workgroup> staged_passes: array<atomic<u32>, STAGED>;
// Passes that any pixel lets light through.
var<workgroup> live: atomic<u32>;
// Values of the longest row, for gradients alone.
var<workgroup> longest: atomic<u32>;

// Stages entries from `first` on; returns the passes that any pixel lets light through, of which `open` are those of the
// invocation's pixels, two bits per quadrant. Every invocation of the workgroup must come here, and meet between what it
// reads and the next call.
fn stage_tile(first: u32, end: u32, tile: vec2u, open: u32, local: u32) -> u32 {
    if (local < STAGED) {
        atomicStore(&staged_passes[local], 0u);
    }
    if (local == 0u) {
        atomicStore(&live, 0u);
        atomicStore(&longest, 0u);
    }
    workgroupBarrier();
    atomicOr(&live, open);
    // An invocation decides one quadrant of an entry.
    let place = local / 4u;
    let quadrant = local % 4u;
    if (first + place < end) {
        let entry = entries[first + place];
        let row = entry.y & INDEX_MASK;
        let splat = splats[row];
        let drawn = (entry.y >> PASS_SHIFT) & drawn_passes();
        let passes = drawn & passes_in_quadrant(splat, quadrant_origin(tile, quadrant));
        atomicOr(&staged_passes[place], passes << (2u * quadrant));
        if (quadrant == 0u) {
            var item: Staged;
            item.mean = splat.mean;
            item.depth = splat.depth;
            item.factor = splat.factor;
            item.color = splat.color;
            let range = row_range(row);
            item.row_first = range.x;
            item.row_end = range.y;
            if (BACKWARD) {
                item.pair = entry.x;
                item.slot = entry.z;
                atomicMax(&longest, item.row_end - item.row_first);
            }
            staged[place] = item;
        }
    }
    return workgroupUniformLoad(&live);
}
