//! Each stage of the deformation against the double-precision reference, on the reference's own inputs.

use cif_field::gaussians::SH_FLOATS;
use cif_field::{Heads, parameters};

use super::*;
use crate::reference::{self, Gaussian, Scene};
use crate::synthetic::{ALL_HEADS, SyntheticConfig, SyntheticScene, generate};
use crate::wgpu::faults::bit;
use crate::wgpu::gaussians::{gaussians, geometry};
use crate::wgpu::testing;
use crate::wgpu::validation::validate_with;

/// Relative to the largest value of its kind: forward values.
const FORWARD: f64 = 2e-6;

/// Relative to the largest value of its kind: gradients.
const BACKWARD: f64 = 2e-5;

const SOME_HEADS: Heads = Heads { position: true, scale: false, rotation: true, opacity: false, sh: false };

/// True when a row stands still.
type Still = fn(usize) -> bool;

fn scene(heads: Heads, gaussians: usize) -> SyntheticScene {
    let config = SyntheticConfig { seed: 5, gaussians, heads: Some(heads), ..SyntheticConfig::default() };
    let mut scene = generate(&config);
    let field = &mut scene.field;
    let deformation = field.deformation.as_mut().expect("heads were asked for");
    // A zero factor, the corners of the box, far outside, and a node exactly.
    let layout = deformation.config.plane_layout().0[0][1].clone();
    for value in &mut deformation.planes[layout.offset..layout.offset + 40] {
        *value = 0.0;
    }
    for corner in [&mut deformation.bounds.low, &mut deformation.bounds.high] {
        *corner = corner.as_vec3().as_dvec3();
    }
    let (low, high) = (deformation.bounds.low.as_vec3(), deformation.bounds.high.as_vec3());
    for (row, place) in [high, low, high * 3.0, low - 100.0].into_iter().enumerate() {
        field.gaussians.means[row] = place.to_array();
    }
    scene
}

/// Tolerance-checked comparison of named arrays; prints the worst error.
fn compare(name: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{name}");
    let largest = expected.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
    let mut worst = (0.0_f64, 0);
    for (k, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!(a.is_finite(), "{name}[{k}] is {a}, expected {b}");
        let error = (a - b).abs() / largest.max(1e-30);
        if error > worst.0 {
            worst = (error, k);
        }
    }
    eprintln!("{name}: worst error {:.1e} of the largest, {largest:.2e}", worst.0);
    let k = worst.1;
    assert!(
        worst.0 <= tolerance,
        "{name}[{k}]: {} differs from {} by {:.2e} of the largest",
        found[k],
        expected[k],
        worst.0
    );
}

fn doubles<'a>(values: impl IntoIterator<Item = &'a f32>) -> Vec<f64> {
    values.into_iter().map(|v| f64::from(*v)).collect()
}

#[test]
fn every_file_is_valid_for_narrow_and_wide_networks() {
    let layouts: Vec<Layout> = LAYOUTS.iter().map(|layout| layout()).collect();
    let mut deformation = scene(ALL_HEADS, 8).field.deformation.expect("heads were asked for");
    for (width, channels, heads) in
        [(12, 4, ALL_HEADS), (64, 32, SOME_HEADS), (128, 16, ALL_HEADS), (1, 1, SOME_HEADS)]
    {
        deformation.config.width = width;
        deformation.config.channels = channels;
        deformation.config.heads = heads;
        let shape = Shape::new(&deformation, 1 << 27).expect("fits");
        for module in MODULES {
            for declarations in [shape.forward_declarations(), shape.backward_declarations()] {
                validate_with(module, &declarations, &layouts).unwrap_or_else(|wrong| panic!("{wrong}"));
            }
            assert!(module.text.starts_with("// "), "{} opens with what it does", module.name);
        }
    }
}

