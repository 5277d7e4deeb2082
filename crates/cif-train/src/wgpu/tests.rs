//! Losses and optimiser on the device against the CPU's, which unit tests hold to formulas in double precision.

use cif_field::gaussians::SH_FLOATS;
use cif_field::{DeformationConfig, Gaussians, Heads, TimeEncoding};
use cif_geometry::PixelGrid;
use cif_render::Gradients;
use cif_render::wgpu::deform::{DeformationGradients, DeformedGaussians, FIXED_UNITS, SPLITS, ZERO_SUM};
use cif_render::wgpu::gaussians::{gaussians, geometry};
use cif_render::wgpu::validation::validate;
use cif_render::wgpu::{Commands, Gpu, GpuDeformation, GpuGaussians, GpuStatistics, GpuVec, Layout, testing};

use super::exposure::{CameraExposures, ExposedView, GpuExposure};
use super::judge::GpuJudge;
use cif_field::parameters::{
    LOG_CALIBRATIONS, LOG_SCALES, MEANS, MLP, OCCUPANCY_LOGITS, OPACITY_LOGITS, PLANES, Parameter,
    QUATERNIONS, SH_COEFFICIENTS,
};
use cif_render::wgpu::faults::bit;

use super::kernels::{Judgement, LAYOUTS, MODULES, fault, fault_name};
use super::losses::{DrawnPixels, GpuLosses, GpuTarget, LossWeights, ViewLoss};
use super::motion::GpuMotion;
use super::optimiser::{GaussianStep, GpuMoments, GpuOptimiser, GroupStep, GroupSteps, Optimised};
use crate::adam::{Moments, PlaneWeights, RowRates, step_planes};
use crate::density::DensifyStatistics;
use crate::exposure::{Exposures, RATES, WIDTH};
use crate::guidance::Pulls;
use crate::losses::displacement::{FREE, Pose, Pull, displacement_loss, rotations};
use crate::losses::{SsimScratch, color_loss};

/// Relative to the largest value of its kind.
const TOLERANCE: f64 = 3e-6;

fn wave(k: usize, s: f32) -> f32 {
    (k as f32 * s + s).sin()
}

fn compare(name: &str, found: &[f32], expected: &[f32], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{name}");
    let largest = expected.iter().fold(0.0_f64, |a, b| a.max(f64::from(b.abs()))).max(1e-30);
    let errors = found.iter().zip(expected).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs() / largest);
    let worst = errors.enumerate().fold((0, 0.0), |w, (k, e)| if e > w.1 || e.is_nan() { (k, e) } else { w });
    eprintln!("{name}: worst error {:.1e} of the largest, {largest:.2e}", worst.1);
    assert!(worst.1 <= tolerance, "{name}[{}]: {} and {}", worst.0, found[worst.0], expected[worst.0]);
}

#[test]
fn every_file_is_valid_and_lies_as_in_rust() {
    let layouts: Vec<Layout> = LAYOUTS.iter().map(|layout| layout()).collect();
    let wrong: String = MODULES.iter().filter_map(|module| validate(module, &layouts).err()).collect();
    assert!(wrong.is_empty(), "{wrong}");
    for module in MODULES {
        assert!(module.text.starts_with("// "), "{}.wgsl opens with what it does", module.name);
    }
}

#[test]
fn faults_have_the_names_of_the_cpu() {
    assert_eq!(
        fault_name(bit(&SH_COEFFICIENTS) | bit(&MLP)),
        ("gradients", "gradient of sh_coefficients".to_owned())
    );
    assert_eq!(fault_name(fault::EXPOSURES), ("gradients", "gradient of exposures".to_owned()));
    assert_eq!(fault_name(bit(&PLANES)), ("gradients", "gradient of planes".to_owned()));
    assert_eq!(fault_name(fault::INSTANCE_LOSS), ("losses", "instance loss".to_owned()));
    assert_eq!(fault::MAX_GRADIENT, crate::guard::MAX_GRADIENT, "both backends refuse the same gradients");
}

/// A view larger than a few workgroups, with partial windows at every border.
fn images() -> (PixelGrid<[f32; 3]>, PixelGrid<[u8; 3]>) {
    let (width, height) = (37, 29);
    let mut rendered = PixelGrid::filled(width, height, [0.0; 3]);
    let mut target = PixelGrid::filled(width, height, [0; 3]);
    for k in 0..rendered.pixels.len() {
        rendered.pixels[k] = std::array::from_fn(|c| 0.5 + 0.6 * wave(3 * k + c, 0.37));
        target.pixels[k] = std::array::from_fn(|c| (127.0 + 127.0 * wave(3 * k + c, 0.35)) as u8);
    }
    // Equal colours have no gradient by their difference.
    rendered.pixels[5] = target.pixels[5].map(|v| f32::from(v) / 255.0);
    (rendered, target)
}

fn four(pixels: &[[f32; 3]]) -> Vec<[f32; 4]> {
    pixels.iter().map(|[r, g, b]| [*r, *g, *b, 0.5]).collect()
}

fn flat(pixels: &[[f32; 4]]) -> Vec<f32> {
    pixels.iter().flat_map(|v| [v[0], v[1], v[2]]).collect()
}

#[test]
fn colour_losses_and_gradients_are_those_of_the_cpu() {
    testing::gpus().into_iter().for_each(colour_losses_on);
}

