// Walks the splats of a tile front to back, for a workgroup with a pixel of each quadrant per invocation, so that what is
// read of a splat serves four. Twin: tile_forward_by_pixels.wgsl. The module says
// how a `Pixel` starts, `pixel_of`, and where it goes, `write`; what is read in addition to the staged splats,
// `stage_more`; the values of a splat that is drawn, `values_of`; and what they do to a pixel of a quadrant, `add`, for
// which `behind` is the position after the splat in the list of the tile.

const BACKWARD: bool = false;
const INVOCATIONS: u32 = 64u;
#import tile_staging

fn blend_tile(workgroup: vec3u, local: u32) {
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    var p0 = pixel_of(tile, 0u, local);
    var p1 = pixel_of(tile, 1u, local);
    var p2 = pixel_of(tile, 2u, local);
    var p3 = pixel_of(tile, 3u, local);
    let labels = vec4u(p0.label, p1.label, p2.label, p3.label);
    for (var first = range.x; first < range.y; first += STAGED) {
        let open = p0.open | (p1.open << 2u) | (p2.open << 4u) | (p3.open << 6u);
        let alive = stage_tile(first, range.y, tile, open, local);
        if (alive == 0u) {
            break;
        }
        let count = min(STAGED, range.y - first);
        stage_more(count, local);
        // A loop that ends at its foot: software that walks both sides of every branch goes through others once more.
        var k = 0u;
        loop {
            let splat = staged[k];
            let behind = first - range.x + k + 1u;
            let passes = atomicLoad(&staged_passes[k]) & alive;
            let values = values_of(k, splat, passes, labels);
            if ((passes & 3u) != 0u) {
                add(splat, values, 0u, passes & 3u, behind, &p0);
            }
            if ((passes & 12u) != 0u) {
                add(splat, values, 1u, (passes >> 2u) & 3u, behind, &p1);
            }
            if ((passes & 48u) != 0u) {
                add(splat, values, 2u, (passes >> 4u) & 3u, behind, &p2);
            }
            if ((passes & 192u) != 0u) {
                add(splat, values, 3u, (passes >> 6u) & 3u, behind, &p3);
            }
            continuing {
                k += 1u;
                break if k >= count;
            }
        }
        workgroupBarrier();
    }
    write(p0);
    write(p1);
    write(p2);
    write(p3);
}
