//! Whether the arrays of a node belong together.

use cif_geometry::spherical_harmonics::coefficient_count;

use crate::SceneError;
use crate::graph::{Motion, Node, PoseSample};

/// Checks that the arrays of a node belong together, so that nothing later indexes past one.
pub(crate) fn check(node: &Node) -> Result<(), SceneError> {
    let wrong = |what: String| Err(SceneError::Import { object: node.name.clone(), what });
    let splats = &node.splats;
    let n = splats.len();
    if splats.sh_degree > 3 {
        return wrong(format!(
            "its spherical harmonics have degree {}; at most 3 can be drawn",
            splats.sh_degree
        ));
    }
    let floats = 3 * coefficient_count(splats.sh_degree);
    let lengths = [
        ("orientations", splats.orientations.len(), n),
        ("scales", splats.scales.len(), n),
        ("opacities", splats.opacities.len(), n),
        ("colour coefficients", splats.sh_coefficients.len(), n * floats),
    ];
    for (what, found, expected) in lengths {
        if found != expected {
            return wrong(format!("it has {n} centres, but {found} {what} instead of {expected}"));
        }
    }
    let in_range = |values: &[f32]| values.iter().all(|value| (0.0..=1.0).contains(value));
    if !in_range(&splats.opacities) || !in_range(&splats.occupancies) {
        return wrong("an opacity or occupancy is outside 0 to 1".to_owned());
    }
    if splats.scales.as_flattened().iter().any(|scale| !(scale.is_finite() && *scale >= 0.0)) {
        return wrong("a scale is below 0 or not finite".to_owned());
    }
    let ascend = |track: &[PoseSample]| {
        track.windows(2).all(|pair| pair[0].time_code < pair[1].time_code)
            && track.iter().all(|key| key.translation.is_finite() && key.rotation.is_finite())
    };
    if !ascend(node.track()) {
        return wrong("its motion does not ascend in time, or is not finite".to_owned());
    }
    for (what, samples, expected) in [
        ("opacities", &node.appearance.opacities, n),
        ("colour coefficients", &node.appearance.colors, n * floats),
    ] {
        if let Some(sample) = samples.iter().find(|sample| sample.values.len() != expected) {
            return wrong(format!(
                "it has {n} centres, but {} {what} at time code {} instead of {expected}",
                sample.values.len(),
                sample.time_code
            ));
        }
        if samples.windows(2).any(|pair| pair[0].time_code >= pair[1].time_code) {
            return wrong(format!("its {what} do not ascend in time"));
        }
    }
    if !node.appearance.opacities.iter().all(|sample| in_range(&sample.values)) {
        return wrong("a sampled opacity is outside 0 to 1".to_owned());
    }
    match &node.motion {
        Motion::Parts(parts) => {
            let mut next = 0;
            for part in &parts.parts {
                if part.splats.start != next || part.splats.end < next || part.splats.end > n {
                    return wrong(format!("its part {} does not follow the part before it", part.name));
                }
                next = part.splats.end;
                if !ascend(&part.track) {
                    return wrong(format!("the motion of its part {} does not ascend in time", part.name));
                }
            }
            if next != n {
                return wrong(format!("its parts hold {next} of {n} splats"));
            }
        }
        Motion::Dense(dense) => {
            if dense.samples.is_empty() {
                return wrong("it deforms, but has no samples".to_owned());
            }
            for sample in &dense.samples {
                let scales = sample.scales.as_ref().map_or(n, Vec::len);
                if [sample.means.len(), sample.orientations.len(), scales] != [n; 3] {
                    return wrong(format!(
                        "its sample at time code {} does not have {n} splats",
                        sample.time_code
                    ));
                }
                let scales = sample.scales.as_deref().unwrap_or_default().as_flattened();
                if scales.iter().any(|scale| !(scale.is_finite() && *scale >= 0.0)) {
                    return wrong("a sampled scale is below 0 or not finite".to_owned());
                }
            }
            if dense.samples.windows(2).any(|pair| pair[0].time_code >= pair[1].time_code) {
                return wrong("its deformation does not ascend in time".to_owned());
            }
        }
        Motion::Static | Motion::Rigid(_) => {}
    }
    Ok(())
}