fn colour_losses_on(gpu: Gpu) {
    let (rendered, target) = images();
    let pixels = rendered.pixels.len();
    let mut losses = GpuLosses::new(&gpu).unwrap();
    let on_device = GpuTarget::new(&gpu, &target, None).unwrap();
    let colors = GpuVec::from_slice(&gpu, "colors", &four(&rendered.pixels)).unwrap();
    let blended = GpuVec::<[f32; 4]>::zeros(&gpu, "blended", pixels).unwrap();
    let drawn = DrawnPixels { colors: &colors, blended: &blended };
    for (slot, lambda_dssim) in [(0, 0.0), (63, 0.2), (7, 1.0)] {
        let mut v = PixelGrid::filled(0, 0, [0.0; 3]);
        let mut scratch = SsimScratch::default();
        let expected = color_loss(&rendered, &target, lambda_dssim, 0.5, &mut v, &mut scratch);
        let weights = LossWeights { lambda_dssim, view: 0.5, ..LossWeights::default() };
        let mut commands = Commands::new(&gpu, None);
        losses.record(&gpu, &mut commands, drawn, &on_device, &weights, slot).unwrap();
        commands.submit();
        let slots = losses.results().read(&gpu).unwrap();
        let mut commands = Commands::new(&gpu, None);
        losses.record(&gpu, &mut commands, drawn, &on_device, &weights, slot).unwrap();
        commands.submit();
        assert_eq!(losses.results().read(&gpu).unwrap(), slots, "sums repeat to the bit");
        let found = ViewLoss::new([slots[2 * slot], slots[2 * slot + 1]], pixels, lambda_dssim);
        assert!((found.color.loss - expected.loss).abs() < 1e-6, "{found:?} {expected:?}");
        assert!((found.color.psnr() - expected.psnr()).abs() < 1e-4, "{found:?} {expected:?}");
        let found = flat(&losses.v_colors.read(&gpu).unwrap());
        let tolerance = if lambda_dssim > 0.0 { 2e-5 } else { 1e-7 };
        compare("gradient of the colours", &found, v.pixels.as_flattened(), tolerance);
        if lambda_dssim == 0.0 {
            assert_eq!(found[15..18], [0.0; 3], "equal colours have no gradient");
        }
    }
}

#[test]
fn instance_losses_count_what_is_labelled_and_unsupported() {
    testing::gpus().into_iter().for_each(instance_losses_on);
}

fn instance_losses_on(gpu: Gpu) {
    let target = PixelGrid::filled(20, 15, [10_u8; 3]);
    let mut labels = PixelGrid::filled(20, 15, 0_u16);
    let mut blended = vec![[0.0, 0.5, 0.25, 0.0]; 300];
    for (k, label) in labels.pixels.iter_mut().enumerate() {
        *label = (k % 3) as u16;
    }
    blended[4] = [0.0, 0.0, 1.0, 0.0];
    blended[7] = [0.0, 1e-9, 0.5, 0.0];
    let mut losses = GpuLosses::new(&gpu).unwrap();
    let on_device = GpuTarget::new(&gpu, &target, Some(&labels)).unwrap();
    let colors = GpuVec::from_slice(&gpu, "colors", &[[0.1_f32; 4]; 300]).unwrap();
    let blended = GpuVec::from_slice(&gpu, "blended", &blended).unwrap();
    let drawn = DrawnPixels { colors: &colors, blended: &blended };
    for by_coverage in [false, true] {
        let weights = LossWeights { view: 1.0, with_instances: true, by_coverage, ..LossWeights::default() };
        let mut commands = Commands::new(&gpu, None);
        losses.record(&gpu, &mut commands, drawn, &on_device, &weights, 1).unwrap();
        commands.submit();
        let slots = losses.results().read(&gpu).unwrap();
        let found = ViewLoss::new([slots[2], slots[3]], 300, 0.0);
        let coverage = if by_coverage { 198.0 * 0.75_f64.ln() } else { 0.0 };
        let expected = -198.0 * 0.5_f64.ln() - 2.0 * 1e-8_f64.ln() + coverage;
        assert_eq!(found.unsupported, 2.0);
        assert!((found.instance_sum / expected - 1.0).abs() < 1e-6, "{} {expected}", found.instance_sum);
    }
}

/// Exposures of so many cameras, none of them neutral.
fn some_exposures(cameras: usize) -> Exposures {
    let mut exposures =
        Exposures::neutral((0..cameras).map(|k| format!("camera {k:04}")).collect(), Vec::new());
    let values = (0..cameras * WIDTH).map(|k| 0.2 * wave(k, 0.71)).collect();
    let zeros = vec![0.0; cameras * WIDTH];
    (exposures.values, exposures.first, exposures.second) = (values, zeros.clone(), zeros);
    exposures
}