#[test]
fn fixed_point_sums_read_back() {
    assert_eq!(fixed_sum(ZERO_SUM), 0.0);
    assert_eq!(fixed_sum([ZERO_SUM[0] + 3, 0]), 3.0 / FIXED_UNITS);
    assert_eq!(fixed_sum([ZERO_SUM[0] - 3, 0]), -3.0 / FIXED_UNITS);
    assert_eq!(fixed_sum([ZERO_SUM[0], 1]), 2f64.powi(-18));
}

#[test]
fn posed_gaussians_agree_with_the_reference() {
    let Some(gpu) = testing::gpu() else { return };
    for (heads, n) in [(ALL_HEADS, 100), (SOME_HEADS, 77), (ALL_HEADS, 5)] {
        let scene = scene(heads, n);
        let field = &scene.field;
        let deformation = GpuDeformation::new(&gpu, field.deformation.as_ref().expect("has one")).unwrap();
        let canonical = GpuGaussians::upload(&gpu, &field.gaussians).unwrap();
        let posed = GpuGaussians::upload(&gpu, &field.gaussians).unwrap();
        let double = Scene::<f64>::from_field(field);
        for time in [0.0, 0.37, 1.0] {
            let mut commands = Commands::new(&gpu, None);
            deformation.forward(&gpu, &mut commands, time, &canonical, &posed);
            commands.submit();
            let found = posed.download(&gpu).unwrap();
            let expected: Vec<Gaussian<f64>> =
                (0..n).map(|row| reference::deform::deform(&double, row, time, true).gaussian).collect();
            let flat = |part: fn(&Gaussian<f64>) -> &[f64]| -> Vec<f64> {
                expected.iter().flat_map(|g| part(g).to_vec()).collect()
            };
            let name = |part: &str| format!("{part} of {n} at {time}");
            compare(&name("means"), &doubles(found.means.as_flattened()), &flat(|g| &g.mean), FORWARD);
            compare(
                &name("log-scales"),
                &doubles(found.log_scales.as_flattened()),
                &flat(|g| &g.log_scale),
                FORWARD,
            );
            compare(
                &name("quaternions"),
                &doubles(found.quaternions.as_flattened()),
                &flat(|g| &g.quaternion),
                FORWARD,
            );
            compare(
                &name("opacity logits"),
                &doubles(&found.opacity_logits),
                &flat(|g| std::slice::from_ref(&g.opacity_logit)),
                FORWARD,
            );
            compare(
                &name("spherical harmonics"),
                &doubles(found.sh_coefficients.as_flattened()),
                &flat(|g| &g.sh),
                FORWARD,
            );
            assert_eq!(found.occupancy_logits, field.gaussians.occupancy_logits, "occupancy has no head");
        }
    }
}

/// Gradients by the posed Gaussians: some rows none at all.
fn cotangents(n: usize) -> cif_field::Gaussians {
    let wave = |row: usize, k: usize| {
        if row % 5 == 2 || (32..64).contains(&row) {
            0.0
        } else {
            ((row * 61 + k * 17) as f32 * 0.7).sin() * 1e-3
        }
    };
    let rows: Vec<[f32; 12]> = (0..n).map(|row| std::array::from_fn(|k| wave(row, k))).collect();
    let sh: Vec<[f32; SH_FLOATS]> = (0..n).map(|row| std::array::from_fn(|k| wave(row, 12 + k))).collect();
    gaussians(&rows, sh)
}

