//! Pictures of a view on their way to the disk, band by band.

use std::collections::BTreeSet;
use std::path::Path;

use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::{InstanceImage, RenderedImage};
use cif_train::metrics::mask_ids;

use super::layers::What;
use crate::camera_file::View;
use crate::error::Error;
use crate::output;
use crate::pictures::{DepthRange, PngFile, Polyline, instance_picture, rgb_picture};

/// The pictures of a view. None is there before all of its rows are.
pub(super) struct ViewFiles<'a> {
    field: &'a Field,
    files: Vec<(What, PngFile)>,
    /// Lines over the picture of tracks.
    lines: Vec<Polyline>,
    /// Rows that there are already.
    rows: u32,
    /// Depths of the view, where they are shown in colours: which those are is known behind the last row alone.
    depths: Vec<f32>,
}

impl<'a> ViewFiles<'a> {
    /// Files `folder/WHAT/VIEW.png`.
    pub(super) fn create(
        what: &BTreeSet<What>,
        field: &'a Field,
        folder: &Path,
        view: &View,
        lines: Vec<Polyline>,
    ) -> Result<Self, Error> {
        let file = |what: &What| {
            let path = output::inside(&folder.join(what.folder()), &view.name, "png")?;
            let is_color = matches!(what, What::Rgb | What::Tracks | What::InstanceColor | What::DepthColor);
            let make = if is_color { PngFile::rgb } else { PngFile::grey };
            Ok((*what, make(&path, view.camera.width, view.camera.height)?))
        };
        let files = what.iter().map(file).collect::<Result<_, Error>>()?;
        Ok(Self { field, files, lines, rows: 0, depths: Vec::new() })
    }

    /// The next rows.
    pub(super) fn add(&mut self, rows: &RenderedImage) -> Result<(), Error> {
        let Self { field, files, lines, rows: first_row, depths } = self;
        for (what, file) in files {
            match what {
                What::Rgb => file.add_rgb(&rgb_picture(&rows.color).pixels),
                What::Tracks => {
                    let mut picture = rgb_picture(&rows.color);
                    lines.iter().for_each(|line| line.draw(&mut picture, *first_row));
                    file.add_rgb(&picture.pixels)
                }
                What::Alpha => file.add_grey(&unit(&rows.alpha)),
                What::Depth => file.add_grey(&scaled(depth(rows), 1000.0)),
                What::DepthColor => {
                    depths.extend_from_slice(&depth(rows).pixels);
                    Ok(())
                }
                What::Instance => file.add_grey(&mask_ids(field, &instances(rows).foreground_label()).pixels),
                What::InstanceColor => {
                    let layers = instances(rows);
                    let ids = mask_ids(field, &layers.label);
                    file.add_rgb(&instance_picture(&ids, &layers.foreground).pixels)
                }
                What::Foreground => file.add_grey(&unit(&instances(rows).foreground)),
                What::Coverage => file.add_grey(&unit(&instances(rows).coverage)),
                What::Probability => file.add_grey(&unit(&instances(rows).probability)),
                What::Entropy => file.add_grey(&scaled(&instances(rows).entropy, 1000.0)),
            }?;
        }
        *first_row += rows.color.height;
        Ok(())
    }

    /// Puts the files in their places.
    pub(super) fn finish(self) -> Result<(), Error> {
        // Some pixels at a time, so that their colours take no memory to speak of.
        const AT_ONCE: usize = 1 << 16;
        for (what, mut file) in self.files {
            if what == What::DepthColor {
                let range = DepthRange::of(&self.depths);
                for depths in self.depths.chunks(AT_ONCE) {
                    let colors: Vec<[u8; 3]> = depths.iter().map(|depth| range.color(*depth)).collect();
                    file.add_rgb(&colors)?;
                }
            }
            file.finish()?;
        }
        Ok(())
    }
}

fn depth(rows: &RenderedImage) -> &PixelGrid<f32> {
    rows.depth.as_ref().expect("the layers asked for were rendered")
}

fn instances(rows: &RenderedImage) -> &InstanceImage {
    rows.instances.as_ref().expect("the layers asked for were rendered")
}

/// Shares of 1 as shares of 65535.
fn unit(values: &PixelGrid<f32>) -> Vec<u16> {
    scaled(values, 65_535.0)
}

/// Values times `factor`, rounded, kept within 16 bits.
fn scaled(values: &PixelGrid<f32>, factor: f32) -> Vec<u16> {
    values.pixels.iter().map(|value| (value * factor).round().clamp(0.0, 65_535.0) as u16).collect()
}
