//! Views drawn in bands are those drawn at once, bit for bit.

use cif_field::Field;
use cif_geometry::PixelGrid;
use cif_render::constants::TILE;
use cif_render::cpu::{BandRequest, RenderedBand, Renderer, SimdLevel};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use cif_render::{BlendRequest, Blending, Channels, RenderSettings};

const ALL: Channels = Channels { depth: true, instances: true };

/// Partial tiles at both edges, and Gaussians larger than a tile.
fn scene(width: u32, height: u32) -> SyntheticScene {
    generate(&SyntheticConfig {
        seed: 5,
        gaussians: 300,
        instances: 5,
        width,
        height,
        heads: Some(ALL_HEADS),
        screen_size: (0.01, 0.3),
    })
}

fn values(field: &Field) -> Vec<[f32; 2]> {
    field.gaussians.means.iter().map(|mean| [mean[0], 3.0 * mean[1]]).collect()
}

fn draw(scene: &SyntheticScene, memory: u64, request: &BandRequest<'_>) -> (Vec<RenderedBand>, Renderer) {
    let mut renderer = Renderer::new(SimdLevel::Auto);
    renderer.set_band_memory(memory);
    let mut bands = Vec::new();
    let settings = RenderSettings::of_field(&scene.field);
    renderer
        .render_bands(&scene.field, &scene.camera, scene.time, &settings, request, |band| {
            bands.push(band);
            Ok::<(), String>(())
        })
        .expect("this holds in the test");
    (bands, renderer)
}

/// Rows of a grid.
fn rows<T: Clone>(grid: &PixelGrid<T>, first: u32, like: &PixelGrid<T>) -> PixelGrid<T> {
    let start = (first * grid.width) as usize;
    PixelGrid::from_pixels(grid.width, like.height, grid.pixels[start..start + like.pixels.len()].to_vec())
}

/// Pictures that both drew.
fn both<'a, T>(whole: &'a Option<T>, band: &'a Option<T>) -> (&'a T, &'a T) {
    whole.as_ref().zip(band.as_ref()).expect("both were asked for it")
}

fn assert_rows(whole: &RenderedBand, band: &RenderedBand) {
    let first = band.first_row;
    assert_eq!(first % TILE, 0);
    let (a, b) = (&whole.image, &band.image);
    assert_eq!(rows(&a.color, first, &b.color), b.color);
    assert_eq!(rows(&a.alpha, first, &b.alpha), b.alpha);
    let (a_depth, b_depth) = both(&a.depth, &b.depth);
    assert_eq!(&rows(a_depth, first, b_depth), b_depth);
    let (a, b) = both(&a.instances, &b.instances);
    assert_eq!(rows(&a.label, first, &b.label), b.label);
    for (a, b) in [
        (&a.probability, &b.probability),
        (&a.coverage, &b.coverage),
        (&a.foreground, &b.foreground),
        (&a.entropy, &b.entropy),
    ] {
        assert_eq!(&rows(a, first, b), b);
    }
    let (a, b) = both(&whole.ranks, &band.ranks);
    assert_eq!(a.ranks.len(), b.ranks.len());
    for (a, b) in a.ranks.iter().zip(&b.ranks) {
        assert_eq!((&rows(&a.0, first, &b.0), &rows(&a.1, first, &b.1)), (&b.0, &b.1));
    }
    let (a, b) = both(&whole.blended, &band.blended);
    assert_eq!(&rows(a, first, b), b);
}

#[test]
fn bands_of_every_height_are_the_rows_of_the_whole() {
    let scene = scene(150, 203);
    let values = values(&scene.field);
    let request = BandRequest { channels: ALL, ranks: 3, values: Some(&values) };
    let (whole, renderer) = draw(&scene, u64::MAX, &request);
    assert_eq!(whole.len(), 1);
    let statistics = renderer.statistics();
    let covered = |band: &RenderedBand| band.image.alpha.pixels.iter().filter(|alpha| **alpha > 0.5).count();
    assert!(covered(&whole[0]) > 5000, "{}", covered(&whole[0]));
    let mut counts = Vec::new();
    // From many rows of tiles to one, and with rows drawn tile by tile.
    for memory in [4 << 20, 2 << 20, 1 << 20, 400_000, 20_000, 1] {
        let (bands, renderer) = draw(&scene, memory, &request);
        let mut next = 0;
        for band in &bands {
            assert_eq!(band.first_row, next);
            next += band.image.alpha.height;
            assert_rows(&whole[0], band);
        }
        assert_eq!(next, 203, "all rows");
        let drawn = renderer.statistics();
        assert_eq!(
            (drawn.tile_pairs, drawn.evaluated_pairs),
            (statistics.tile_pairs, statistics.evaluated_pairs)
        );
        counts.push(bands.len());
    }
    assert!(counts.is_sorted() && counts[0] < counts[2] && counts[5] == 13, "{counts:?}");
}

#[test]
fn whole_images_do_not_depend_on_the_bands() {
    let scene = scene(90, 75);
    let settings = RenderSettings::of_field(&scene.field);
    let (identities, values) = (scene.field.identities.as_ref().unwrap(), values(&scene.field));
    let drawn = [u64::MAX, 200_000, 1].map(|memory| {
        let mut renderer = Renderer::new(SimdLevel::Auto);
        renderer.set_band_memory(memory);
        let image = renderer.render(&scene.field, &scene.camera, scene.time, &settings, ALL);
        let blended = [Blending::Color, Blending::Own].map(|blending| {
            renderer.blend(&BlendRequest { values: values.as_flattened(), channels: 2, blending })
        });
        (image, blended, renderer.instance_ranks(identities, 4))
    });
    assert_eq!((drawn[0].0.color.width, drawn[0].0.color.height), (90, 75));
    assert!(drawn[0] == drawn[1] && drawn[0] == drawn[2]);
}

#[test]
fn drawing_stops_at_the_first_error() {
    let scene = scene(64, 64);
    let mut renderer = Renderer::new(SimdLevel::Auto);
    renderer.set_band_memory(1);
    let mut taken = 0;
    let settings = RenderSettings::of_field(&scene.field);
    let request = BandRequest::default();
    let result = renderer.render_bands(&scene.field, &scene.camera, 0.0, &settings, &request, |band| {
        taken += 1;
        if band.first_row == 16 { Err("full") } else { Ok(()) }
    });
    assert_eq!((result, taken), (Err("full"), 2));
    // The next view is whole again.
    let image = renderer.render(&scene.field, &scene.camera, 0.0, &settings, ALL);
    renderer.set_band_memory(u64::MAX);
    assert!(renderer.render(&scene.field, &scene.camera, 0.0, &settings, ALL) == image);
}

#[test]
fn a_view_is_differentiated_after_one_drawn_in_bands() {
    let scene = scene(64, 48);
    let settings = RenderSettings::of_field(&scene.field);
    let gradients = [false, true].map(|drawn_before| {
        let mut renderer = Renderer::new(SimdLevel::Auto);
        if drawn_before {
            renderer.set_band_memory(1);
            renderer.render(&scene.field, &scene.camera, scene.time, &settings, ALL);
        }
        let labels = Some(&scene.labels);
        let pass = renderer.forward(&scene.field, &scene.camera, scene.time, &settings, labels);
        let mut gradients = cif_render::Gradients::zeros(&scene.field);
        renderer.backward(&scene.field, &pass.color, 0.5, &mut gradients);
        gradients
    });
    assert_eq!(gradients[0].gaussians, gradients[1].gaussians);
    assert!(gradients[0].gaussians.means.as_flattened().iter().any(|v| *v != 0.0));
}
