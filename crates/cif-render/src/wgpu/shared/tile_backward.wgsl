// Walks the splats of a tile front to back as tile_forward does, and sums what reaches each of them over the pixels of the
// tile. For BATCH splats at a time, invocations first sum over their own pixels and leave that in workgroup memory; then
// each takes a sum of a splat over all invocations, in a fixed order: no atomics, one store per (tile, splat) pair and
// sum. Twin: tile_backward_by_pixels.wgsl.
//
// Beside what tile_forward asks for, the module binds `pair_sums`, and says what an invocation sums, `Sums`, which it
// leaves by `leave`. `add` returns the responsibility of a splat for the label of a pixel: `longest_of_rows` (0 for
// none), `keep_responsibility` and `sum_responsibilities` deal with those, pixels counted by invocation and then by
// quadrant, with the labels that `labels_at` says, where the module is `WITH_LABELS`; `clear_row` with a pair that nothing
// reaches.

const BACKWARD: bool = true;
const INVOCATIONS: u32 = 64u;
#import workgroup
#import tile_staging
#import partial_sums
#import batch_sums

// By invocation, 16 bits each, quadrants 0 and 1 first.
var<workgroup> pixel_labels: array<vec2u, select(1u, 64u, WITH_LABELS)>;

// Labels of the pixels of an invocation, by quadrant.
fn labels_at(at: u32) -> vec4u {
    let packed = pixel_labels[at];
    return vec4u(packed & vec2u(0xffffu), packed >> vec2u(16u)).xzyw;
}

fn differentiate_tile(workgroup: vec3u, lane: Lane) {
    let local = lane.local;
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    let labels = vec4u(p0.label, p1.label, p2.label, p3.label);
    if (WITH_LABELS) {
        pixel_labels[local] = labels.xz | (labels.yw << vec2u(16u));
    }
    for (var first = range.x; first < range.y; first += STAGED) {
        let open = p0.open | (p1.open << 2u) | (p2.open << 4u) | (p3.open << 6u);
        let alive = stage_tile(first, range.y, tile, open, local);
        if (alive == 0u) {
            clear_pairs(first + local, range.y);
            break;
        }
        let longest_row = longest_of_rows();
        let staged_count = min(STAGED, range.y - first);
        stage_more(staged_count, local);
        // Loops that end at their foot: software that walks both sides of every branch goes through others once more.
        var batch = 0u;
        loop {
            let count = min(BATCH, staged_count - batch);
            var k = 0u;
            loop {
                let splat = staged[batch + k];
                let behind = first - range.x + batch + k + 1u;
                let passes = atomicLoad(&staged_passes[batch + k]) & alive;
                let values = values_of(batch + k, splat, passes, labels);
                var sums: Sums;
                var responsibility = vec4f(0.0);
                if ((passes & 3u) != 0u) {
                    responsibility.x = add(splat, values, 0u, passes & 3u, behind, &p0, &sums);
                }
                if ((passes & 12u) != 0u) {
                    responsibility.y = add(splat, values, 1u, (passes >> 2u) & 3u, behind, &p1, &sums);
                }
                if ((passes & 48u) != 0u) {
                    responsibility.z = add(splat, values, 2u, (passes >> 4u) & 3u, behind, &p2, &sums);
                }
                if ((passes & 192u) != 0u) {
                    responsibility.w = add(splat, values, 3u, (passes >> 6u) & 3u, behind, &p3, &sums);
                }
                leave(sums, k, lane);
                for (var quadrant = 0u; quadrant < 4u; quadrant += 1u) {
                    keep_responsibility(responsibility[quadrant], k, 4u * local + quadrant);
                }
                continuing {
                    k += 1u;
                    break if k >= count;
                }
            }
            workgroupBarrier();

            sum_batch(lane, count, batch, longest_row);
            continuing {
                batch += BATCH;
                break if batch >= staged_count;
            }
        }
    }
}
