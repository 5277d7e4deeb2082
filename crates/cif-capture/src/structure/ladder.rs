//! Settings of structure from motion, tried in order until one is to be believed.
//!
//! Each setting is solved by the global mapper of COLMAP, which is given out where it leaves no doubt. Where it does,
//! the incremental mapper is run with another seed, and the two are compared; where these disagree, the incremental
//! mapper runs once more and may be given out itself. The settings were found on small captures with moving
//! objects: default features suffice where there is texture, a lower threshold of features is what scenes of
//! plain objects need.

use std::collections::BTreeMap;

use cif_geometry::stats::upper_median;

use super::features::{SETTINGS, chosen, median};
use super::pairs::pairs;
use super::python::{Group, Job, Mapper, Model, Outcome, Run, run};
use super::request::{Lenses, Request};
use super::stage::Staged;
use super::verdict::{Second, Verdict, judge};
use crate::poses::Poses;
use crate::{Error, Hooks};

/// Lenses of COLMAP that are fitted.
const LENS_MODEL: &str = "SIMPLE_RADIAL";

/// Images have, in the median, fewer features than this where they are blurred or show nothing but plain
/// surfaces.
const FEW_FEATURES: usize = 40;

/// A camera stands still where, in half of the pairs of its images, half of the matches are less than this share of
/// the larger side from the same place: about the noise of features, which are found on some 600 pixels. Two
/// recordings of fixed cameras had 0.0001 and 0.0011, eleven of moving ones 0.033 to 0.12.
const STILL: f64 = 1.0 / 600.0;

/// Poses, and what is to be thought of them.
#[derive(Clone, Debug)]
pub struct Found {
    /// Poses of the setting that was believed, else of the best one.
    pub poses: Poses,
    /// Arguments for and against them.
    pub verdict: Verdict,
    /// The setting, in words.
    pub setting: String,
    /// Settings that were not believed, with the reason.
    pub tried: Vec<String>,
}

/// Finds the poses of images.
///
/// # Errors
/// When pycolmap is missing or fails, the caller stops, a camera alone stands still, or no setting gives any pose. A bad
/// verdict is no error.
pub fn find(request: &Request<'_>, hooks: &Hooks<'_>) -> Result<Found, Error> {
    let staged = Staged::new(request, request.work)?;
    let names = &staged.names;
    let cameras: Vec<&str> = request.shots.iter().map(|shot| shot.camera.as_str()).collect();
    let groups = groups(request);
    let pairs = pairs(&cameras, request.order);
    let largest = request.shots.iter().map(|shot| shot.size.0.max(shot.size.1)).max().unwrap_or(1);
    let first = chosen(largest, names.len(), |sample, features| {
        let job = Job { model: LENS_MODEL, ..Job::of(request, &staged, &[], &groups, features) };
        let of = |names: &[String]| sample.iter().map(|k| names[*k].clone()).collect::<Vec<_>>();
        let (names, keys) = (of(&staged.names), of(&staged.keys));
        Ok(run(&Job { names: &names, keys: &keys, ..job }, hooks)?.features.into_values().collect())
    })?;
    let mut best: Option<Found> = None;
    let mut tried = Vec::new();
    let mut counted = 0;
    for number in 0..SETTINGS {
        let name =
            if number == 0 { "default features".to_owned() } else { format!("more features ({number})") };
        let features = first.more(number, largest);
        let job = Job { model: LENS_MODEL, ..Job::of(request, &staged, &pairs, &groups, features) };
        let Outcome { features, moved, .. } = run(&job, hooks)?;
        counted = median(features.into_values().collect());
        if let Some(camera) = standing(&cameras, &pairs, &moved).filter(|_| !request.moving) {
            return Err(stands_still(camera, &cameras));
        }
        let solve =
            |requested| Ok(run(&Job { runs: &[requested], ..job.clone() }, hooks)?.runs.pop().flatten());
        match rung(names.len(), &solve)? {
            Some((mapper, poses, verdict)) => {
                let setting = format!("{name}, {mapper} mapper");
                tried.push(format!("{setting}: {}", reason(&verdict)));
                let is_better = best.as_ref().is_none_or(|best| {
                    (verdict.holding(), poses.images.len())
                        > (best.verdict.holding(), best.poses.images.len())
                });
                if verdict.is_good() || is_better {
                    best = Some(Found { poses, verdict, setting, tried: Vec::new() });
                }
            }
            None => tried.push(format!("{name}: no mapper found any pose")),
        }
        if best.as_ref().is_some_and(|best| best.verdict.is_good()) {
            tried.pop();
            break;
        }
        if number + 1 < SETTINGS {
            hooks.say("not believed, going on with more features");
        }
    }
    let Some(best) = best else {
        return Err(if counted < FEW_FEATURES {
            Error::refused(
                format!("no poses were found: images have {counted} features in the median, which is few"),
                "they are blurred, dark or show plain surfaces only: give sharper or larger images (--count, \
                 --max-side), put something patterned into the scene, or leave less out by --masks",
            )
        } else {
            Error::refused(
                "no poses were found: the images have features, but do not overlap, or all are from one place",
                "take images that share two thirds of what they show, from a camera that walks rather than turns; \
                 leave moving objects out by --masks",
            )
        });
    };
    let name = |staged: &String| names.iter().position(|name| name == staged).map(|k| &request.shots[k].name);
    let poses = Poses {
        images: best.poses.images.iter().filter_map(|(k, pose)| Some((name(k)?.clone(), *pose))).collect(),
        ..best.poses
    };
    Ok(Found { poses, tried, ..best })
}