#[test]
fn gradients_agree_with_the_reference_and_repeat_to_the_bit() {
    let Some(gpu) = testing::gpu() else { return };
    // Of some Gaussians that stand still, and of all of them.
    let some = |row: usize| row % 3 == 1 || (40..75).contains(&row);
    let cases: [(Heads, usize, Option<Still>); 5] = [
        (ALL_HEADS, 150, None),
        (SOME_HEADS, 77, None),
        (ALL_HEADS, 150, Some(some)),
        (SOME_HEADS, 77, Some(some)),
        (SOME_HEADS, 77, Some(|_| true)),
    ];
    for (heads, n, still) in cases {
        let mut scene = scene(heads, n);
        if let (Some(still), Some(deformation)) = (still, &mut scene.field.deformation) {
            deformation.still = (0..n).map(still).collect();
        }
        let field = &scene.field;
        let config = &field.deformation.as_ref().expect("has one").config;
        let v = cotangents(n);
        let double = Scene::<f64>::from_field(field);
        let v_double = Scene::<f64>::from_field(&cif_field::Field { gaussians: v.clone(), ..field.clone() });
        let mut expected = double.parameters.zeros_like();
        // Two views of a step at different times.
        let times = [0.37, 0.9];
        for time in times {
            for row in 0..n {
                let deformed = reference::deform::deform(&double, row, time, true);
                let v_row = &v_double.parameters.gaussians[row];
                reference::deform::deform_backward(&double, row, &deformed, v_row, &mut expected);
            }
        }
        let run = || {
            let deformation =
                GpuDeformation::new(&gpu, field.deformation.as_ref().expect("has one")).unwrap();
            let mut gradients = DeformationGradients::zeros(&gpu, &deformation).unwrap();
            let canonical = GpuGaussians::upload(&gpu, &field.gaussians).unwrap();
            let posed = GpuGaussians::zeros(&gpu, n).unwrap();
            let v_posed = GpuGaussians::upload(&gpu, &v).unwrap();
            let v_canonical = GpuGaussians::zeros(&gpu, n).unwrap();
            let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
            for time in times {
                let mut commands = Commands::new(&gpu, None);
                deformation.forward(&gpu, &mut commands, time, &canonical, &posed);
                gradients.backward(
                    &gpu,
                    &mut commands,
                    &deformation,
                    time,
                    DeformedGaussians { canonical: &canonical, v_posed: &v_posed, v_canonical: &v_canonical },
                    &faults,
                );
                commands.submit();
            }
            assert_eq!(faults.read(&gpu).unwrap()[0], 0);
            let sums = gradients.sums.read(&gpu).unwrap();
            let parts = gradients.parts.read(&gpu).unwrap();
            (v_canonical.download(&gpu).unwrap(), sums, parts)
        };
        let (v_canonical, sums, parts) = run();
        let again = run();
        assert_eq!(geometry(&v_canonical), geometry(&again.0), "centres repeat to the bit");
        assert_eq!((&sums, &parts), (&again.1, &again.2), "planes and weights repeat to the bit");

        let planes = config.plane_layout().1;
        let found: Vec<f64> = sums.iter().map(|sum| fixed_sum(*sum)).collect();
        compare("planes", &found[..planes], &expected.planes, BACKWARD);
        assert!(found[planes..].iter().all(|line| *line == 0.0), "lines are empty for the next view");
        let floats = config.mlp_layout().len;
        let mlp: Vec<f64> = (0..floats)
            .map(|k| parts.iter().skip(k).step_by(floats).map(|part| f64::from(*part)).sum())
            .collect();
        compare("network", &mlp, &expected.mlp, BACKWARD);
        let flat = |part: fn(&Gaussian<f64>) -> &[f64]| -> Vec<f64> {
            expected.gaussians.iter().flat_map(|g| part(g).to_vec()).collect()
        };
        compare("centres", &doubles(v_canonical.means.as_flattened()), &flat(|g| &g.mean), BACKWARD);
        compare(
            "log-scales",
            &doubles(v_canonical.log_scales.as_flattened()),
            &flat(|g| &g.log_scale),
            BACKWARD,
        );
        compare(
            "quaternions",
            &doubles(v_canonical.quaternions.as_flattened()),
            &flat(|g| &g.quaternion),
            BACKWARD,
        );
        compare(
            "occupancy logits",
            &doubles(&v_canonical.occupancy_logits),
            &flat(|g| std::slice::from_ref(&g.occupancy_logit)),
            BACKWARD,
        );
    }
}

