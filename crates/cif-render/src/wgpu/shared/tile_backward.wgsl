// Walks the splats of a tile front to back as tile_forward does, and sums what reaches each of them over the pixels of the
// tile. For BATCH splats at a time, invocations first sum over their own pixels and leave that in workgroup memory; then
// each takes a sum of a splat over all invocations, in a fixed order: no atomics, one store per (tile, splat) pair and
// sum. Sums by subgroups would take ten instructions where this takes a store and a load.
//
// Beside what tile_forward asks for, the module binds `pair_sums`, and says what an invocation sums, `Sums`, which it
// leaves by `leave`. `add` returns the responsibility of a splat for the label of a pixel: `begin_tile`, `longest_of_rows`
// (0 for none), `keep_responsibility` and `sum_responsibilities` deal with those; `clear_row` with a pair that nothing
// reaches.

const BACKWARD: bool = true;
#import tile_staging
#import partial_sums

// Nothing reaches these pairs.
fn clear_pairs(first: u32, end: u32) {
    for (var index = first; index < end; index += 64u) {
        let entry = entries[index];
        for (var value = 0u; value < SUMS; value += 1u) {
            pair_sums[entry.x * PAIR_SUMS + value] = 0.0;
        }
        clear_row(entry);
    }
}

fn differentiate_tile(workgroup: vec3u, local: u32) {
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    let labels = vec4u(p0.label, p1.label, p2.label, p3.label);
    begin_tile(labels, local);
    for (var first = range.x; first < range.y; first += STAGED) {
        let open = vec4u(p0.open, p1.open, p2.open, p3.open);
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
                leave(sums, k * SUMS * 64u + local);
                keep_responsibility(responsibility, k * 64u + local);
                continuing {
                    k += 1u;
                    break if k >= count;
                }
            }
            workgroupBarrier();

            let own = local / (64u / BATCH);
            let part = local % (64u / BATCH);
            if (own < count && part < SUMS) {
                pair_sums[staged[batch + own].pair * PAIR_SUMS + part] = sum_of(own * SUMS + part, local);
            }
            workgroupBarrier();
            if (longest_row > 0u) {
                sum_responsibilities(own, part, local, count, batch, longest_row);
            }
            continuing {
                batch += BATCH;
                break if batch >= staged_count;
            }
        }
    }
}
