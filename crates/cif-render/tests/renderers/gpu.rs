//! The GPU alone: every stage on the reference's own inputs, and what the processor does otherwise.

use std::collections::BTreeMap;

use cif_field::SortMetric;
use cif_render::Channels;
use cif_render::RenderSettings;
use cif_render::reference::rasterize::{footprint, weight};
use cif_render::reference::{self, Forward, Scene};
use cif_render::synthetic::{ALL_HEADS, SyntheticConfig, generate};
use cif_render::wgpu::{
    Commands, Gpu, GpuError, GpuGaussians, GpuRenderer, GpuStatistics, GpuVec, Rasterizer, Splat, ViewInput,
    testing,
};

use crate::on_gpu::{Outcome, device, run};
use crate::renderers::{Path, seen_on_gpu};
use crate::support::{Cotangents, Mismatches, Worst, pixel_discontinuity, render};
use crate::views::{BAND, CHANNELS, Expected, Tolerances, config, settings};

#[test]
fn project_on_the_inputs_of_the_reference() {
    let Some(mut device) = device() else { return };
    for antialiased in [false, true] {
        let settings = RenderSettings { antialiased, ..settings() };
        let config = SyntheticConfig { gaussians: 2000, ..config() };
        let expected = Expected::of("project", &config, &settings, |_| {});
        let actual = run(&mut device, &expected.synthetic, &settings, &expected.cotangents, |_| {}).unwrap();
        let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
        let mut visible = 0;
        for (index, splat) in actual.splats.iter().enumerate() {
            let Some(e) = &expected.forward.splats[index] else {
                assert_eq!(splat.radius, 0.0, "{index} is not visible");
                continue;
            };
            // What just touches the border of the image, or 1/255, may fall on either side.
            let faint = e.opacity.max(e.occupancy) < 1.001 / 255.0;
            if splat.radius == 0.0 {
                let size = [71.0, 53.0];
                let at_border = (0..2).any(|axis| {
                    (e.mean2d[axis] + e.extents[axis]).abs() < 1e-2
                        || (e.mean2d[axis] - e.extents[axis] - size[axis]).abs() < 1e-2
                });
                assert!(at_border || faint, "{index} is visible");
                continue;
            }
            visible += 1;
            let mut compare = |what: &str, e: f64, a: f32, relative: f64, absolute: f64| {
                mismatches.compare(what, index, e, a.into(), relative, absolute);
                worst.see(what, (e - f64::from(a)).abs() / e.abs().max(1e-2));
            };
            for axis in 0..2 {
                compare("mean, relative", e.mean2d[axis], splat.mean[axis], 1e-5, 1e-4);
                if !faint {
                    compare("extent, relative", e.extents[axis], splat.extent[axis], 1e-3, 1e-4);
                }
            }
            let largest = e.factor.iter().fold(0.0_f64, |largest, v| largest.max(v.abs()));
            for k in 0..3 {
                compare("factor, relative", e.factor[k], splat.factor[k], 2e-5, 2e-5 * largest);
                compare("colour, relative", e.color[k], splat.color[k], 1e-5, 1e-5);
            }
            compare("opacity, relative", e.opacity, splat.factor[3], 2e-5, 0.0);
            compare("occupancy, relative", e.occupancy, splat.color[3], 1e-5, 0.0);
            compare("depth, relative", e.depth, splat.depth, 1e-6, 0.0);
            compare("radius, relative", e.radius, splat.radius, 1e-5, 0.0);
        }
        assert!(visible > 1500, "{visible}");
        worst.report("project");
        mismatches.finish("project");
    }
}