#[test]
fn exposed_colours_and_their_gradients_are_those_of_the_cpu() {
    let Some(gpu) = testing::gpu() else { return };
    let (rendered, target) = images();
    let pixels = rendered.pixels.len();
    let (camera, cameras) = (1, some_exposures(3));
    let resident = CameraExposures::upload(&gpu, &cameras).unwrap();
    let mut exposure = GpuExposure::new(&gpu).unwrap();
    let mut losses = GpuLosses::new(&gpu).unwrap();
    let on_device = GpuTarget::new(&gpu, &target, None).unwrap();
    let colors = GpuVec::from_slice(&gpu, "colors", &four(&rendered.pixels)).unwrap();
    let blended = GpuVec::<[f32; 4]>::zeros(&gpu, "blended", pixels).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", fault::WORDS).unwrap();
    let view = ExposedView { cameras: &resident, camera, colors: &colors, pixels };
    // Sums are those in double precision; another view of the camera adds to them.
    let mut expected = [0.0_f64; WIDTH];
    for lambda_dssim in [0.0, 0.2] {
        let of_camera = cameras.at("camera 0001", 0.0);
        let mut recorded = rendered.clone();
        of_camera.apply(&mut recorded);
        let mut v = PixelGrid::filled(0, 0, [0.0; 3]);
        let loss = color_loss(&recorded, &target, lambda_dssim, 0.5, &mut v, &mut SsimScratch::default());
        for (v, color) in v.pixels.iter().zip(&rendered.pixels) {
            for c in 0..3 {
                expected[c] += f64::from(v[c]) * f64::from(of_camera.gain[c]) * f64::from(color[c]);
                expected[3 + c] += f64::from(v[c]);
            }
        }
        of_camera.pull_back(&rendered, &mut v);

        let weights = LossWeights { lambda_dssim, view: 0.5, ..LossWeights::default() };
        let mut commands = Commands::new(&gpu, None);
        exposure.expose(&gpu, &mut commands, view, &losses.v_colors, &faults).unwrap();
        let images = DrawnPixels { colors: &exposure.recorded, blended: &blended };
        losses.record(&gpu, &mut commands, images, &on_device, &weights, 2).unwrap();
        exposure.pull_back(&gpu, &mut commands, view, &losses.v_colors, &faults);
        commands.submit();
        let found = exposure.recorded.read(&gpu).unwrap();
        compare("recorded", &flat(&found), recorded.pixels.as_flattened(), 1e-6);
        assert!(found.iter().all(|pixel| pixel[3] == 0.5), "the transmittance stays");
        let slots = losses.results().read(&gpu).unwrap();
        let found = ViewLoss::new([slots[4], slots[5]], pixels, lambda_dssim);
        assert!((found.color.loss - loss.loss).abs() < 1e-6, "{found:?} {loss:?}");
        let found = flat(&losses.v_colors.read(&gpu).unwrap());
        let tolerance = if lambda_dssim > 0.0 { 2e-5 } else { 1e-6 };
        compare("gradient of the colours", &found, v.pixels.as_flattened(), tolerance);
        let gradients = resident.gradients().read(&gpu).unwrap();
        let expected = expected.map(|sum| sum as f32);
        compare("gradient of the exposure", &gradients[WIDTH..2 * WIDTH], &expected, 1e-5);
        assert!(gradients[..WIDTH].iter().chain(&gradients[2 * WIDTH..]).all(|g| *g == 0.0));
    }
    assert_eq!(faults.read(&gpu).unwrap()[0], 0);
    losses.v_colors.write(&gpu, 700, &[[0.0, 1e25, 0.0, 0.0]]);
    let mut commands = Commands::new(&gpu, None);
    exposure.pull_back(&gpu, &mut commands, view, &losses.v_colors, &faults);
    commands.submit();
    assert_eq!(faults.read(&gpu).unwrap()[..2], [fault::EXPOSURES, 0]);
}

#[test]
fn exposures_move_as_on_the_cpu() {
    let Some(gpu) = testing::gpu() else { return };
    let exposure = GpuExposure::new(&gpu).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", fault::WORDS).unwrap();
    // More than the kernel has invocations.
    for cameras in [2, 300] {
        let mut cpu = some_exposures(cameras);
        let resident = CameraExposures::upload(&gpu, &cpu).unwrap();
        for t in 1..=5_u32 {
            let mut gradients = vec![0.0; cameras * WIDTH];
            for camera in (0..cameras).filter(|camera| !(camera + t as usize).is_multiple_of(3)) {
                let gradient: [f32; WIDTH] =
                    std::array::from_fn(|k| 1e-2 * wave(WIDTH * camera + k, 0.3 + t as f32));
                cpu.add(&format!("camera {camera:04}"), 0.0, &gradient);
                gradients[WIDTH * camera..][..WIDTH].copy_from_slice(&gradient);
            }
            cpu.step(RATES[0]);
            resident.gradients().write(&gpu, 0, &gradients);
            let mut commands = Commands::new(&gpu, None);
            exposure.step(&gpu, &mut commands, step_of(RATES[0], t), &resident, &faults);
            commands.submit();
        }
        let found = resident.read(&gpu).unwrap();
        for ((name, found), expected) in ["exposures", "first moments", "second moments"]
            .iter()
            .zip(&found)
            .zip([&cpu.values, &cpu.first, &cpu.second])
        {
            compare(name, found, expected, TOLERANCE);
        }
        let unused = resident.gradients().read(&gpu).unwrap();
        assert!(unused.iter().all(|gradient| *gradient == 0.0));

        // While steps wait for the host nothing moves, and gradients are taken all the same.
        faults.write(&gpu, 1, &[1]);
        resident.gradients().write(&gpu, 0, &vec![f32::NAN; cameras * WIDTH]);
        let mut commands = Commands::new(&gpu, None);
        exposure.step(&gpu, &mut commands, step_of(RATES[0], 6), &resident, &faults);
        commands.submit();
        assert_eq!(resident.read(&gpu).unwrap(), found);
        assert_eq!(resident.gradients().read(&gpu).unwrap(), unused);
        faults.write(&gpu, 1, &[0]);
    }
}

fn some_gaussians(n: usize, s: f32, size: f32) -> Gaussians {
    let rows: Vec<[f32; 12]> = (0..n).map(|r| std::array::from_fn(|k| size * wave(12 * r + k, s))).collect();
    let sh: Vec<[f32; SH_FLOATS]> =
        (0..n).map(|r| std::array::from_fn(|k| size * wave(48 * r + k, s + 0.1))).collect();
    gaussians(&rows, sh)
}

