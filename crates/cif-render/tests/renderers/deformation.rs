//! Gradients of the deformation alone, of more rows than a task takes and of several numbers of feature channels.

use cif_field::Deformation;
use cif_field::deformation::{DeformationConfig, Heads};
use cif_render::Gradients;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::reference::deform::{deform, deform_backward};
use cif_render::reference::{Gaussian, Scene};
use cif_render::synthetic::{SyntheticConfig, generate};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const TIME: f64 = 0.37;

/// The network of another number of channels, with random parameters.
fn with_channels(deformation: &Deformation, channels: u32, random: &mut Pcg64Mcg) -> Deformation {
    let config = DeformationConfig { channels, ..deformation.config.clone() };
    let planes = (0..config.plane_layout().1).map(|_| random.random_range(0.5..1.3)).collect();
    let mlp = (0..config.mlp_layout().len).map(|_| random.random_range(-0.5..0.5)).collect();
    Deformation { config, planes, mlp, ..deformation.clone() }
}

/// The largest difference relative to the largest value.
fn relative_error(actual: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(actual.len(), expected.len());
    let size = expected.iter().fold(0.0_f64, |size, value| size.max(value.abs()));
    let difference =
        actual.iter().zip(expected).fold(0.0_f64, |most, (a, e)| most.max((f64::from(*a) - e).abs()));
    difference / size
}

#[test]
fn gradients_of_many_rows_are_those_of_the_reference() {
    let heads = Heads { position: true, scale: true, rotation: true, opacity: false, sh: false };
    // Channels below, at and beyond a vector, with and without a rest.
    for channels in [3, 8, 12, 16] {
        let config =
            SyntheticConfig { seed: 5, gaussians: 2_300, heads: Some(heads), ..SyntheticConfig::default() };
        let mut field = generate(&config).field;
        let mut random = Pcg64Mcg::seed_from_u64(u64::from(channels));
        let mut deformation = with_channels(field.deformation.as_ref().unwrap(), channels, &mut random);
        deformation.still = (0..field.gaussians.len()).map(|row| row % 7 == 3).collect();
        field.deformation = Some(deformation);
        // Some rows have no gradient.
        let v: Vec<[f32; 3]> = (0..field.gaussians.len())
            .map(|row| if row % 5 == 0 { [0.0; 3] } else { [(); 3].map(|()| random.random_range(-1.0..1.0)) })
            .collect();

        let scene = Scene::<f64>::from_field(&field);
        let mut expected = scene.parameters.zeros_like();
        for (row, v) in v.iter().enumerate() {
            if field.deformation.as_ref().unwrap().is_still(row) {
                continue;
            }
            let v = Gaussian { mean: v.map(f64::from), ..Gaussian::zero() };
            deform_backward(&scene, row, &deform(&scene, row, TIME, true), &v, &mut expected);
            // What the deformation adds is differentiated, not the centre to which it is added.
            for axis in 0..3 {
                expected.gaussians[row].mean[axis] -= v.mean[axis];
            }
        }
        let means: Vec<f64> = expected.gaussians.iter().flat_map(|gaussian| gaussian.mean).collect();

        for simd in SimdLevel::available() {
            let mut gradients = Gradients::zeros(&field);
            let mut renderer = Renderer::new(simd);
            // Nothing of a call before is left in the next one's sums.
            renderer.displace_backward(&field, 0.9, v.clone(), &mut gradients);
            gradients.reset();
            renderer.displace_backward(&field, TIME, v.clone(), &mut gradients);
            for (name, actual, expected) in [
                ("planes", &gradients.planes[..], &expected.planes),
                ("network", &gradients.mlp, &expected.mlp),
                ("centres", gradients.gaussians.means.as_flattened(), &means),
            ] {
                let error = relative_error(actual, expected);
                assert!(error < 1e-5, "{name}, {channels} channels, {simd:?}: {error:.1e}");
            }
        }
    }
}