#[test]
fn depth_order_is_exact_on_equal_keys() {
    let Some(mut device) = device() else { return };
    for (gaussians, sort_metric) in [(1, SortMetric::Z), (5000, SortMetric::Z), (4097, SortMetric::Distance)]
    {
        let settings = RenderSettings { sort_metric, instances: None, ..settings() };
        let mut scene = generate(&SyntheticConfig { gaussians, ..config() });
        // Many ties: all stand on seven places.
        for row in 7..gaussians {
            scene.field.gaussians.means[row] = scene.field.gaussians.means[row % 7];
        }
        let cotangents = Cotangents::random(3, 71, 53);
        let actual = run(&mut device, &scene, &settings, &cotangents, |_| {}).unwrap();
        let key = |row: &u32| {
            let splat = &actual.splats[*row as usize];
            let depth = match sort_metric {
                SortMetric::Z => splat.depth,
                SortMetric::Distance => {
                    let mean = glam::DVec3::from(scene.field.gaussians.means[*row as usize].map(f64::from));
                    (mean - scene.camera.centre()).length() as f32
                }
            };
            // Distances that agree to rounding are the same place here.
            (splat.radius == 0.0, (depth * 1e4).round() as u32, *row)
        };
        let mut order: Vec<u32> = (0..gaussians as u32).collect();
        order.sort_by_key(key);
        assert_eq!(actual.order, order, "{gaussians} {sort_metric:?}");
    }
}

#[test]
fn tile_lists_hold_every_drawn_pair_once_and_in_order() {
    let Some(mut device) = device() else { return };
    for gaussians in [250, 5000] {
        let scene = generate(&SyntheticConfig { gaussians, ..config() });
        let settings = settings();
        let forward = render(&Scene::<f64>::from_field(&scene.field), &scene, &settings);
        let actual = run(&mut device, &scene, &settings, &Cotangents::random(3, 71, 53), |_| {}).unwrap();
        let rank: BTreeMap<u32, usize> = actual.order.iter().enumerate().map(|(r, row)| (*row, r)).collect();
        let (columns, rows) = (71_u32.div_ceil(16), 53_u32.div_ceil(16));
        assert_eq!(actual.tile_ranges.len(), (columns * rows) as usize);
        let (mut pairs, mut next) = (Vec::new(), 0);
        for [first, end] in &actual.tile_ranges {
            if first == end {
                continue;
            }
            assert_eq!(*first, next, "ranges follow each other");
            next = *end;
            let list = &actual.entries[*first as usize..*end as usize];
            let ranks: Vec<usize> = list.iter().map(|entry| rank[&(entry[1] & 0x3fff_ffff)]).collect();
            assert!(ranks.windows(2).all(|pair| pair[0] < pair[1]), "front to back");
            pairs.extend(list.iter().map(|entry| entry[0]));
        }
        assert_eq!(next as usize, actual.entries.len(), "every pair lies in a tile");
        pairs.sort_unstable();
        assert!(pairs.iter().copied().eq(0..next), "every pair once");
        let mut drawn = 0;
        for (row, splat) in forward.splats.iter().enumerate() {
            let Some(splat) = splat else { continue };
            for y in 0..53 {
                for x in 0..71 {
                    let at = footprint(splat, [x, y]);
                    for (strength, pass) in [(splat.opacity, 1_u32), (splat.occupancy, 2)] {
                        // A hair above the gate, so that rounding does not matter.
                        if weight(strength * 0.999, at.peak).is_none() {
                            continue;
                        }
                        let [first, end] = actual.tile_ranges[(y / 16 * columns + x / 16) as usize];
                        let found = actual.entries[first as usize..end as usize]
                            .iter()
                            .any(|entry| entry[1] & 0x3fff_ffff == row as u32 && entry[1] >> 30 & pass != 0);
                        assert!(found, "splat {row} is drawn at {x}, {y} by pass {pass}");
                        drawn += 1;
                    }
                }
            }
        }
        assert!(drawn > 1000, "{drawn}");
    }
}

/// Splats as the reference made them, rounded to single precision.
fn rounded(forward: &Forward<f64>, splats: &mut [Splat]) {
    for (splat, e) in splats.iter_mut().zip(&forward.splats) {
        let (Some(e), true) = (e, splat.radius > 0.0) else { continue };
        let single = |v: f64| v as f32;
        splat.mean = e.mean2d.map(single);
        splat.factor = [e.factor[0], e.factor[1], e.factor[2], e.opacity].map(single);
        splat.color = [e.color[0], e.color[1], e.color[2], e.occupancy].map(single);
        splat.depth = single(e.depth);
    }
}