fn step_of(rate: f32, steps: u32) -> GroupStep {
    GroupStep::uniform(rate, steps)
}

#[test]
fn gaussians_move_as_on_the_cpu() {
    let Some(gpu) = testing::gpu() else { return };
    let n = 150;
    let start = some_gaussians(n, 0.31, 1.0);
    let parameters = GpuGaussians::upload(&gpu, &start).unwrap();
    let gradients = GpuGaussians::zeros(&gpu, n).unwrap();
    let moments = [GpuGaussians::zeros(&gpu, n).unwrap(), GpuGaussians::zeros(&gpu, n).unwrap()];
    let screen: Vec<[f32; 4]> = (0..n).map(|r| [0.0, 0.0, 1.0, f32::from(r % 4 != 1)]).collect();
    let on_device = GpuVec::from_slice(&gpu, "screen", &screen).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
    let optimiser = GpuOptimiser::new(&gpu).unwrap();
    let visible: Vec<f32> = screen.iter().map(|row| row[3]).collect();

    let mut cpu = start.clone();
    let mut on_cpu = cpu.tensors().map(|(parameter, _)| Moments::zeros(n, parameter.width()));
    for t in 1..=6_u32 {
        let (visible_only, occupancy) = (t > 3, if t > 2 { 1e-2 } else { 0.0 });
        // From normal to vanishing: row 25 of the hard cases.
        let mut g = some_gaussians(n, 0.17 + t as f32 * 0.05, if t == 2 { 1e-22 } else { 1e-3 });
        gradients.geometry.write(&gpu, 0, &geometry(&g));
        gradients.sh.write(&gpu, 0, &g.sh_coefficients);
        let rates = |parameter: &Parameter| match *parameter {
            SH_COEFFICIENTS => RowRates::Split { base: 2.5e-3, rest: 1.25e-4, split: 3, active: 27 },
            OCCUPANCY_LOGITS => RowRates::Uniform(occupancy),
            MEANS => RowRates::Uniform(2e-3),
            OPACITY_LOGITS => RowRates::Uniform(5e-2),
            _ => RowRates::Uniform(5e-3),
        };
        let mut groups = GroupSteps::default();
        let tensors = cpu.tensors_mut().into_iter().zip(g.tensors_mut()).zip(&mut on_cpu);
        for (((parameter, values), (_, gradient)), moments) in tensors {
            let rates = rates(&parameter);
            if rates.move_anything() {
                moments.step(values, gradient, rates, visible_only.then_some(&visible[..])).unwrap();
            }
            groups.0.push((parameter, GroupStep { rates, steps: moments.steps }));
        }
        let step = GaussianStep { groups: &groups, visible_only, renormalise: false, occupancy_limits: None };
        let all = Optimised { parameters: &parameters, gradients: &gradients, moments: &moments };
        let mut commands = Commands::new(&gpu, None);
        optimiser.step_gaussians(&gpu, &mut commands, &step, &all, &on_device, &faults);
        commands.submit();
    }
    let all = [&parameters, &moments[0], &moments[1]].map(|rows| rows.download(&gpu).unwrap());
    let [found, first, second] = all.each_ref().map(Gaussians::tensors);
    for (k, (parameter, values)) in cpu.tensors().into_iter().enumerate() {
        compare(parameter.name, found[k].1, values, TOLERANCE);
        compare(&format!("first moments of {}", parameter.name), first[k].1, &on_cpu[k].first, TOLERANCE);
        compare(&format!("second moments of {}", parameter.name), second[k].1, &on_cpu[k].second, TOLERANCE);
    }
    assert_eq!(
        gradients.download(&gpu).unwrap(),
        GpuGaussians::zeros(&gpu, n).unwrap().download(&gpu).unwrap()
    );
    assert_eq!(faults.read(&gpu).unwrap()[0], 0);
}

#[test]
fn limits_and_unit_quaternions() {
    let Some(gpu) = testing::gpu() else { return };
    let mut start = some_gaussians(3, 0.31, 1.0);
    start.occupancy_logits = vec![-9.0, 0.5, 9.0];
    start.quaternions = vec![[0.0; 4], [3.0, 0.0, 4.0, 0.0], [1.0, 0.0, 0.0, 0.0]];
    let parameters = GpuGaussians::upload(&gpu, &start).unwrap();
    let moments = [GpuGaussians::zeros(&gpu, 3).unwrap(), GpuGaussians::zeros(&gpu, 3).unwrap()];
    let screen = GpuVec::<[f32; 4]>::zeros(&gpu, "screen", 3).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
    let optimiser = GpuOptimiser::new(&gpu).unwrap();
    let gradients = GpuGaussians::upload(&gpu, &some_gaussians(3, 0.2, 1e-3)).unwrap();
    let sh = RowRates::Split { base: 1e-2, rest: 1e-3, split: 3, active: 48 };
    let sh = GroupStep { rates: sh, steps: 1 };
    let groups = GroupSteps(vec![(LOG_SCALES, step_of(1e-2, 1)), (SH_COEFFICIENTS, sh)]);
    let step = GaussianStep {
        groups: &groups,
        visible_only: false,
        renormalise: true,
        occupancy_limits: Some([-5.0, 5.0]),
    };
    let all = Optimised { parameters: &parameters, gradients: &gradients, moments: &moments };
    let mut commands = Commands::new(&gpu, None);
    optimiser.step_gaussians(&gpu, &mut commands, &step, &all, &screen, &faults);
    commands.submit();
    let found = parameters.download(&gpu).unwrap();
    assert_eq!(found.occupancy_logits, [-5.0, 0.5, 5.0]);
    assert_eq!(found.quaternions[0], [0.0; 4]);
    compare("unit quaternion", &found.quaternions[1], &[0.6, 0.0, 0.8, 0.0], 1e-6);
    assert!(found.log_scales[1][0] != start.log_scales[1][0]);
    assert_eq!(found.means, start.means, "a rate of 0 keeps still");

    // While steps wait for the host nothing moves, and gradients are taken all the same.
    faults.write(&gpu, 1, &[1]);
    gradients.geometry.write(&gpu, 0, &[[f32::NAN; 12]; 3]);
    let mut commands = Commands::new(&gpu, None);
    optimiser.step_gaussians(&gpu, &mut commands, &step, &all, &screen, &faults);
    commands.submit();
    assert_eq!(parameters.download(&gpu).unwrap(), found);
    assert_eq!(gradients.download(&gpu).unwrap().log_scales, vec![[0.0; 3]; 3]);
}