/// The camera that stands still, by how far the matches of every pair of images are apart, as a share of the larger side.
/// Cameras of which no pair is matched are not judged.
fn standing<'a>(cameras: &[&'a str], pairs: &[(usize, usize)], moved: &[Option<f64>]) -> Option<&'a str> {
    let mut apart: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for ((a, b), moved) in pairs.iter().zip(moved) {
        if let Some(moved) = moved.filter(|_| cameras[*a] == cameras[*b]) {
            apart.entry(cameras[*a]).or_default().push(moved);
        }
    }
    let stands = |apart: &mut Vec<f64>| upper_median(apart).is_some_and(|apart| apart < STILL);
    apart.into_iter().find_map(|(camera, mut apart)| stands(&mut apart).then_some(camera))
}

/// Refusal of a camera that stands still.
fn stands_still(camera: &str, cameras: &[&str]) -> Error {
    let problem = format!(
        "{camera}: the camera stands still: what its images share lies at the same pixels, so that they show no depth"
    );
    let is_alone = cameras.iter().all(|other| *other == camera);
    Error::stands_still(
        problem,
        if is_alone {
            "record while walking around the scene, give the videos of several fixed cameras, or, where only what \
             moves with the camera was seen, say --moving"
        } else {
            "say --fixed where all cameras stand still; where it moves all the same, say --moving"
        },
    )
}

