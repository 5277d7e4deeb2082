//! Pictures side by side.

use super::Picture;

/// Columns of white between two pictures.
const GAP: u32 = 2;

/// Joins pictures from left to right; shorter ones are padded with white below.
#[must_use]
pub fn side_by_side(pictures: &[Picture]) -> Picture {
    let width = pictures.iter().map(|picture| picture.width + GAP).sum::<u32>().saturating_sub(GAP);
    let height = pictures.iter().map(|picture| picture.height).max().unwrap_or(0);
    let mut joined = Picture::filled(width, height, [255; 3]);
    let mut left = 0;
    for picture in pictures {
        for (row, line) in picture.pixels.chunks(picture.width.max(1) as usize).enumerate() {
            let start = row * width as usize + left as usize;
            joined.pixels[start..start + line.len()].copy_from_slice(line);
        }
        left += picture.width + GAP;
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_keep_their_pixels() {
        let a = Picture::filled(2, 3, [1; 3]);
        let b = Picture::filled(4, 1, [9; 3]);
        let joined = side_by_side(&[a, b]);
        assert_eq!((joined.width, joined.height), (8, 3));
        assert_eq!(*joined.at(1, 2), [1; 3]);
        assert_eq!(*joined.at(2, 0), [255; 3]);
        assert_eq!(*joined.at(7, 0), [9; 3]);
        assert_eq!(*joined.at(7, 1), [255; 3]);
        assert_eq!(side_by_side(&[]).pixels.len(), 0);
    }
}