#[test]
fn sums_that_no_optimiser_may_take_are_told_by_group() {
    let Some(gpu) = testing::gpu() else { return };
    let optimiser = GpuOptimiser::new(&gpu).unwrap();
    let n = 5;
    let mut bad: Vec<(u32, cif_field::Gaussians)> = vec![(0, some_gaussians(n, 0.3, 1.0))];
    let mut with = |bit: u32, damage: fn(&mut cif_field::Gaussians)| {
        let mut gaussians = some_gaussians(n, 0.3, 1.0);
        damage(&mut gaussians);
        bad.push((bit, gaussians));
    };
    with(bit(&MEANS), |g| g.means[3][2] = f32::NAN);
    with(bit(&OPACITY_LOGITS), |g| g.opacity_logits[0] = f32::INFINITY);
    with(bit(&LOG_SCALES), |g| g.log_scales[4][0] = -2e18);
    with(bit(&OCCUPANCY_LOGITS), |g| g.occupancy_logits[2] = f32::NEG_INFINITY);
    with(bit(&QUATERNIONS), |g| g.quaternions[1][3] = 1.5e18);
    with(bit(&SH_COEFFICIENTS), |g| g.sh_coefficients[4][47] = f32::NAN);
    with(bit(&SH_COEFFICIENTS) | bit(&MEANS), |g| {
        (g.sh_coefficients[0][0], g.means[0][0]) = (f32::NAN, f32::NAN)
    });
    with(0, |g| g.quaternions[1][3] = 0.9e18);
    for (bits, view) in bad {
        let faults = GpuVec::<u32>::zeros(&gpu, "faults", fault::WORDS).unwrap();
        let view = GpuGaussians::upload(&gpu, &view).unwrap();
        let total = GpuGaussians::zeros(&gpu, n).unwrap();
        let mut commands = Commands::new(&gpu, None);
        optimiser.add_gaussians(&gpu, &mut commands, &view, &total, true, &faults);
        commands.submit();
        assert_eq!(faults.read(&gpu).unwrap()[..2], [bits, 0]);
    }
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", fault::WORDS).unwrap();
    let view = GpuVec::from_slice(&gpu, "view", &[0.0, f32::NAN]).unwrap();
    let total = GpuVec::from_slice(&gpu, "total", &[1.0_f32, 2.0]).unwrap();
    let mut commands = Commands::new(&gpu, None);
    optimiser.add_calibrations(&gpu, &mut commands, &view, &total, &faults);
    commands.submit();
    assert_eq!(faults.read(&gpu).unwrap()[0], bit(&LOG_CALIBRATIONS));
}

#[test]
fn steps_wait_after_what_counts_and_only_then() {
    let Some(gpu) = testing::gpu() else { return };
    let judge = GpuJudge::new(&gpu).unwrap();
    let good = ([1.0, 2.0, 3.0, 4.0], [0.5, 0.0, 0.0, 0.0]);
    let fits = [7, 7];
    // Losses, pairs that there are and that were drawn, bits before, bits that count, whether last; bits, and waits.
    let cases = [
        (good, fits, 0, u32::MAX, 1, 0, 0),
        (([f32::NAN, 0.0, 0.0, 0.0], [0.0; 4]), fits, 0, u32::MAX, 1, fault::COLOR_LOSS, 1),
        (([0.0; 4], [f32::INFINITY, 0.0, 0.0, 0.0]), fits, 0, u32::MAX, 1, fault::COLOR_LOSS, 1),
        (([0.0, 0.0, f32::NAN, 0.0], [0.0; 4]), fits, 0, u32::MAX, 1, fault::INSTANCE_LOSS, 1),
        (good, [7, 0], 0, fault::NO_ROOM, 1, fault::NO_ROOM, 1),
        (good, [7, 0], 0, fault::NO_ROOM, 0, fault::NO_ROOM, 0),
        (good, fits, bit(&MEANS), bit(&MEANS) | bit(&SH_COEFFICIENTS), 1, bit(&MEANS), 1),
        (good, fits, bit(&MEANS), bit(&SH_COEFFICIENTS), 1, bit(&MEANS), 0),
    ];
    for (at, ((sums, similarity), [needed, drawn], before, counts, is_last, bits, waits)) in
        cases.into_iter().enumerate()
    {
        let results = GpuVec::from_slice(&gpu, "results", &[[9.0; 4], [9.0; 4], sums, similarity]).unwrap();
        let mut words = vec![0; GpuStatistics::WORDS];
        (words[GpuStatistics::WANTED_PAIRS], words[GpuStatistics::PAIRS]) = (needed, drawn);
        let words = GpuVec::from_slice(&gpu, "counts", &words).unwrap();
        let faults = GpuVec::from_slice(&gpu, "faults", &[before, 0_u32, 0, 0]).unwrap();
        let mut commands = Commands::new(&gpu, None);
        let judgement = Judgement { slot: 1, counts, known: 0, is_last };
        judge.record(&gpu, &mut commands, judgement, &results, &words, &faults);
        commands.submit();
        assert_eq!(faults.read(&gpu).unwrap()[..2], [bits, waits], "case {at}");
    }
}

