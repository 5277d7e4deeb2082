// Whether the tile of a pixel counts, of those that were drawn: see `tiles.rs`.
fn counts(pixel: u32) -> bool {
    if settings.tile_columns == 0u {
        return true;
    }
    let column = pixel % settings.width / TILE;
    let row = pixel / settings.width / TILE;
    return (tile_choice[row * settings.tile_columns + column] & INSTANCE_PASS) != 0u;
}
