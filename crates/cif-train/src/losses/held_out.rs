//! Pixels of training views that the colour loss leaves out, so that effects can be judged on them.

use cif_geometry::PixelGrid;

/// Every so many columns and rows there is one.
pub(crate) const SPACING: u32 = 8;

/// Column and row of the first of them.
pub(crate) const FIRST: (u32, u32) = (3, 5);

/// Their positions in an image.
pub(crate) fn held_out(width: u32, height: u32) -> impl Iterator<Item = usize> {
    let rows = (FIRST.1..height).step_by(SPACING as usize);
    rows.flat_map(move |y| {
        (FIRST.0..width).step_by(SPACING as usize).map(move |x| y as usize * width as usize + x as usize)
    })
}

/// Takes the gradient from them.
pub(crate) fn leave_out_held_out(v_color: &mut PixelGrid<[f32; 3]>) {
    for pixel in held_out(v_color.width, v_color.height) {
        v_color.pixels[pixel] = [0.0; 3];
    }
}
