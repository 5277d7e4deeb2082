// Which tiles a splat may reach, and by which passes.

// First column and row, and those after the last, of the tiles that are drawn.
fn tile_range(splat: Splat) -> vec4u {
    let size = f32(TILE);
    let low = vec2f(0.0, f32(view.first_row));
    let high = low + vec2f(view.tiles);
    let first = clamp(floor((splat.mean - splat.extent) / size), low, high);
    let last = clamp(floor((splat.mean + splat.extent) / size) + 1.0, low, high);
    return vec4u(vec2u(first), vec2u(last));
}

// Pixel centres lie half a pixel inside the tile.
fn passes_in_tile(splat: Splat, column: u32, row: u32) -> u32 {
    let first = vec2f(f32(column * TILE) + 0.5, f32(row * TILE) + 0.5);
    return passes_in(splat, first, first + f32(TILE - 1u));
}
