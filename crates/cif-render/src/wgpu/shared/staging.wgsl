// The splats of a tile that fall on a quadrant, 64 at a time, in workgroup memory and in order.

struct Staged {
    mean: vec2f,
    depth: f32,
    // Passes that draw it, a bit each.
    passes: u32,
    // Conic and opacity.
    conic: vec4f,
    // Colour and occupancy.
    color: vec4f,
    row: u32,
    // Its identity row.
    row_first: u32,
    row_end: u32,
    unused: u32,
}

var<workgroup> staged: array<Staged, 64>;
var<workgroup> kept: array<atomic<u32>, 2>;
var<workgroup> kept_count: u32;
var<workgroup> live: array<atomic<u32>, 1>;
var<workgroup> live_count: u32;

// Stages entries from `first` on; returns how many are kept. Every invocation of the workgroup must come here.
fn stage(first: u32, end: u32, origin: vec2u, wanted: u32, local: u32) -> u32 {
    if (local < 2u) {
        atomicStore(&kept[local], 0u);
    }
    workgroupBarrier();
    var item: Staged;
    let index = first + local;
    if (index < end) {
        let tag = entries[index].y;
        item.row = tag & INDEX_MASK;
        let splat = splats[item.row];
        item.passes = (tag >> PASS_SHIFT) & wanted & passes_in_quadrant(splat, origin);
        if (item.passes != 0u) {
            item.mean = splat.mean;
            item.depth = splat.depth;
            item.conic = splat.conic;
            item.color = splat.color;
            if ((item.passes & INSTANCE_PASS) != 0u) {
                item.row_first = row_offsets[item.row];
                item.row_end = row_offsets[item.row + 1u];
            }
            atomicOr(&kept[local >> 5u], 1u << (local & 31u));
        }
    }
    workgroupBarrier();
    let low = atomicLoad(&kept[0]);
    let high = atomicLoad(&kept[1]);
    let own = (1u << (local & 31u)) - 1u;
    let before = select(countOneBits(low & own), countOneBits(low) + countOneBits(high & own), local >= 32u);
    if (item.passes != 0u) {
        staged[before] = item;
    }
    if (local == 0u) {
        kept_count = countOneBits(low) + countOneBits(high);
    }
    return workgroupUniformLoad(&kept_count);
}

// Whether any invocation is live. Every invocation of the workgroup must come here.
fn any_live(is_live: bool, local: u32) -> bool {
    if (local == 0u) {
        atomicStore(&live[0], 0u);
    }
    workgroupBarrier();
    if (is_live) {
        atomicOr(&live[0], 1u);
    }
    workgroupBarrier();
    if (local == 0u) {
        live_count = atomicLoad(&live[0]);
    }
    return workgroupUniformLoad(&live_count) != 0u;
}