#[test]
fn several_chunks_are_as_one() {
    let Some(gpu) = testing::gpu() else { return };
    // More than a chunk holds.
    let n = 34_000;
    let scene = scene(SOME_HEADS, n);
    let field = &scene.field;
    let deformation = GpuDeformation::new(&gpu, field.deformation.as_ref().expect("has one")).unwrap();
    assert!((deformation.shape().chunk_rows as usize) < n, "the test needs two chunks");
    let v = cotangents(n);
    let double = Scene::<f64>::from_field(field);
    let v_double = Scene::<f64>::from_field(&cif_field::Field { gaussians: v.clone(), ..field.clone() });
    let mut expected = double.parameters.zeros_like();
    for row in 0..n {
        let deformed = reference::deform::deform(&double, row, 0.37, true);
        let v_row = &v_double.parameters.gaussians[row];
        reference::deform::deform_backward(&double, row, &deformed, v_row, &mut expected);
    }
    let mut gradients = DeformationGradients::zeros(&gpu, &deformation).unwrap();
    let canonical = GpuGaussians::upload(&gpu, &field.gaussians).unwrap();
    let posed = GpuGaussians::zeros(&gpu, n).unwrap();
    let v_posed = GpuGaussians::upload(&gpu, &v).unwrap();
    let v_canonical = GpuGaussians::zeros(&gpu, n).unwrap();
    let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
    let mut commands = Commands::new(&gpu, None);
    deformation.forward(&gpu, &mut commands, 0.37, &canonical, &posed);
    gradients.backward(
        &gpu,
        &mut commands,
        &deformation,
        0.37,
        DeformedGaussians { canonical: &canonical, v_posed: &v_posed, v_canonical: &v_canonical },
        &faults,
    );
    commands.submit();
    assert_eq!(faults.read(&gpu).unwrap()[0], 0);
    let found: Vec<f64> = gradients.sums.read(&gpu).unwrap().iter().map(|sum| fixed_sum(*sum)).collect();
    compare("planes", &found[..expected.planes.len()], &expected.planes, 1e-4);
    let parts = gradients.parts.read(&gpu).unwrap();
    let floats = expected.mlp.len();
    let mlp: Vec<f64> = (0..floats)
        .map(|k| parts.iter().skip(k).step_by(floats).map(|part| f64::from(*part)).sum())
        .collect();
    compare("network", &mlp, &expected.mlp, 1e-4);
    let means: Vec<f64> = expected.gaussians.iter().flat_map(|g| g.mean).collect();
    let v_means = v_canonical.download(&gpu).unwrap().means;
    compare("centres", &doubles(v_means.as_flattened()), &means, 1e-4);
}

#[test]
fn gradients_that_are_not_finite_are_reported() {
    let Some(gpu) = testing::gpu() else { return };
    let scene = scene(SOME_HEADS, 40);
    let field = &scene.field;
    let deformation = GpuDeformation::new(&gpu, field.deformation.as_ref().expect("has one")).unwrap();
    let canonical = GpuGaussians::upload(&gpu, &field.gaussians).unwrap();
    let posed = GpuGaussians::zeros(&gpu, 40).unwrap();
    for bad in [f32::NAN, f32::INFINITY, 1e30] {
        let mut v = cotangents(40);
        v.means[20] = [bad; 3];
        let mut gradients = DeformationGradients::zeros(&gpu, &deformation).unwrap();
        let v_posed = GpuGaussians::upload(&gpu, &v).unwrap();
        let v_canonical = GpuGaussians::zeros(&gpu, 40).unwrap();
        let faults = GpuVec::<u32>::zeros(&gpu, "faults", 4).unwrap();
        let mut commands = Commands::new(&gpu, None);
        deformation.forward(&gpu, &mut commands, 0.5, &canonical, &posed);
        gradients.backward(
            &gpu,
            &mut commands,
            &deformation,
            0.5,
            DeformedGaussians { canonical: &canonical, v_posed: &v_posed, v_canonical: &v_canonical },
            &faults,
        );
        commands.submit();
        let reported = bit(&parameters::PLANES) | bit(&parameters::MEANS);
        assert_eq!(faults.read(&gpu).unwrap()[0] & reported, reported, "{bad}");
    }
}