#[test]
fn rasterize_in_both_directions_on_the_splats_of_the_reference() {
    let Some(mut device) = device() else { return };
    let settings = settings();
    let expected = Expected::of("rasterize", &config(), &settings, |_| {});
    let actual = run(&mut device, &expected.synthetic, &settings, &expected.cotangents, |splats| {
        rounded(&expected.forward, splats);
    })
    .unwrap();
    let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
    let tolerances = Tolerances { color: 1e-5, gradient: 1e-3, screen: 1e-3, ..Tolerances::of(Path::Gpu) };
    expected.compare(&seen_on_gpu(actual), tolerances, &mut mismatches, &mut worst);
    worst.report("rasterize");
    mismatches.finish("rasterize");
}

/// A comparison that cannot fail proves nothing.
#[test]
fn the_comparison_notices_small_mistakes() {
    let Some(mut device) = device() else { return };
    let settings = settings();
    let expected = Expected::of("mistakes", &config(), &settings, |_| {});
    type Mistake = (&'static str, fn(&mut Vec<Splat>));
    let mistakes: [Mistake; 5] = [
        ("a dropped splat", |splats| splats[3].factor[3] = 0.0),
        ("a mean half a hundredth of a pixel off", |splats| {
            splats.iter_mut().for_each(|s| s.mean[0] += 5e-3)
        }),
        ("swapped axes", |splats| splats.iter_mut().for_each(|s| s.factor.swap(0, 2))),
        ("red and blue swapped", |splats| splats.iter_mut().for_each(|s| s.color.swap(0, 2))),
        ("occupancy one part in a hundred off", |splats| splats.iter_mut().for_each(|s| s.color[3] *= 1.01)),
    ];
    for (name, mistake) in mistakes {
        let actual = run(&mut device, &expected.synthetic, &settings, &expected.cotangents, mistake).unwrap();
        let (mut mismatches, mut worst) = (Mismatches::default(), Worst::default());
        expected.compare(&seen_on_gpu(actual), Tolerances::of(Path::Gpu), &mut mismatches, &mut worst);
        let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| mismatches.finish(name)));
        assert!(caught.is_err(), "{name} goes unnoticed");
    }
}

/// Rows 12 and 13: long needles whose sigma may round below 0, and clamped scales.
#[test]
fn extreme_scales_stay_finite_and_carry_no_gradient_outside_their_range() {
    let Some(mut device) = device() else { return };
    let mut scene = generate(&config());
    scene.field.gaussians.log_scales[0] = [12.0, -25.0, -2.0];
    scene.field.gaussians.log_scales[1] = [60.0, f32::MAX, -3.0];
    for log_scale in scene.field.gaussians.log_scales[2..].iter_mut().step_by(5) {
        *log_scale = [log_scale[0] + 6.0, -9.0, -9.0];
    }
    let actual = run(&mut device, &scene, &settings(), &Cotangents::random(3, 71, 53), |_| {}).unwrap();
    assert!(actual.screen[0][3] > 0.0 && actual.screen[1][3] > 0.0, "both are drawn");
    assert_eq!(
        [actual.geometry[0][4], actual.geometry[0][5], actual.geometry[1][4], actual.geometry[1][5]],
        [0.0; 4]
    );
    assert_all_finite("extreme scales", &actual);
}

fn assert_all_finite(name: &str, outcome: &Outcome) {
    let numbers = [
        ("colour", outcome.colors.as_flattened()),
        ("blended", outcome.blended.as_flattened()),
        ("geometry gradients", outcome.geometry.as_flattened()),
        ("colour gradients", outcome.sh.as_flattened()),
        ("screen", outcome.screen.as_flattened()),
        ("calibrations", &outcome.calibrations),
    ];
    for (what, values) in numbers {
        assert!(values.iter().all(|v| v.is_finite()), "{name}: {what}");
    }
}