/// A model of one setting: the name of its mapper, its poses, and what is to be thought of them.
type Judged = (&'static str, Poses, Verdict);

/// The model to give out of one setting for `images` images; `None` where no mapper found any pose.
fn rung(images: usize, solve: &dyn Fn(Run) -> Result<Option<Model>, Error>) -> Result<Option<Judged>, Error> {
    let judged = |name, model: &Model, second| (name, model.poses.clone(), judge(model, second, images));
    let global = solve(Run { mapper: Mapper::Global, seed: 1 })?;
    let alone = global.as_ref().map(|global| judged("global", global, Second::NotAsked));
    if alone.as_ref().is_some_and(|(_, _, verdict)| verdict.is_good()) {
        return Ok(alone);
    }
    let incremental = solve(Run { mapper: Mapper::Incremental, seed: 2 })?;
    let mut models: Vec<Judged> = Vec::new();
    models.extend(global.as_ref().map(|global| judged("global", global, Second::of(incremental.as_ref()))));
    let is_good = |models: &[Judged]| models.iter().any(|(_, _, verdict)| verdict.is_good());
    // One run of the incremental mapper may lose its way where another does not.
    if let Some(incremental) = incremental.as_ref().filter(|_| !is_good(&models)) {
        let again = solve(Run { mapper: Mapper::Incremental, seed: 3 })?;
        if let (Some(global), Some(again)) = (&global, &again) {
            models.push(judged("global", global, Second::of(Some(again))));
        }
        models.push(judged("incremental", incremental, Second::of(again.as_ref())));
    }
    // The first of those for which most speaks.
    let most = models.iter().map(|(_, _, verdict)| verdict.holding()).max();
    Ok(models.into_iter().find(|(_, _, verdict)| Some(verdict.holding()) == most))
}

/// Arguments against poses, in short.
fn reason(verdict: &Verdict) -> String {
    let against: Vec<&str> =
        verdict.checks.iter().filter(|check| !check.holds).map(|check| check.words.as_str()).collect();
    against.join("; ")
}

/// Images that share a lens.
fn groups(request: &Request<'_>) -> Vec<Group> {
    let mut groups: BTreeMap<(&str, (u32, u32)), Vec<usize>> = BTreeMap::new();
    for (index, shot) in request.shots.iter().enumerate() {
        let camera = match request.lenses {
            Lenses::PerSize => "",
            Lenses::PerCamera => shot.camera.as_str(),
        };
        groups.entry((camera, shot.size)).or_default().push(index);
    }
    let params = |(width, height): (u32, u32)| {
        request.focal_px.map(|focal| vec![focal, 0.5 * f64::from(width), 0.5 * f64::from(height), 0.0])
    };
    let group = |((_, size), images)| Group { images, params: params(size), size };
    groups.into_iter().map(group).collect()
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;
    use crate::similarity::tests::{arc, somewhere};

    /// A model that is wrong as a whole: the path bends where it should not.
    fn bent(seed: u32) -> Poses {
        let mut poses = arc(20);
        for (k, pose) in poses.images.values_mut().enumerate() {
            pose.world_from_camera.translation.z += 0.1 * f64::from(seed) * (k as f64 * 0.4).cos();
        }
        poses
    }

    /// The model that [`rung`] gives where the mappers answer so, with this share of matches that fit, and the runs that
    /// it asked for.
    fn given(fitting: f64, answer: impl Fn(Run) -> Option<Poses>) -> (Option<Judged>, Vec<(Mapper, u32)>) {
        let asked = RefCell::new(Vec::new());
        let solve = |run: Run| {
            asked.borrow_mut().push((run.mapper, run.seed));
            Ok(answer(run).map(|poses| Model { poses, fitting }))
        };
        let found = rung(20, &solve).unwrap();
        (found, asked.into_inner())
    }

    /// Cameras of which each is held by so many points.
    fn held(points: usize) -> Poses {
        let mut poses = arc(20);
        poses.images.values_mut().for_each(|pose| pose.points = points);
        poses
    }

    #[test]
    fn a_model_without_doubt_is_not_compared() {
        let (found, asked) = given(0.99, |_| Some(held(900)));
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "global" && poses == held(900) && verdict.is_good(), "{verdict}");
        assert_eq!(asked, [(Mapper::Global, 1)]);
    }

    #[test]
    fn a_model_in_doubt_is_compared() {
        for (points, fitting) in [(90, 0.99), (900, 0.9)] {
            let (found, asked) = given(fitting, |run| {
                let mut poses = held(points);
                if run.mapper == Mapper::Incremental {
                    poses.transform(&somewhere());
                }
                Some(poses)
            });
            let (mapper, poses, verdict) = found.unwrap();
            assert!(mapper == "global" && poses == held(points) && verdict.is_good(), "{verdict}");
            assert_eq!(asked, [(Mapper::Global, 1), (Mapper::Incremental, 2)]);
        }
    }

    #[test]
    fn a_mapper_that_lost_its_way_once_is_asked_again() {
        // The incremental one, with its first seed.
        let (found, asked) = given(0.9, |run| Some(if run.seed == 2 { bent(9) } else { arc(20) }));
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "global" && poses == arc(20) && verdict.is_good(), "{verdict}");
        assert_eq!(asked.len(), 3);
        // The global one; the two others agree.
        let (found, _) = given(0.9, |run| Some(if run.mapper == Mapper::Global { bent(9) } else { arc(20) }));
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "incremental" && poses == arc(20) && verdict.is_good(), "{verdict}");
        // It finds nothing.
        let (found, asked) = given(0.9, |run| (run.mapper == Mapper::Incremental).then(|| arc(20)));
        let (mapper, _, verdict) = found.unwrap();
        assert!(mapper == "incremental" && verdict.is_good() && asked.len() == 3, "{verdict}");
    }

    #[test]
    fn models_that_differ_all_are_not_believed() {
        let (found, _) = given(0.9, |run| Some(bent(4 * run.seed)));
        assert!(!found.unwrap().2.is_good());
        let (found, asked) = given(0.9, |_| None);
        assert!(found.is_none() && asked.len() == 2);
    }

    #[test]
    fn a_standing_camera_is_known_by_where_matches_lie() {
        let cameras = ["a", "a", "a", "b", "b"];
        let pairs = [(0, 1), (0, 2), (1, 2), (0, 3), (3, 4)];
        let of = |moved: [Option<f64>; 5]| standing(&cameras, &pairs, &moved);
        // Matches of one pair are wrong; another has none.
        assert_eq!(of([Some(0.0001), Some(0.3), Some(0.0002), Some(0.2), Some(0.1)]), Some("a"));
        assert_eq!(of([Some(0.03), Some(0.06), None, Some(0.0), Some(0.0005)]), Some("b"));
        assert_eq!(of([Some(0.03), Some(0.0005), Some(0.04), Some(0.0), None]), None);
        let words = |cameras: &[&str]| match stands_still("a", cameras) {
            Error::StandsStill { problem, fix } => (problem, fix),
            other => panic!("{other}"),
        };
        let (problem, fix) = words(&["a", "a"]);
        assert!(
            problem.starts_with("a: the camera stands still") && fix.contains("--moving"),
            "{problem} {fix}"
        );
        assert!(words(&cameras).1.contains("--fixed"));
    }
}
