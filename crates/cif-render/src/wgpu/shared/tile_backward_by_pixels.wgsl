// Walks the splats of a tile front to back as tile_forward_by_pixels does, and sums what reaches each of them over the
// pixels of the tile: by subgroups, whose sums meet in workgroup memory, BATCH splats at a time. What the module says stands
// in tile_backward.wgsl, the twin.

const BACKWARD: bool = true;
const INVOCATIONS: u32 = 256u;
#import workgroup
#import tile_staging
#import partial_sums
#import batch_sums

// By pixel.
var<workgroup> pixel_labels: array<u32, select(1u, 256u, WITH_LABELS)>;

// Labels of four pixels, one of every quadrant.
fn labels_at(at: u32) -> vec4u {
    let first = 4u * at;
    return vec4u(
        pixel_labels[first], pixel_labels[first + 1u], pixel_labels[first + 2u], pixel_labels[first + 3u]);
}

fn differentiate_tile(workgroup: vec3u, lane: Lane) {
    let local = lane.local;
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    let quadrant = local / 64u;
    let pixel = 4u * (local % 64u) + quadrant;
    var p = pixel_of(tile, quadrant, local % 64u);
    let labels = vec4u(p.label);
    if (WITH_LABELS) {
        pixel_labels[pixel] = p.label;
    }
    for (var first = range.x; first < range.y; first += STAGED) {
        let alive = stage_tile(first, range.y, tile, p.open << (2u * quadrant), local);
        if (alive == 0u) {
            clear_pairs(first + local, range.y);
            break;
        }
        let longest_row = longest_of_rows();
        let staged_count = min(STAGED, range.y - first);
        stage_more(staged_count, local);
        let own = alive & (3u << (2u * quadrant));
        for (var batch = 0u; batch < staged_count; batch += BATCH) {
            let count = min(BATCH, staged_count - batch);
            for (var k = 0u; k < count; k += 1u) {
                let passes = atomicLoad(&staged_passes[batch + k]) & own;
                var sums: Sums;
                var responsibility = 0.0;
                if (passes != 0u) {
                    let splat = staged[batch + k];
                    let values = values_of(batch + k, splat, passes, labels);
                    let behind = first - range.x + batch + k + 1u;
                    responsibility =
                        add(splat, values, quadrant, passes >> (2u * quadrant), behind, &p, &sums);
                }
                leave(sums, k, lane);
                keep_responsibility(responsibility, k, pixel);
            }
            workgroupBarrier();
            sum_batch(lane, count, batch, longest_row);
        }
    }
}
