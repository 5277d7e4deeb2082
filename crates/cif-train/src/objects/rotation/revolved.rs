//! How a solid of revolution turns about its axis, which its outline does not show: a bar or a can that rolls, a bottle that
//! turns where it stands. Its surface is the largest such solid inside the outlines.

use glam::{DQuat, DVec3};

use super::super::shape::Pose;
use super::super::view::ObjectView;
use super::evidence::{Evidence, Look, Pixel};
use super::hull::{Contact, Course, Hull, voxel};
use super::judge::SIGMAS;
use super::painted::{Cells, Turning};
use super::shown::Shown;

/// Times that the hull is carved again with the turns that were found: views of all sides show what few of one do not.
const CARVED: usize = 3;

/// Rolling radii that are tried, of that of the solid, which is known to a voxel or two.
const RADII: [f64; 13] = [0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3];

/// An object on a course without turns.
pub(in super::super) struct Revolving<'a> {
    evidence: Evidence<'a>,
    /// Size of the object and edge of a voxel, metres.
    size: f64,
    voxel: f64,
    course: &'a Course,
    hull: Hull,
    /// Away from the support, and height of the course above it where there is one.
    up: DVec3,
    height: Option<f64>,
}

impl<'a> Revolving<'a> {
    /// An object of this size (the larger of half height and radius, metres), by its views in the order of times, with
    /// the direction away from its support and the height of the course above it, metres; `None` where views are too few.
    pub(in super::super) fn new(
        views: impl Iterator<Item = &'a ObjectView>,
        size: f64,
        course: &'a Course,
        up: DVec3,
        height: Option<f64>,
    ) -> Option<Self> {
        let evidence = Evidence::of(views)?;
        let voxel = voxel(&evidence, size, course)?;
        let hull = Hull::of(&evidence, size, voxel, course);
        Some(Self { evidence, size, voxel, course, hull, up, height })
    }

    /// Share of the pixels of the object that show the largest solid of revolution about an axis of this direction.
    pub(in super::super) fn covered(&self, axis: DVec3) -> f64 {
        let Some(solid) = self.solid(axis, None) else { return 0.0 };
        let pixels =
            self.evidence.looks.iter().flat_map(|look| look.pixels.iter().map(move |pixel| (look, pixel)));
        let hit = pixels.filter(|(look, pixel)| solid.place(look, pixel, &solid.hull, None).is_some());
        hit.count() as f64 / self.evidence.len().max(1) as f64
    }

    /// The course, rolling without slip about an axis of this direction: as the paint shows it, where it does, else with the
    /// radius of the largest solid.
    pub(in super::super) fn rolled(&self, axis: DVec3) -> Option<Course> {
        let solid = self.solid(axis, self.contact(axis).as_ref())?;
        let first = self.course.values().next()?;
        let forward = (first.rotation * axis).cross(self.up);
        let shown = solid.shown(None)?;
        let gone = |time: &usize| {
            let gone = |pose: &Pose| (pose.translation - first.translation).dot(forward);
            self.course.get(time).map_or(0.0, gone)
        };
        let rolled = |radius: f64| shown.turned(axis, |time| gone(time) / radius);
        let tried = RADII.map(|share| rolled(share * solid.radius(axis)));
        let gains = tried.each_ref().map(|turned| shown.gain(&self.evidence, turned));
        let best = (0..RADII.len()).max_by(|a, b| gains[*a].0.total_cmp(&gains[*b].0))?;
        let is_seen = gains[best].1 > SIGMAS;
        let expected =
            if is_seen { tried[best].clone() } else { rolled(self.solid(axis, None)?.radius(axis)) };
        let mut found = shown.turning(&expected);
        for _ in 0..if is_seen { CARVED } else { 0 } {
            let shown = solid.shown(Some(&found))?;
            found = shown.turning(&shown.few.painted(axis).near(&expected));
        }
        // Its places are those of the course, which all outlines show.
        Some(found.about(self.course, DVec3::ZERO))
    }

