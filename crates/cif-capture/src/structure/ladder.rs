//! Settings of structure from motion, tried in order until one is to be believed.
//!
//! Each setting is solved by both mappers of COLMAP, with seeds of their own: the global one, which is given
//! out, and the incremental one, by which it is judged; where these disagree, the incremental mapper runs once
//! more with another seed and may be given out itself. The settings were found on small captures with moving
//! objects: default features suffice where there is texture, a lower threshold of features is what scenes of
//! plain objects need.

use std::collections::BTreeMap;
use std::path::Path;

use super::pairs::{Order, pairs};
use super::python::{Group, Job, Mapper, Outcome, Run, run};
use super::verdict::{Verdict, judge};
use crate::frames::Shot;
use crate::poses::Poses;
use crate::{Error, Hooks};

/// Thresholds of features, in order: COLMAP's own (1/150), and lower ones for more features.
const PEAKS: [Option<f64>; 3] = [None, Some(0.002), Some(0.001)];

/// Lenses of COLMAP that are fitted.
const LENS_MODEL: &str = "SIMPLE_RADIAL";

/// Images have, in the median, fewer features than this where they are blurred or show nothing but plain
/// surfaces.
const FEW_FEATURES: usize = 40;

/// Which images share a lens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lenses {
    /// All of one size: cameras of one make, at one zoom.
    #[default]
    PerSize,
    /// Those of one camera.
    PerCamera,
}