#[test]
fn poison_never_spreads() {
    let Some(mut device) = device() else { return };
    let poisons =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 1e-40, 0.0, 1e20, -1e20, 100.0, -100.0];
    let config = SyntheticConfig { gaussians: 6 + 7 * poisons.len(), width: 20, height: 18, ..config() };
    let mut scene = generate(&config);
    let gaussians = &mut scene.field.gaussians;
    for (index, poison) in poisons.into_iter().enumerate() {
        let row = 6 + 7 * index;
        gaussians.means[row][0] = poison;
        gaussians.means[row + 1][2] = poison;
        gaussians.log_scales[row + 2][1] = poison;
        gaussians.quaternions[row + 3][3] = poison;
        gaussians.opacity_logits[row + 4] = poison;
        gaussians.occupancy_logits[row + 5] = poison;
        // A colour of 1e20 is drawn as asked; its gradient by the direction may overflow.
        if !(poison.abs() > 1e19 && poison.is_finite()) {
            gaussians.sh_coefficients[row + 6][7] = poison;
        }
    }
    let actual = run(&mut device, &scene, &settings(), &Cotangents::random(3, 20, 18), |_| {}).unwrap();
    assert_all_finite("poison", &actual);
    for group in 0..7 {
        assert_eq!(actual.splats[6 + group].radius, 0.0, "not a number in group {group} draws nothing");
    }
    assert!(actual.splats[..6].iter().any(|splat| splat.radius > 0.0));
}

#[test]
fn empty_scenes() {
    let Some(mut device) = device() else { return };
    for (gaussians, labelled) in [(0, true), (3, false), (3, true)] {
        let mut scene = generate(&SyntheticConfig { gaussians, ..config() });
        if !labelled {
            scene.labels.pixels.fill(0);
        }
        // Everything behind the camera.
        let behind = scene.camera.centre() - scene.camera.forward();
        scene.field.gaussians.means.fill(behind.as_vec3().to_array());
        let actual = run(&mut device, &scene, &settings(), &Cotangents::random(3, 71, 53), |_| {}).unwrap();
        let [red, green, blue] = settings().background;
        assert!(actual.colors.iter().all(|color| *color == [red, green, blue, 1.0]));
        assert_eq!(actual.statistics, GpuStatistics::default());
        assert!(actual.geometry.as_flattened().iter().chain(actual.sh.as_flattened()).all(|v| *v == 0.0));
        assert!(actual.calibrations.iter().all(|v| *v == 0.0));
        assert!(actual.blended.iter().all(|blended| *blended == [0.0, 0.0, 1.0, 0.0]));
    }
}

#[test]
fn a_renderer_draws_again_at_another_time_and_what_is_asked() {
    let Some(device) = device() else { return };
    let scene = generate(&SyntheticConfig { heads: Some(ALL_HEADS), ..config() });
    let (settings, camera) = (settings(), &scene.camera);
    let mut renderer = GpuRenderer::new(&device.0, &scene.field).unwrap();
    renderer.render(&scene.field, camera, scene.time, &settings, CHANNELS).unwrap();
    let plain = renderer.render(&scene.field, camera, 0.9, &settings, Channels::default()).unwrap();
    let e = reference::render::<f64>(&scene.field, camera, 0.9, &settings, Channels::default());
    let far = plain.color.pixels.iter().zip(&e.color.pixels).filter(|(a, e)| (a[0] - e[0]).abs() > 1e-4);
    assert!(far.count() < plain.color.pixels.len() / 20);
    assert!(plain.depth.is_none() && plain.instances.is_none());
}