#[test]
fn planes_network_and_calibrations_move_as_on_the_cpu() {
    let Some(gpu) = testing::gpu() else { return };
    for (time_resolution, encoding) in [(9, TimeEncoding::Compact), (2, TimeEncoding::Compat)] {
        let config = DeformationConfig {
            spatial_resolution: [5, 4, 2],
            time_resolution,
            multipliers: vec![1, 2],
            channels: 3,
            width: 6,
            heads: Heads { position: true, scale: false, rotation: true, opacity: true, sh: false },
            time_encoding: encoding,
        };
        let bounds = cif_geometry::Bounds { low: glam::DVec3::NEG_ONE, high: glam::DVec3::ONE };
        let field = cif_field::Deformation::new(config.clone(), bounds, 2.0, 3, false).unwrap();
        let mut optimiser = GpuOptimiser::new(&gpu).unwrap();
        let deformation = GpuDeformation::new(&gpu, &field).unwrap();
        let gradients = DeformationGradients::zeros(&gpu, &deformation).unwrap();
        let (planes, mlp) = (field.planes.len(), field.mlp.len());
        let zeros = |label, n: usize| GpuMoments::upload(&gpu, label, &vec![0.0; n], &vec![0.0; n]).unwrap();
        let moments = [zeros("planes", planes), zeros("mlp", mlp)];
        let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
        let weights = PlaneWeights { smoothness: 1e-2, time_smoothness: 2e-2, time_sparsity: 1e-2 };
        let calibrations = GpuVec::from_slice(&gpu, "calibrations", &[0.0_f32, 9.99, -9.99, 1.0]).unwrap();
        let of_calibrations = zeros("calibrations", 4);

        let mut cpu = field.clone();
        let (mut p, mut w) = (Moments::zeros(planes, 1), Moments::zeros(mlp, 1));
        let (mut c, mut mu) = (Moments::zeros(4, 1), [0.0_f32, 9.99, -9.99, 1.0]);
        for t in 1..=5_u32 {
            let mut g: Vec<f32> = (0..planes).map(|k| 1e-4 * wave(k, 0.3 + t as f32)).collect();
            let mut h: Vec<f32> = (0..mlp).map(|k| 1e-3 * wave(k, 0.7 + t as f32)).collect();
            let sums: Vec<[u32; 2]> = g
                .iter()
                .map(|v| {
                    let units = (f64::from(*v) * FIXED_UNITS) as i64 + i64::from(ZERO_SUM[0]);
                    [units as u32, (units >> 32) as u32]
                })
                .collect();
            gradients.sums.write(&gpu, 0, &sums);
            // In two of the parts.
            for (part, share) in [(0, 0.25), (SPLITS as usize - 1, 0.75)] {
                let values: Vec<f32> = h.iter().map(|v| v * share).collect();
                gradients.parts.write(&gpu, part * mlp, &values);
            }
            let v_mu = GpuVec::from_slice(&gpu, "v_mu", &[1e-3_f32, -1.0, 1.0, 0.0]).unwrap();
            step_planes(&mut p, &mut cpu.planes, &mut g, &config, &weights, 1e-2, &mut Vec::new()).unwrap();
            w.step(&mut cpu.mlp, &mut h, RowRates::Uniform(2e-3), None).unwrap();
            c.step(&mut mu, &mut [1e-3, -1.0, 1.0, 0.0], RowRates::Uniform(1e-2), None).unwrap();
            mu.iter_mut().for_each(|v| *v = v.clamp(-10.0, 10.0));
            let mut commands = Commands::new(&gpu, None);
            optimiser
                .step_deformation(
                    &gpu,
                    &mut commands,
                    &GroupSteps(vec![(PLANES, step_of(1e-2, t)), (MLP, step_of(2e-3, t))]),
                    &weights,
                    &Optimised { parameters: &deformation, gradients: &gradients, moments: &moments },
                    &faults,
                )
                .unwrap();
            let of = Optimised { parameters: &calibrations, gradients: &v_mu, moments: &of_calibrations };
            optimiser.step_calibrations(&gpu, &mut commands, step_of(1e-2, t), 10.0, &of, &faults);
            commands.submit();
            // From equal parameters every step: where a gradient crosses zero, Adam's first steps turn the
            // rounding of a sum into a whole step.
            let found = deformation.planes.read(&gpu).unwrap();
            compare("planes", &found, &cpu.planes, 2e-5);
        }
        compare("network", &deformation.mlp.read(&gpu).unwrap(), &cpu.mlp, TOLERANCE);
        compare("calibrations", &calibrations.read(&gpu).unwrap(), &mu, TOLERANCE);
        assert_eq!(calibrations.read(&gpu).unwrap()[1], 10.0, "kept within the limit");
        assert!(gradients.sums.read(&gpu).unwrap()[..planes].iter().all(|sum| *sum == ZERO_SUM));
        assert!(gradients.parts.read(&gpu).unwrap().iter().all(|part| *part == 0.0));
        assert_eq!(faults.read(&gpu).unwrap()[0], 0);
    }
}