    /// The course, turning about an axis of this direction as the paint shows it; `None` where it shows no turn of more than
    /// 30 degrees.
    pub(in super::super) fn turned(&self, axis: DVec3) -> Option<Course> {
        let solid = self.solid(axis, None)?;
        let shown = solid.shown(None)?;
        let found = shown.few.turned_about(axis);
        shown.errors(&self.evidence, &found)?;
        shown
            .turns_in_halves(&self.evidence, &found)
            .then(|| shown.turning(&found).about(self.course, solid.middle))
    }

    /// The largest solid of revolution about an axis of this direction, on a support.
    fn solid(&self, axis: DVec3, contact: Option<&Contact>) -> Option<Solid<'_, 'a>> {
        let (hull, middle) = self.hull.revolved(axis, contact)?;
        Some(Solid { of: self, hull, middle })
    }

    /// The support under a solid about an axis of this direction.
    fn contact(&self, axis: DVec3) -> Option<Contact> {
        let away = |look: &Look<'_>| {
            let pose = self.course.get(&look.view.time_index)?;
            let away = pose.rotation.inverse() * (pose.translation - look.view.camera.centre());
            Some(away.normalize_or_zero())
        };
        let away: DVec3 = self.evidence.looks.iter().filter_map(away).sum();
        Some(Contact { up: self.up, height: self.height?, depth: away.reject_from(axis).try_normalize()? })
    }
}

/// A solid of revolution.
struct Solid<'r, 'a> {
    of: &'r Revolving<'a>,
    hull: Hull,
    /// A point of the axis, in the frame of the object.
    middle: DVec3,
}

impl Solid<'_, '_> {
    /// Largest radius about its axis, metres.
    fn radius(&self, axis: DVec3) -> f64 {
        self.hull.radius_about(axis, self.middle)
    }

    /// Places that pixels show of the solid, or of the hull that is carved with some turns.
    fn shown(&self, turning: Option<&Turning>) -> Option<Shown> {
        let Revolving { evidence, size, voxel, course, .. } = self.of;
        let carved =
            turning.map(|turning| Hull::of(evidence, *size, *voxel, &turning.about(course, self.middle)));
        let hull = carved.as_ref().unwrap_or(&self.hull);
        Shown::of(evidence, Cells::Edged(*voxel), |look, pixel| self.place(look, pixel, hull, turning))
    }

    /// The place from the middle that a pixel shows of a hull with some turns, before these, with the cosine at which it is
    /// seen.
    fn place(
        &self,
        look: &Look<'_>,
        pixel: &Pixel,
        hull: &Hull,
        turning: Option<&Turning>,
    ) -> Option<(DVec3, f64)> {
        let time = look.view.time_index;
        let pose = self.of.course.get(&time)?;
        let turn = turning.map_or(DQuat::IDENTITY, |turning| turning.turn(time));
        let turned = turned(pose, turn, self.middle);
        let hit = hull.met(&turned, look.view.camera.centre(), pixel.ray)?;
        Some((turn * (hit.place - self.middle), hit.facing))
    }
}

/// A pose with a turn about a middle.
fn turned(pose: &Pose, turn: DQuat, middle: DVec3) -> Pose {
    let translation = pose.translation + pose.rotation * (middle - turn * middle);
    Pose { rotation: pose.rotation * turn, translation }
}

impl Turning {
    /// A course with the turns, about a middle.
    fn about(&self, course: &Course, middle: DVec3) -> Course {
        course.iter().map(|(time, pose)| (*time, turned(pose, self.turn(*time), middle))).collect()
    }

    /// The turn at a time; where it has none, between those before and after.
    fn turn(&self, time: usize) -> DQuat {
        let before = self.angles.range(..=time).next_back();
        let after = self.angles.range(time..).next();
        let angle = match (before, after) {
            (Some((a, from)), Some((b, to))) if a < b => {
                from + (to - from) * (time - a) as f64 / (b - a) as f64
            }
            (Some((_, angle)), _) | (None, Some((_, angle))) => *angle,
            (None, None) => 0.0,
        };
        DQuat::from_axis_angle(self.axis, angle)
    }
}
