// Walks the splats of a tile front to back, for a workgroup with a pixel per invocation, quadrant by quadrant: subgroups
// pass by the splats that their quadrant does not see, and four times as many of them hide one another's waiting. What the
// module says stands in tile_forward.wgsl, the twin.

const BACKWARD: bool = false;
const INVOCATIONS: u32 = 256u;
#import tile_staging

fn blend_tile(workgroup: vec3u, local: u32) {
    let tile = vec2u(workgroup.x, view.first_row + workgroup.y);
    let range = tile_ranges[workgroup.y * view.tiles.x + workgroup.x];
    let quadrant = local / 64u;
    var p = pixel_of(tile, quadrant, local % 64u);
    let labels = vec4u(p.label);
    for (var first = range.x; first < range.y; first += STAGED) {
        let alive = stage_tile(first, range.y, tile, p.open << (2u * quadrant), local);
        if (alive == 0u) {
            break;
        }
        let count = min(STAGED, range.y - first);
        stage_more(count, local);
        let own = alive & (3u << (2u * quadrant));
        for (var k = 0u; k < count; k += 1u) {
            let passes = atomicLoad(&staged_passes[k]) & own;
            if (passes != 0u) {
                let splat = staged[k];
                let values = values_of(k, splat, passes, labels);
                add(splat, values, quadrant, passes >> (2u * quadrant), first - range.x + k + 1u, &p);
            }
        }
        workgroupBarrier();
    }
    write(p);
}