/// Spherical harmonics in 16-bit floats change no colour by half an 8-bit level; what moves them keeps 32 bits.
#[test]
fn compact_pictures_are_within_half_a_level() {
    let Some(device) = device() else { return };
    let mut least = f64::INFINITY;
    for (seed, heads, is_compact) in [(11, None, true), (12, None, true), (13, Some(ALL_HEADS), false)] {
        let mut synthetic = generate(&SyntheticConfig { seed, heads, ..config() });
        // Strong view dependence: colours of the higher bands reach the size of the constant one.
        for row in &mut synthetic.field.gaussians.sh_coefficients {
            row[3..].iter_mut().for_each(|value| *value *= 8.0);
        }
        let (settings, scene) = (settings(), Scene::<f64>::from_field(&synthetic.field));
        let (camera, time) = (&synthetic.camera, synthetic.time);
        let forward = reference::forward(&scene, camera, time, &settings, None);
        let mut renderer = GpuRenderer::compact(&device.0, &synthetic.field).unwrap();
        assert_eq!(renderer.is_compact(), is_compact);
        let actual = renderer.render(&synthetic.field, camera, time, &settings, Channels::default()).unwrap();
        let mut worst = 0.0_f64;
        for position in 0..actual.color.pixels.len() {
            if pixel_discontinuity(&forward, position, BAND).is_none() {
                for channel in 0..3 {
                    let a = f64::from(actual.color.pixels[position][channel]);
                    worst = worst.max((a - forward.color.pixels[position][channel]).abs());
                }
            }
        }
        println!("compact pictures, seed {seed}: worst colour {worst:.1e}");
        assert!(worst < if is_compact { 0.5 / 255.0 } else { 3e-5 }, "{worst}");
        if is_compact {
            least = least.min(worst);
        }
    }
    assert!(least > 5e-5, "the coefficients really are rounded: {least}");
}

/// Nothing depends on the order in which the device runs workgroups; and what is drawn is the same with subgroups and
/// without them, gradients but for the order in which pixels are added.
#[test]
fn two_runs_give_the_same_bits() {
    let Some(mut device) = device() else { return };
    let scene = generate(&SyntheticConfig { gaussians: 3000, ..config() });
    let cotangents = Cotangents::random(3, 71, 53);
    let gradients = |outcome: &Outcome| {
        let Outcome { geometry, sh, calibrations, .. } = outcome;
        [geometry.as_flattened().to_vec(), sh.as_flattened().to_vec(), calibrations.clone()]
    };
    let bits = |outcome: &Outcome| -> Vec<u32> {
        let drawn = outcome.colors.as_flattened().iter().copied();
        drawn.chain(gradients(outcome).concat()).map(f32::to_bits).collect()
    };
    let reference = run(&mut device, &scene, &settings(), &cotangents, |_| {}).unwrap();
    let first = bits(&reference);
    for _ in 0..3 {
        assert!(bits(&run(&mut device, &scene, &settings(), &cotangents, |_| {}).unwrap()) == first);
    }
    for gpu in testing::gpus() {
        let form = gpu.form();
        let rasterizer = Rasterizer::new(&gpu).unwrap();
        let mut device = (gpu, rasterizer);
        let outcome = run(&mut device, &scene, &settings(), &cotangents, |_| {}).unwrap();
        let again = run(&mut device, &scene, &settings(), &cotangents, |_| {}).unwrap();
        assert!(bits(&again) == bits(&outcome), "{form:?}");
        assert!(outcome.colors == reference.colors, "{form:?}");
        for (found, expected) in gradients(&outcome).into_iter().zip(gradients(&reference)) {
            let largest = expected.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
            let differences = found.iter().zip(&expected).map(|(a, b)| (a - b).abs());
            let worst = differences.fold(0.0_f32, f32::max);
            println!("{form:?}: gradients differ by {:.1e} of the largest", worst / largest);
            assert!(largest > 0.0 && worst <= 1e-5 * largest, "{form:?}: {worst} of {largest}");
        }
    }
    let moved = |splats: &mut Vec<Splat>| splats[0].mean[0] += 1e-3;
    assert!(bits(&run(&mut device, &scene, &settings(), &cotangents, moved).unwrap()) != first);
}