#[test]
fn statistics_and_sums_are_those_of_the_cpu() {
    let Some(gpu) = testing::gpu() else { return };
    let n = 300;
    let optimiser = GpuOptimiser::new(&gpu).unwrap();
    let total = GpuVec::<[f32; 4]>::zeros(&gpu, "screen", n).unwrap();
    let statistics = GpuVec::<[f32; 4]>::zeros(&gpu, "statistics", n).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", fault::WORDS).unwrap();
    let mut expected = DensifyStatistics::zeros(n);
    let field = cif_render::synthetic::generate(&cif_render::synthetic::SyntheticConfig {
        gaussians: n,
        ..Default::default()
    })
    .field;
    for step in 0..3 {
        let mut gradients = Gradients::zeros(&field);
        total.write(&gpu, 0, &vec![[0.0; 4]; n]);
        for view in 0..2 {
            let rows: Vec<[f32; 4]> = (0..n)
                .map(|r| {
                    if (r + view + step) % 3 == 0 {
                        [0.0; 4]
                    } else {
                        let s = 0.3 + view as f32;
                        [wave(r, s), wave(r, s + 0.2), 2.0 + wave(r, s), 1.0]
                    }
                })
                .collect();
            for (r, row) in rows.iter().enumerate() {
                gradients.screen[r][0] += row[0];
                gradients.screen[r][1] += row[1];
                gradients.radii[r] = gradients.radii[r].max(row[2]);
            }
            let of_view = GpuVec::from_slice(&gpu, "view", &rows).unwrap();
            let mut commands = Commands::new(&gpu, None);
            optimiser.add_screen(&gpu, &mut commands, &of_view, &total, &faults);
            commands.submit();
        }
        expected.add(&gradients);
        let mut commands = Commands::new(&gpu, None);
        optimiser.add_statistics(&gpu, &mut commands, &total, &statistics, &faults);
        commands.submit();
    }
    let found = statistics.read(&gpu).unwrap();
    let column = |k: usize| found.iter().map(|row| row[k]).collect::<Vec<f32>>();
    compare("summed norms", &column(0), &expected.gradient, 1e-6);
    assert_eq!(column(1), expected.count.iter().map(|c| *c as f32).collect::<Vec<f32>>());
    assert_eq!(column(2), expected.radius);

    let (a, b) = (some_gaussians(n, 0.3, 1.0), some_gaussians(n, 0.4, 1.0));
    let (view, sum) = (GpuGaussians::upload(&gpu, &a).unwrap(), GpuGaussians::upload(&gpu, &b).unwrap());
    let mut commands = Commands::new(&gpu, None);
    optimiser.add_gaussians(&gpu, &mut commands, &view, &sum, true, &faults);
    let of_view = GpuVec::from_slice(&gpu, "view", &[1.0_f32, 2.0, 3.0]).unwrap();
    let calibrations = GpuVec::from_slice(&gpu, "total", &[10.0_f32, 20.0, 30.0]).unwrap();
    optimiser.add_calibrations(&gpu, &mut commands, &of_view, &calibrations, &faults);
    commands.submit();
    let found = sum.download(&gpu).unwrap();
    assert_eq!(found.means[7], [0, 1, 2].map(|k| a.means[7][k] + b.means[7][k]));
    assert_eq!(found.sh_coefficients[9][47], a.sh_coefficients[9][47] + b.sh_coefficients[9][47]);
    assert_eq!(calibrations.read(&gpu).unwrap(), [11.0, 22.0, 33.0]);
}

#[test]
fn identities_are_a_softmax_over_the_support() {
    let Some(gpu) = testing::gpu() else { return };
    let rows = cif_field::Identities {
        row_offsets: vec![0, 3, 4, 4, 6],
        labels: vec![0, 2, 5, 1, 2, 5],
        log_estimates: [0.2_f32, 0.5, 0.3, 1.0, 0.5, 0.5].map(f32::ln).to_vec(),
        log_calibrations: vec![1000.0, -980.0, 1000.1, 3.0, 0.0, 0.0],
        owners: Vec::new(),
    };
    let optimiser = GpuOptimiser::new(&gpu).unwrap();
    let offsets = GpuVec::from_slice(&gpu, "offsets", &rows.row_offsets).unwrap();
    let estimates = GpuVec::from_slice(&gpu, "estimates", &rows.log_estimates).unwrap();
    let calibrations = GpuVec::from_slice(&gpu, "calibrations", &rows.log_calibrations).unwrap();
    let labels: Vec<[u32; 2]> = rows.labels.iter().map(|label| [u32::from(*label), 0]).collect();
    let identities = GpuVec::from_slice(&gpu, "identities", &labels).unwrap();
    let mut commands = Commands::new(&gpu, None);
    optimiser.identities(&gpu, &mut commands, &offsets, &estimates, &calibrations, &identities);
    commands.submit();
    let found = identities.read(&gpu).unwrap();
    assert!(found.iter().zip(&rows.labels).all(|(row, label)| row[0] == u32::from(*label)));
    let found: Vec<f32> = found.iter().map(|row| f32::from_bits(row[1])).collect();
    compare("probabilities", &found, &rows.probabilities(), 1e-6);
}

#[test]
fn pulls_are_those_of_the_cpu_and_leave_the_direct_path_alone() {
    testing::gpus().into_iter().for_each(pulls_on);
}

