//! Rendering a trained scene at a time of your choice: the first camera, half way through.

use anyhow::Context;
use cif_field::Field;
use cif_render::Channels;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_train::metrics::trained_settings;

fn main() -> anyhow::Result<()> {
    let path = cif_examples::output("tabletop-mini.cif")?;
    let field = Field::load(&path).context("run the example 02_train first")?;
    let camera = &field.cameras.first().context("the scene records no camera")?.camera;
    let channels = Channels { depth: true, instances: field.identities.is_some() };
    let view =
        Renderer::new(SimdLevel::Auto).render(&field, camera, 0.5, &trained_settings(&field), channels);

    let bytes = view.color.pixels.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
    let picture = cif_examples::output("view.png")?;
    image::RgbImage::from_raw(camera.width, camera.height, bytes.collect())
        .context("a view has width x height pixels")?
        .save(&picture)?;
    println!("wrote {}", picture.display());

    if let Some(instances) = view.instances {
        for (index, instance) in field.instances.iter().enumerate() {
            let label = index as u16 + 1;
            let pixels = instances.label.pixels.iter().filter(|value| **value == label).count();
            println!("  {:>6} pixels show {}", pixels, instance.label);
        }
    }
    Ok(())
}
