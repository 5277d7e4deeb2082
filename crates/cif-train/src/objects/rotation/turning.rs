//! How a ball turns that stays in place, as a globe on its stand: its outline never changes, so that its paint alone
//! shows the turns. Of axes all around, the turns about each are found under which light that stays and paint that turns
//! explain all times together.

use glam::DVec3;
use rayon::prelude::*;

use super::super::view::ObjectView;
use super::evidence::{Evidence, Look, Pixel};
use super::painted::{Cells, Turned, Turning, hemisphere};
use super::shown::Shown;

/// Axes that are tried of a ball, about 23 degrees apart, and those that are tried further.
const AXES: usize = 40;
const TRIED: usize = 6;

/// Rows of cells from pole to pole of a ball.
const ROWS: f64 = 24.0;

/// A ball in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Ball {
    pub(in super::super) centre: DVec3,
    pub(in super::super) radius: f64,
}

/// The turns of a ball in place that its views (in the order of times) show; `None` where they show none of more than 30
/// degrees. With the mean residuals of pixels left out: with the turns, and by light alone.
pub(in super::super) fn turning<'a>(
    views: impl Iterator<Item = &'a ObjectView>,
    ball: &Ball,
) -> Option<(Turning, [f64; 2])> {
    let evidence = Evidence::of(views)?;
    let place =
        |look: &Look<'_>, pixel: &Pixel| ball.outward(look.view.camera.centre(), pixel.ray.normalize());
    let shown = Shown::of(&evidence, Cells::OfBall(ROWS), place)?;
    let seen = &shown.few;
    let mut found: Vec<Turned> =
        hemisphere(AXES).into_par_iter().map(|axis| seen.painted(axis).roughly()).collect();
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let tried = found.into_par_iter().take(TRIED).map(|turned| seen.painted(turned.axis).further(turned));
    let best = tried.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
    let best = seen.finely(seen.moved(best));
    let errors = shown.errors(&evidence, &best)?;
    // What is no ball looks as one from a few sides, and its paint slides over it: of eleven globes the least margin is 2.8
    // standard errors, of a bottle at rest in two captures 1.6 and 2.0.
    shown.turns(&evidence, &best).then(|| (shown.turning(&best), errors))
}

impl Ball {
    /// Unit vector from the middle to where a ray of unit length meets the ball, with the cosine at which it does; `None`
    /// where it passes by.
    pub(in super::super) fn outward(&self, origin: DVec3, ray: DVec3) -> Option<(DVec3, f64)> {
        let offset = origin - self.centre;
        let (along, beyond) = (offset.dot(ray), offset.length_squared() - self.radius * self.radius);
        let inside = along * along - beyond;
        if inside < 0.0 {
            return None;
        }
        let outward = (offset - (along + inside.sqrt()) * ray) / self.radius;
        Some((outward, -outward.dot(ray)))
    }
}