/// Row 34: a view with more pairs than the device holds is refused with the arithmetic, counted in 64 bits.
#[test]
fn too_many_pairs_are_refused_with_the_arithmetic() {
    let Some(mut device) = device() else { return };
    let mut scene = generate(&SyntheticConfig { gaussians: 150_000, width: 2800, height: 2800, ..config() });
    scene.field.gaussians.log_scales.fill([4.0; 3]);
    scene.field.gaussians.opacity_logits.fill(5.0);
    let settings = RenderSettings { instances: None, ..settings() };
    let (gpu, rasterizer) = &mut *device;
    let gpu: &Gpu = gpu;
    let gaussians = GpuGaussians::upload(gpu, &scene.field.gaussians).unwrap();
    let input = ViewInput { camera: &scene.camera, settings: &settings, labels: None };
    let mut commands = Commands::new(gpu, None);
    let result = rasterizer.project(gpu, &mut commands, (&gaussians).into(), None, &input);
    let refused = result.and_then(|()| rasterizer.measure(gpu, commands)).unwrap_err();
    let GpuError::TooLarge { count, bytes, .. } = refused.clone() else { panic!("{refused}") };
    // 175 x 175 tiles each, more than 2^32 pairs together.
    assert_eq!(count, 150_000 * 175 * 175);
    assert_eq!(bytes, 150_000 * 175 * 175 * 48);
    gpu.check().expect("the device is still fine");
}

#[test]
fn views_drawn_in_bands_are_those_drawn_at_once() {
    let Some(device) = device() else { return };
    let scene = generate(&SyntheticConfig { width: 70, height: 83, ..config() });
    let settings = RenderSettings::of_field(&scene.field);
    let channels = CHANNELS;
    for compact in [false, true] {
        let make = if compact { GpuRenderer::compact } else { GpuRenderer::new };
        let mut renderer = make(&device.0, &scene.field).unwrap();
        let (field, camera) = (&scene.field, &scene.camera);
        let whole = renderer.render(field, camera, scene.time, &settings, channels).unwrap();
        assert!(whole.alpha.pixels.iter().filter(|alpha| **alpha > 0.5).count() > 500);
        // One row of tiles at once, and two, of about 200 bytes a pixel.
        for (memory, first_rows) in [(1, vec![0_u32, 16, 32, 48, 64, 80]), (500_000, vec![0, 32, 64])] {
            renderer.set_band_memory(memory);
            let mut firsts = Vec::new();
            let bands =
                renderer.render_bands(field, camera, scene.time, &settings, channels, |first, band| {
                    assert_eq!(band.alpha.width, 70);
                    firsts.push(first);
                    Ok::<(), GpuError>(())
                });
            bands.unwrap();
            assert_eq!(firsts, first_rows, "{memory} bytes");
            let image = renderer.render(field, camera, scene.time, &settings, channels).unwrap();
            assert!(image == whole, "{memory} bytes, compact: {compact}");
        }
    }
}

/// Without a wait in between: what does not fit is not drawn, and the counts say so.
#[test]
fn a_view_that_does_not_fit_is_reported_and_leaves_no_gradient() {
    let Some(device) = device() else { return };
    let scene = generate(&config());
    let settings = RenderSettings { instances: None, ..settings() };
    let gpu = &device.0;
    let mut rasterizer = Rasterizer::new(gpu).unwrap();
    let gaussians = GpuGaussians::upload(gpu, &scene.field.gaussians).unwrap();
    let input = ViewInput { camera: &scene.camera, settings: &settings, labels: None };
    let v_colors = GpuVec::from_slice(gpu, "v", &vec![[1.0_f32; 4]; 71 * 53]).unwrap();
    for room in [10, 100_000] {
        rasterizer.reserve(gpu, room, 0).unwrap();
        let mut commands = Commands::new(gpu, None);
        rasterizer.project(gpu, &mut commands, (&gaussians).into(), None, &input).unwrap();
        rasterizer.rasterize(gpu, &mut commands, None, None).unwrap();
        rasterizer.backward(gpu, &mut commands, (&gaussians).into(), None, None, &v_colors).unwrap();
        let counts = rasterizer.read_statistics(gpu, &mut commands);
        commands.submit();
        let statistics = GpuStatistics::of(&counts.start().wait(gpu).unwrap());
        let gradients = rasterizer.gradients().gaussians.geometry.read(gpu).unwrap();
        let moved = gradients.as_flattened().iter().any(|v| *v != 0.0);
        assert!(statistics.wanted_pairs > 100, "{statistics:?}");
        assert_eq!((statistics.fits(), moved), (room > 10, room > 10), "{statistics:?}");
    }
}
