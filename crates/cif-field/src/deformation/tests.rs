use glam::DVec3;

use super::initialize::widen_bounds;
use super::*;
use crate::Gaussians;

/// Name of the setting that a change breaks.
type Change = (&'static str, fn(&mut DeformationConfig));

fn heads(on: bool) -> Heads {
    Heads { position: true, scale: true, rotation: true, opacity: on, sh: on }
}

fn config() -> DeformationConfig {
    DeformationConfig {
        spatial_resolution: [5, 4, 3],
        time_resolution: 8,
        multipliers: vec![1, 2],
        channels: 3,
        width: 8,
        heads: heads(true),
        time_encoding: TimeEncoding::Compact,
    }
}

fn bounds() -> Bounds {
    Bounds { low: DVec3::new(-1.0, -2.0, 0.0), high: DVec3::new(1.0, 2.0, 3.0) }
}

/// A deformation whose time planes vary too.
fn deformation(config: DeformationConfig) -> Deformation {
    let mut deformation = Deformation::new(config, bounds(), 3.0, 7, false).unwrap();
    for (index, value) in deformation.planes.iter_mut().enumerate() {
        *value += 0.3 * (index as f32 * 0.7).sin();
    }
    deformation
}

fn double(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

fn features(deformation: &Deformation, position: [f64; 3], time: f64) -> Vec<f64> {
    deformation.evaluate(&double(&deformation.planes), &double(&deformation.mlp), position, time).features
}

fn close(a: f64, b: f64, tolerance: f64) {
    assert!((a - b).abs() <= tolerance, "{a} vs {b}");
}

#[test]
fn layouts_lie_end_to_end() {
    let config = config();
    let (levels, floats) = config.plane_layout();
    let mut offset = 0;
    for (level, planes) in levels.iter().enumerate() {
        for (plane, layout) in planes.iter().enumerate() {
            assert_eq!(layout.offset, offset, "level {level}, plane {plane}");
            // Rows 3 to 7 of 8 are addressed by a time in [0, 1].
            assert_eq!(layout.rows, if is_time_plane(plane) { 5 } else { layout.counted_rows });
            assert_eq!(layout.columns, [5, 4, 3][PLANE_AXES[plane].0] << level);
            offset += layout.rows * layout.columns * 3;
        }
    }
    assert_eq!(offset, floats);
    let layout = config.mlp_layout();
    let mut end = 0;
    let linears = layout.heads.iter().flat_map(|head| [&head.hidden, &head.output]);
    for linear in std::iter::once(&layout.trunk).chain(linears) {
        assert_eq!(linear.weights, end..end + linear.inputs * linear.outputs);
        assert_eq!(linear.biases, linear.weights.end..linear.weights.end + linear.outputs);
        end = linear.biases.end;
    }
    assert_eq!((layout.len, layout.heads.len(), layout.trunk.inputs), (end, 5, 6));
}

#[test]
fn fresh_parameters_have_the_initial_distribution() {
    let config = DeformationConfig { spatial_resolution: [32; 3], width: 64, ..config() };
    let fresh = Deformation::new(config.clone(), bounds(), 3.0, 1, false).unwrap();
    for layouts in config.plane_layout().0 {
        for (plane, layout) in layouts.iter().enumerate() {
            let values = &fresh.planes[layout.offset..][..layout.rows * layout.columns * 3];
            if is_time_plane(plane) {
                assert!(values.iter().all(|value| *value == 1.0));
            } else {
                assert!(values.iter().all(|value| (0.1..0.5).contains(value)));
                let mean = values.iter().sum::<f32>() / values.len() as f32;
                assert!((mean - 0.3).abs() < 0.02, "{mean}");
            }
        }
    }
    let layout = config.mlp_layout();
    for head in &layout.heads {
        let weights = &fresh.mlp[head.hidden.weights.clone()];
        let limit = (6.0_f32 / 128.0).sqrt();
        let largest = weights.iter().fold(0.0_f32, |largest, weight| largest.max(weight.abs()));
        assert!(largest <= limit && largest > 0.98 * limit, "{largest} of {limit}");
        let biases = &fresh.mlp[head.hidden.biases.clone()];
        assert!(biases.iter().all(|bias| bias.abs() <= 0.125));
        assert!(biases.iter().any(|bias| *bias != 0.0));
    }
    fresh.validate().unwrap();
    assert_eq!(fresh, Deformation::new(config.clone(), bounds(), 3.0, 1, false).unwrap());
    assert_ne!(fresh, Deformation::new(config, bounds(), 3.0, 2, false).unwrap());
}

#[test]
fn zero_initial_heads_start_at_the_identity() {
    let still = Deformation::new(config(), bounds(), 3.0, 1, true).unwrap();
    let moving = Deformation::new(config(), bounds(), 3.0, 1, false).unwrap();
    let gaussians = Gaussians::from_points(&[[0.1, 0.2, 0.3], [-0.5, 1.0, 2.0]], &[[0.4; 3]; 2]).unwrap();
    assert_eq!(still.apply(&gaussians, 0.4), gaussians);
    assert_ne!(moving.apply(&gaussians, 0.4), gaussians);
    // Only the output layers differ.
    assert_eq!(still.planes, moving.planes);
    let layout = config().mlp_layout();
    assert_eq!(still.mlp[layout.trunk.weights.clone()], moving.mlp[layout.trunk.weights]);
}

#[test]
fn the_last_nodes_are_read_at_the_corner_and_at_time_one() {
    let deformation = deformation(config());
    let corner = features(&deformation, bounds().high.to_array(), 1.0);
    let (levels, _) = deformation.config.plane_layout();
    for (level, planes) in levels.iter().enumerate() {
        for channel in 0..3 {
            let product: f64 = planes
                .iter()
                .map(|layout| {
                    let last = layout.offset + (layout.rows * layout.columns - 1) * 3 + channel;
                    f64::from(deformation.planes[last])
                })
                .product();
            close(corner[level * 3 + channel], product, 1e-12);
        }
    }
    // Outside the box and the times, the border is repeated.
    assert_eq!(features(&deformation, [9.0, 9.0, 9.0], 5.0), corner);
    // Just inside, the value is nearly the same: the cell index does not jump.
    let inside = features(&deformation, (bounds().high - 1e-9).to_array(), 1.0 - 1e-9);
    for (inside, corner) in inside.iter().zip(&corner) {
        close(*inside, *corner, 1e-6);
    }
    // In single precision too.
    let single = deformation.evaluate(&deformation.planes, &deformation.mlp, [1.0, 2.0, 3.0], 1.0_f32);
    for (single, corner) in single.features.iter().zip(&corner) {
        close(f64::from(*single), *corner, 1e-6);
    }
}

#[test]
fn interpolation_is_bilinear_between_nodes() {
    let mut config = config();
    config.multipliers = vec![1];
    let mut deformation = deformation(config);
    deformation.planes.fill(1.0);
    // Plane xy alone holds column + 10 row.
    let (levels, _) = deformation.config.plane_layout();
    let layout = levels[0][0].clone();
    for row in 0..layout.rows {
        for column in 0..layout.columns {
            deformation.planes[layout.offset + (row * layout.columns + column) * 3] =
                (column + 10 * row) as f32;
        }
    }
    // x = 0.25 of [-1, 1] is node 2.5 of 0..4; y = -1 of [-2, 2] is node 0.75 of 0..3.
    close(features(&deformation, [0.25, -1.0, 1.0], 0.3)[0], 2.5 + 7.5, 1e-12);
}

#[test]
fn both_time_encodings_are_the_same_function() {
    for time_resolution in [2, 3, 8, 25, 150] {
        let compact = deformation(DeformationConfig { time_resolution, ..config() });
        let wide = DeformationConfig { time_encoding: TimeEncoding::Compat, ..compact.config.clone() };
        let mut compat = Deformation::new(wide, bounds(), 3.0, 0, false).unwrap();
        compat.mlp.clone_from(&compact.mlp);
        let first = compact.config.first_time_row();
        let layouts = compact.config.plane_layout().0.into_iter().zip(compat.config.plane_layout().0);
        for (from, to) in layouts.flat_map(|(from, to)| from.into_iter().zip(to)) {
            let skipped = (to.rows - from.rows) * to.columns * 3;
            assert!(skipped == 0 || to.rows - from.rows == first);
            let floats = from.rows * from.columns * 3;
            compat.planes[to.offset + skipped..][..floats]
                .copy_from_slice(&compact.planes[from.offset..][..floats]);
        }
        for time in [0.0, 0.013, 0.5, 0.77, 1.0] {
            let (a, b) =
                (features(&compact, [0.3, -0.4, 1.1], time), features(&compat, [0.3, -0.4, 1.1], time));
            for (a, b) in a.iter().zip(&b) {
                close(*a, *b, 1e-12);
            }
        }
    }
}

#[test]
fn a_zero_plane_gives_zero_features_and_finite_outputs() {
    let mut deformation = deformation(config());
    let layout = deformation.config.plane_layout().0[0][4].clone();
    deformation.planes[layout.offset..][..layout.rows * layout.columns * 3].fill(0.0);
    let tape = deformation.evaluate(&deformation.planes, &deformation.mlp, [0.3_f32, 0.1, 0.9], 0.6);
    assert_eq!(tape.features[..3], [0.0; 3]);
    assert!(tape.features[3..].iter().all(|value| *value != 0.0));
    assert!(tape.values[0][4].iter().all(|value| *value == 0.0));
    assert!(tape.outputs.iter().flatten().all(|value| value.is_finite()));
}

#[test]
fn applying_agrees_with_plain_evaluation() {
    for on in [true, false] {
        let deformation = deformation(DeformationConfig { heads: heads(on), ..config() });
        let positions: Vec<[f32; 3]> = (0..37)
            .map(|i| [(i as f32).sin() * 1.2, (i as f32 * 0.3).cos() * 2.2, i as f32 * 0.09])
            .collect();
        let gaussians = Gaussians::from_points(&positions, &vec![[0.2, 0.5, 0.9]; 37]).unwrap();
        let deformed = deformation.apply(&gaussians, 0.37);
        for row in 0..37 {
            let tape = deformation.evaluate(
                &double(&deformation.planes),
                &double(&deformation.mlp),
                positions[row].map(f64::from),
                0.37,
            );
            let deltas = deformation.deltas(&tape);
            let check = |found: &[f32], canonical: &[f32], deltas: &[f64]| {
                for k in 0..deltas.len() {
                    close(f64::from(found[k]), f64::from(canonical[k]) + deltas[k], 2e-6);
                }
            };
            check(&deformed.means[row], &gaussians.means[row], &deltas.position);
            check(&deformed.log_scales[row], &gaussians.log_scales[row], &deltas.scale);
            check(&deformed.quaternions[row], &gaussians.quaternions[row], &deltas.rotation);
            check(&[deformed.opacity_logits[row]], &[gaussians.opacity_logits[row]], &[deltas.opacity]);
            check(&deformed.sh_coefficients[row], &gaussians.sh_coefficients[row], &deltas.sh);
            assert_eq!(deltas.opacity != 0.0, on);
        }
        assert_eq!(deformed.occupancy_logits, gaussians.occupancy_logits);
    }
}

#[test]
fn flat_boxes_are_widened() {
    let flat = Bounds { low: DVec3::new(-1.0, 2.0, 5.0), high: DVec3::new(1.0, 2.0, 5.0) };
    let wide = widen_bounds(flat, 4.0);
    assert_eq!((wide.low.x, wide.high.x), (-1.0, 1.0));
    close(wide.size().y, 4e-3, 1e-12);
    close(wide.centre().z, 5.0, 1e-12);
    // Without an extent, the longest side counts; without any side, one metre.
    close(widen_bounds(flat, 0.0).size().y, 2e-3, 1e-12);
    let point = Bounds { low: DVec3::splat(1e6), high: DVec3::splat(1e6) };
    for bounds in [wide, widen_bounds(point, 0.0), widen_bounds(Bounds::EMPTY, 0.0)] {
        let deformation = Deformation::new(config(), bounds, 0.0, 1, false).unwrap();
        deformation.validate().unwrap();
        let centre = deformation.bounds.centre().to_array();
        let at_centre = deformation.evaluate(
            &deformation.planes,
            &deformation.mlp,
            centre.map(|value| value as f32),
            0.5_f32,
        );
        assert!(at_centre.features.iter().all(|value| value.is_finite()));
    }
}

#[test]
fn settings_out_of_range_are_named() {
    let broken: [Change; 9] = [
        ("spatial_resolution", |config| config.spatial_resolution[1] = 1),
        ("spatial_resolution", |config| config.spatial_resolution[2] = u32::MAX),
        ("time_resolution", |config| config.time_resolution = 1),
        ("multipliers", |config| config.multipliers.clear()),
        ("multipliers", |config| config.multipliers[1] = 0),
        ("multipliers", |config| config.multipliers = vec![1; 1000]),
        ("channels", |config| config.channels = 0),
        ("width", |config| config.width = u32::MAX),
        ("spatial_resolution, multipliers, channels", |config| {
            config.spatial_resolution = [4096; 3];
            config.multipliers = vec![64; 8];
            config.channels = 256;
        }),
    ];
    for (name, change) in broken {
        let mut config = config();
        change(&mut config);
        assert_eq!(config.validate().unwrap_err().name, name);
        assert!(Deformation::new(config, bounds(), 1.0, 0, false).is_err());
    }
    config().validate().unwrap();
}
