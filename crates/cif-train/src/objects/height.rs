//! Height at which a path on a plane is even: rays of views from other sides, cut with it too high or too low, jump to and
//! fro along the way they look.

use glam::DVec3;

use super::plane::Plane;
use super::view::{ObjectView, median};

/// Standard deviation of the height that outlines tell of the middle of a mask, of that height: what narrows upwards is as
/// high as a cylinder of its width, its middle is not.
const OF_OUTLINE: f64 = 0.2;

/// Times between which nothing is said of a path, of a sequence of 60.
const GAP: f64 = 8.0;

/// Rounds of reweighting, and standard deviation of a normal distribution, of the middle of its absolute values.
const ROUNDS: usize = 30;
const OF_MIDDLE: f64 = 1.48;

/// Standard deviation of the height, of that of as many independent places: what one time misses those beside it miss too,
/// and outlines of neighbouring times are wrong alike.
const ALIKE: f64 = 3.0;

/// Least scatter of places, metres, so that exact ones divide by something.
const LEAST: f64 = 1e-4;

/// The height above the plane of the middles of masks, where outlines tell one, by how evenly it moves there: the mean of
/// both by their variances. `views` are in the order of times, one of each; `times` are those of the sequence.
pub(super) fn height_of_path(told: f64, views: &[&ObjectView], plane: &Plane, times: usize) -> f64 {
    let Some((even, deviation)) = even_height(views, plane, times) else { return told };
    let [of_outline, of_path] = [OF_OUTLINE * told, deviation].map(|deviation| deviation.powi(-2));
    (of_outline * told + of_path * even) / (of_outline + of_path)
}

/// The height at which places lie nearest to between those before and after them, and its standard deviation.
fn even_height(views: &[&ObjectView], plane: &Plane, times: usize) -> Option<(f64, f64)> {
    let longest = GAP * (times as f64 / 60.0).max(1.0);
    // Place on the plane, and where it goes with the height.
    let place = |view: &ObjectView| -> Option<[DVec3; 2]> {
        let (origin, ray) = (view.camera.centre(), view.camera.ray(view.centroid));
        let [low, high] = [0.0, 1.0].map(|height| Some(origin + plane.meet(origin, ray, height)? * ray));
        let low = low?;
        Some([low, high? - low])
    };
    let places: Vec<(f64, [DVec3; 2])> =
        views.iter().filter_map(|view| Some((view.time_index as f64, place(view)?))).collect();
    let beside = |three: &[(f64, [DVec3; 2])]| {
        let [(a, from), (b, at), (c, to)] = [0, 1, 2].map(|k| three[k]);
        let share = (b - a) / (c - a);
        (c - a <= longest).then(|| [0, 1].map(|k| at[k] - from[k].lerp(to[k], share)))
    };
    let misses: Vec<[DVec3; 2]> = places.windows(3).filter_map(beside).collect();
    let mut weights = vec![1.0; misses.len()];
    let mut found = None;
    for _ in 0..ROUNDS {
        let sum = |of: &dyn Fn(&[DVec3; 2]) -> f64| -> f64 {
            misses.iter().zip(&weights).map(|(miss, weight)| weight * of(miss)).sum()
        };
        let told = sum(&|[_, by_height]| by_height.length_squared());
        if told <= 0.0 {
            return None;
        }
        let height = -sum(&|[miss, by_height]| miss.dot(*by_height)) / told;
        let left: Vec<f64> =
            misses.iter().map(|[miss, by_height]| (*miss + height * *by_height).length()).collect();
        let scatter = (OF_MIDDLE * median(&mut left.clone())).max(LEAST);
        found = Some((height, ALIKE * scatter / told.sqrt()));
        weights = left.iter().map(|left| 1.0 / (1.0 + (left / scatter).powi(2))).collect();
    }
    found
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::super::testing::{Cameras, FLOOR, TIMES, jumping, moving, solid, sphere_places, views};
    use super::*;

    #[test]
    fn rays_from_other_sides_tell_how_high_the_middle_is_and_rays_from_one_side_do_not() {
        let place = |time: usize| DVec3::new(0.1 - 0.006 * time as f64, 0.0, 0.045);
        let truth: Vec<(DQuat, DVec3)> = (0..TIMES).map(|time| (DQuat::IDENTITY, place(time))).collect();
        let told = |cameras: Cameras| {
            let views = views(solid(&sphere_places(0.045), |_| [0.5; 3], 0.006), &truth, cameras);
            height_of_path(0.07, &views.iter().collect::<Vec<_>>(), &FLOOR, TIMES)
        };
        assert!((told(jumping) - 0.045).abs() < 0.002, "{}", told(jumping));
        assert!((told(moving) - 0.07).abs() < 0.014, "{}", told(moving));
        assert_eq!(height_of_path(0.07, &[], &FLOOR, TIMES), 0.07);
    }
}