fn pulls_on(gpu: Gpu) {
    let n = 700;
    let canonical = some_gaussians(n, 0.31, 1.0);
    let guide_of: Vec<u16> = (0..n).map(|row| [0, 1, 2, 3, 0, 1, FREE][row % 7]).collect();
    let mut posed = canonical.clone();
    let turn = glam::DMat3::from_rotation_z(0.8) * glam::DMat3::from_rotation_x(-0.3);
    for (row, mean) in posed.means.iter_mut().enumerate() {
        let place = glam::DVec3::from(mean.map(f64::from));
        let noise = glam::DVec3::new(0.02, 0.01, -0.02) * f64::from(wave(row, 0.9));
        let moved = if guide_of[row] == 1 { turn * place + 0.3 } else { place };
        *mean = (moved + noise).as_vec3().to_array();
    }
    let shifts = [0.25, -0.1, 0.4].map(glam::DVec3::splat).to_vec();
    let strengths = [Pull { weight: 10.0, reach: 0.02 }, Pull { weight: 1.0, reach: 0.002 }];
    let poses: Vec<Pose> = shifts
        .iter()
        .zip(rotations(&posed.means, &canonical.means, &guide_of, 3))
        .map(|(shift, rotation)| Pose { shift: *shift, rotation })
        .collect();
    let expected = displacement_loss(&posed.means, &canonical.means, &guide_of, &poses, strengths, 2.5).1;

    let mut motion = GpuMotion::new(&gpu).unwrap();
    motion.send(&gpu, &guide_of).unwrap();
    let on_device = GpuGaussians::upload(&gpu, &posed).unwrap();
    let places = GpuGaussians::upload(&gpu, &canonical).unwrap();
    let (v_posed, v_canonical) =
        (GpuGaussians::zeros(&gpu, n).unwrap(), GpuGaussians::zeros(&gpu, n).unwrap());
    let mut commands = Commands::new(&gpu, None);
    let both = DeformedGaussians { canonical: &places, v_posed: &v_posed, v_canonical: &v_canonical };
    motion.record(&gpu, &mut commands, &Pulls { shifts, strengths }, 2.5, &on_device, both).unwrap();
    commands.submit();
    let (found, taken) = (v_posed.download(&gpu).unwrap(), v_canonical.download(&gpu).unwrap());
    compare("pulls", found.means.as_flattened(), expected.as_flattened(), 2e-5);
    for (found, taken) in found.means.as_flattened().iter().zip(taken.means.as_flattened()) {
        assert_eq!(*found, -*taken);
    }
    assert!(found.opacity_logits.iter().all(|v| *v == 0.0));
}

#[test]
fn pixels_that_are_judged_by_have_no_gradient() {
    let Some(gpu) = testing::gpu() else { return };
    let (rendered, target) = images();
    let mut losses = GpuLosses::new(&gpu).unwrap();
    let on_device = GpuTarget::new(&gpu, &target, None).unwrap();
    let colors = GpuVec::from_slice(&gpu, "colors", &four(&rendered.pixels)).unwrap();
    let blended = GpuVec::<[f32; 4]>::zeros(&gpu, "blended", rendered.pixels.len()).unwrap();
    let drawn = DrawnPixels { colors: &colors, blended: &blended };
    let mut gradients = [false, true].map(|leaves_judged| {
        let weights = LossWeights { view: 1.0, leaves_judged, ..LossWeights::default() };
        let mut commands = Commands::new(&gpu, None);
        losses.record(&gpu, &mut commands, drawn, &on_device, &weights, 0).unwrap();
        commands.submit();
        losses.v_colors.read(&gpu).unwrap()
    });
    let width = target.width as usize;
    let mut left_out = 0;
    for k in (0..target.pixels.len()).filter(|k| k % width % 8 == 3 && k / width % 8 == 5) {
        left_out += usize::from(gradients[0][k] != [0.0; 4]);
        gradients[0][k] = [0.0; 4];
    }
    assert!(left_out > 0, "the pixels would have had gradients");
    assert_eq!(gradients[0], gradients[1]);
}

#[test]
fn labels_that_are_left_out_have_no_gradient() {
    let Some(gpu) = testing::gpu() else { return };
    let (rendered, target) = images();
    let mut labels = PixelGrid::filled(target.width, target.height, 0_u16);
    labels.pixels.iter_mut().enumerate().for_each(|(k, label)| *label = (k % 3) as u16);
    let mut losses = GpuLosses::new(&gpu).unwrap();
    losses.leave_out(&gpu, &[false, false, true]).unwrap();
    let on_device = GpuTarget::new(&gpu, &target, Some(&labels)).unwrap();
    let colors = GpuVec::from_slice(&gpu, "colors", &four(&rendered.pixels)).unwrap();
    let blended = GpuVec::<[f32; 4]>::zeros(&gpu, "blended", rendered.pixels.len()).unwrap();
    let drawn = DrawnPixels { colors: &colors, blended: &blended };
    let weights = LossWeights { lambda_dssim: 0.2, view: 1.0, leaves_out: true, ..LossWeights::default() };
    let mut commands = Commands::new(&gpu, None);
    losses.record(&gpu, &mut commands, drawn, &on_device, &weights, 0).unwrap();
    commands.submit();
    for (k, v) in losses.v_colors.read(&gpu).unwrap().iter().enumerate() {
        assert_eq!(*v == [0.0; 4], k % 3 == 2, "pixel {k}: {v:?}");
    }
}
