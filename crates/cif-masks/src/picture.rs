//! An image in the forms that propagation needs: brightness for flow, colour in CIE L*a*b* for appearance.

use std::sync::OnceLock;

use cif_geometry::PixelGrid;

use crate::plane::Plane;

/// Brightness and colour of an image.
#[derive(Clone, Debug)]
pub(crate) struct Picture {
    /// Luma, 0 to 255 (ITU-R BT.601 weights of display-referred values).
    pub(crate) brightness: Plane,
    /// L*, a*, b*, each scaled by 255 / 100.
    pub(crate) lab: [Plane; 3],
}

impl Picture {
    /// Reads display-referred sRGB, reduced to `width` x `height` by averages where that is smaller.
    pub(crate) fn new(image: &PixelGrid<[u8; 3]>, width: usize, height: usize) -> Self {
        let (from_width, from_height) = (image.width as usize, image.height as usize);
        let channels: [Plane; 3] = std::array::from_fn(|c| {
            let data = image.pixels.iter().map(|pixel| f32::from(pixel[c])).collect();
            reduced(Plane { width: from_width, height: from_height, data }, width, height)
        });
        let mut brightness = Plane::filled(width, height, 0.0);
        let mut lab = [(); 3].map(|()| Plane::filled(width, height, 0.0));
        for k in 0..width * height {
            let rgb = [channels[0].data[k], channels[1].data[k], channels[2].data[k]];
            brightness.data[k] = 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2];
            for (plane, value) in lab.iter_mut().zip(to_lab(rgb)) {
                plane.data[k] = value;
            }
        }
        Self { brightness, lab }
    }
}

/// Averages of the pixels below each pixel of a smaller grid.
fn reduced(mut plane: Plane, width: usize, height: usize) -> Plane {
    while plane.width >= 2 * width && plane.height >= 2 * height {
        plane = plane.halved();
    }
    plane.resized(width, height)
}

/// L*, a*, b* for the white of sRGB (D65), each scaled by 255 / 100, of display-referred values in 0 to 255.
fn to_lab(rgb: [f32; 3]) -> [f32; 3] {
    static LINEAR: OnceLock<Vec<f32>> = OnceLock::new();
    static ROOT: OnceLock<Vec<f32>> = OnceLock::new();
    /// Steps of the tables between 0 and 1.
    const STEPS: usize = 4080;
    let table = |f: fn(f64) -> f64| move || (0..=STEPS).map(|k| f(k as f64 / STEPS as f64) as f32).collect();
    let linear = LINEAR.get_or_init(table(|value| {
        if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
    }));
    let root = ROOT.get_or_init(table(|value| {
        if value > 216.0 / 24389.0 { value.cbrt() } else { (24389.0 / 27.0 * value + 16.0) / 116.0 }
    }));
    let look_up = |table: &[f32], value: f32| table[((value * STEPS as f32 + 0.5) as usize).min(STEPS)];
    let [r, g, b] = rgb.map(|value| look_up(linear, value / 255.0));
    let x = look_up(root, (0.412_456 * r + 0.357_576 * g + 0.180_437 * b) / 0.950_47);
    let y = look_up(root, 0.212_673 * r + 0.715_152 * g + 0.072_175 * b);
    let z = look_up(root, (0.019_334 * r + 0.119_192 * g + 0.950_304 * b) / 1.088_83);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)].map(|value| value * 2.55)
}