/// Images whose poses are wanted.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    /// Images, ordered by camera and then by time.
    pub shots: &'a [Shot],
    /// Folder of `NAME.png` for the name of every image, in which black is left out.
    pub masks: Option<&'a Path>,
    /// How images follow each other.
    pub order: Order,
    /// Which of them share a lens.
    pub lenses: Lenses,
    /// Focal length to start from, pixels; that of EXIF else, where there is one.
    pub focal_px: Option<f64>,
    /// Folder for databases.
    pub work: &'a Path,
    /// Threads for features and matches; poses do not depend on it.
    pub threads: usize,
}

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
/// When pycolmap is missing or fails, the caller stops, or no setting gives any pose. A bad verdict is no
/// error.
pub fn find(request: &Request<'_>, hooks: &Hooks<'_>) -> Result<Found, Error> {
    let (images, masks) = (request.work.join("images"), request.work.join("masks"));
    let names = stage(request, &images, &masks)?;
    let cameras: Vec<&str> = request.shots.iter().map(|shot| shot.camera.as_str()).collect();
    let groups = groups(request);
    let pairs = pairs(&cameras, request.order);
    let mut best: Option<Found> = None;
    let mut tried = Vec::new();
    let mut features = Vec::new();
    for (number, peak) in PEAKS.into_iter().enumerate() {
        let solve = |runs: &[Run]| {
            let job = Job {
                work: request.work,
                images: &images,
                masks: request.masks.map(|_| masks.as_path()),
                names: &names,
                pairs: &pairs,
                cameras: &groups,
                model: LENS_MODEL,
                peak,
                runs,
                poses: None,
                threads: request.threads,
            };
            run(&job, hooks)
        };
        let name =
            if number == 0 { "default features".to_owned() } else { format!("more features ({number})") };
        let (seen, found) = rung(names.len(), &solve)?;
        features = seen;
        match found {
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
        hooks.tell("not believed, going on with more features");
    }
    features.sort_unstable();
    let median = features.get(features.len() / 2).copied().unwrap_or(0);
    let Some(best) = best else {
        return Err(if median < FEW_FEATURES {
            Error::refused(
                format!("no poses were found: images have {median} features in the median, which is few"),
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

/// Puts images and masks into folders of their own under names that COLMAP's lists can hold, which has no
/// spaces.
pub(super) fn stage(request: &Request<'_>, images: &Path, masks: &Path) -> Result<Vec<String>, Error> {
    let mut names = Vec::with_capacity(request.shots.len());
    for folder in [images, masks] {
        std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    }
    for (number, shot) in request.shots.iter().enumerate() {
        let ending = shot.file.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        let name = format!("{number:06}.{}", ending.as_deref().unwrap_or("png"));
        put(&shot.file, &images.join(&name))?;
        let mask = request.masks.map(|masks| masks.join(format!("{}.png", shot.name)));
        if let Some(mask) = mask.filter(|mask| mask.is_file()) {
            put(&mask, &masks.join(format!("{name}.png")))?;
        }
        names.push(name);
    }
    Ok(names)
}

/// A second name of a file; a copy where the file system has no links.
fn put(from: &Path, to: &Path) -> Result<(), Error> {
    // The file behind a link: a link with a relative target leads nowhere from another folder.
    let link = std::fs::canonicalize(from).and_then(|file| std::fs::hard_link(file, to));
    link.or_else(|_| std::fs::copy(from, to).map(drop)).map_err(Error::io("copy", from))
}

/// The model of one setting: the name of its mapper, its poses, and what is to be thought of them.
type Model = (&'static str, Poses, Verdict);

/// Features of the images, and the model to give out of one setting; `None` where no mapper found any pose.
fn rung(
    images: usize,
    solve: &dyn Fn(&[Run]) -> Result<Outcome, Error>,
) -> Result<(Vec<usize>, Option<Model>), Error> {
    let first = [Run { mapper: Mapper::Global, seed: 1 }, Run { mapper: Mapper::Incremental, seed: 2 }];
    let Outcome { features, runs, .. } = solve(&first)?;
    let features: Vec<usize> = features.into_values().collect();
    let mut runs = runs.into_iter();
    let (global, incremental) = (runs.next().flatten(), runs.next().flatten());
    let judged =
        |mapper, poses: &Poses, other: Option<&Poses>| (mapper, poses.clone(), judge(poses, other, images));
    let mut best = global.as_ref().map(|global| judged("global", global, incremental.as_ref()));
    if best.as_ref().is_some_and(|(_, _, verdict)| verdict.is_good()) {
        return Ok((features, best));
    }
    // One run of the incremental mapper may lose its way where another does not.
    let Some(incremental) = incremental else { return Ok((features, best)) };
    let again = solve(&[Run { mapper: Mapper::Incremental, seed: 3 }])?.runs.into_iter().next().flatten();
    let mut candidates = vec![judged("incremental", &incremental, again.as_ref())];
    if let (Some(global), Some(again)) = (&global, &again) {
        candidates.insert(0, judged("global", global, Some(again)));
    }
    for candidate in candidates {
        if best.as_ref().is_none_or(|best| candidate.2.holding() > best.2.holding()) {
            best = Some(candidate);
        }
    }
    Ok((features, best))
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

    /// The model that [`rung`] gives where the mappers answer so, and the runs that it asked for.
    fn given(answer: impl Fn(Run) -> Option<Poses>) -> (Option<Model>, Vec<(Mapper, u32)>) {
        let asked = RefCell::new(Vec::new());
        let solve = |runs: &[Run]| {
            asked.borrow_mut().extend(runs.iter().map(|run| (run.mapper, run.seed)));
            Ok(Outcome {
                features: BTreeMap::new(),
                runs: runs.iter().map(|run| answer(*run)).collect(),
                points: Vec::new(),
            })
        };
        let found = rung(20, &solve).unwrap().1;
        (found, asked.into_inner())
    }

    #[test]
    fn mappers_that_agree_are_believed_at_once() {
        let (found, asked) = given(|run| {
            let mut poses = arc(20);
            if run.mapper == Mapper::Incremental {
                poses.transform(&somewhere());
            }
            Some(poses)
        });
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "global" && poses == arc(20) && verdict.is_good(), "{verdict}");
        assert_eq!(asked, [(Mapper::Global, 1), (Mapper::Incremental, 2)]);
    }

    #[test]
    fn a_mapper_that_lost_its_way_once_is_asked_again() {
        // The incremental one, with its first seed.
        let (found, asked) = given(|run| Some(if run.seed == 2 { bent(9) } else { arc(20) }));
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "global" && poses == arc(20) && verdict.is_good(), "{verdict}");
        assert_eq!(asked.len(), 3);
        // The global one; the two others agree.
        let (found, _) = given(|run| Some(if run.mapper == Mapper::Global { bent(9) } else { arc(20) }));
        let (mapper, poses, verdict) = found.unwrap();
        assert!(mapper == "incremental" && poses == arc(20) && verdict.is_good(), "{verdict}");
    }

    #[test]
    fn models_that_differ_all_are_not_believed() {
        let (found, _) = given(|run| Some(bent(4 * run.seed)));
        assert!(!found.unwrap().2.is_good());
        let (found, asked) = given(|_| None);
        assert!(found.is_none() && asked.len() == 2);
    }
}
