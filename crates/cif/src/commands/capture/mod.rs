//! `cif capture`: videos and photographs to a capture that `cif train` takes.

mod as_json;
mod options;
mod posed;
mod report;
mod scale;
mod shown;
mod unfinished;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_capture::frames::{self, Choice, Notes, Shot};
use cif_capture::import::{self, Imported};
use cif_capture::masks::{self, Masks};
use cif_capture::poses::{Point, Poses};
use cif_capture::source::sources;
use cif_capture::structure::{self, Found, Lenses, Request};
use cif_capture::write::{self, Capture as Written};
use cif_capture::{Hooks, Progress, times};

pub(super) use self::options::Capture;
use self::options::LensesName;
use self::posed::{Left, Posed, is_fixed, order};
use self::shown::Shown;
use crate::error::Error;
use crate::interrupt;

impl From<cif_capture::Error> for Error {
    fn from(error: cif_capture::Error) -> Self {
        match error {
            cif_capture::Error::Stopped => {
                Self::Interrupted { message: "interrupted".to_owned(), help: None }
            }
            cif_capture::Error::System(error @ cif_system::Error::Refused { .. }) => error.into(),
            cif_capture::Error::StandsStill { problem, fix } => Self::failed(problem, fix),
            other => Self::plain(other),
        }
    }
}

pub(super) fn run(command: &Capture) -> Result<(), Error> {
    let place = &command.output;
    let is_taken = match std::fs::read_dir(place) {
        Ok(mut entries) => entries.next().is_some(),
        Err(_) => place.exists(),
    };
    if is_taken {
        return Err(Error::failed(
            format!("{} exists", place.display()),
            "choose another name for the capture, or remove it; nothing is overwritten",
        ));
    }
    command.report.check([])?;
    // Hours before it is written.
    crate::output::check_new_folder(place)?;
    interrupt::watch();
    let shown = Shown::new(command.quiet);
    let progress = |progress: Progress<'_>| shown.show(progress);
    let hooks = Hooks { should_stop: &interrupt::requested, progress: &progress };
    let scratch = cif_output::Workplace::create("cif-capture-")
        .map_err(Error::io("create a temporary folder in", &std::env::temp_dir()))?;
    let sources = sources(&command.inputs)?;
    let mut notes = Notes::new();
    let collected =
        frames::collect(&sources, &choice(command), &scratch.path().join("frames"), &hooks, &mut notes);
    shown.clear();
    let mut shots = collected?;
    let mut left = Left::default();
    let kept = structure::kept_beside(place);
    let places = Places { scratch: scratch.path(), kept: &kept, shown: &shown };
    let made = make(command, &mut shots, &places, &hooks, &mut notes, &mut left);
    shown.clear();
    match &made {
        Ok(()) => structure::remove_kept(&kept),
        Err(error) => unfinished::keep(command, &sources, &shots, &left, error),
    }
    made
}

/// Where files of a run lie, and what shows its progress.
struct Places<'a> {
    /// Folder for what is removed at the end.
    scratch: &'a Path,
    /// Folder for features and matches, which a run without a capture leaves to the next.
    kept: &'a Path,
    shown: &'a Shown,
}

/// Finds or reads the poses of images and writes the capture; fills `left` where it cannot.
fn make(
    command: &Capture,
    shots: &mut [Shot],
    places: &Places<'_>,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
    left: &mut Left,
) -> Result<(), Error> {
    if let Some(path) = &command.times {
        times::apply(&times::read(path)?, path, shots)?;
    }
    let masks = match &command.masks {
        Some(folder) => Some(masks::find(folder, shots)?),
        None => None,
    };
    let known = scale::Known::of(command, masks.as_ref())?;
    let mut posed = match &command.poses {
        Some(path) => {
            let Imported { mut poses, tool, metres_known, up_known, notes: of_poses, .. } =
                import::read(path, shots)?.matched(path, shots)?;
            notes.extend(of_poses);
            if poses.points.is_empty() {
                poses.points = points(command, shots, masks.as_ref(), &poses, places, hooks, notes)?;
            }
            let from = format!("{tool} ({})", path.display());
            Posed { poses, from, verdict: None, metres_known, up_known }
        }
        None => find(command, shots, masks.as_ref(), places, hooks, notes, left)?,
    };
    places.shown.clear();
    for note in notes.iter() {
        crate::messages::note!("{note}");
    }
    if let Some(verdict) = posed.verdict.as_ref().filter(|verdict| !verdict.is_good()) {
        if !command.accept {
            let error = report::not_believed(command, verdict, shots.len());
            left.unbelieved = Some(posed);
            return Err(error);
        }
        crate::messages::warning!(
            "the verdict says no, and the capture is written because of --accept:\n{verdict}"
        );
    }
    let lines = scale::settle(command, &known, shots, masks.as_ref(), &mut posed, hooks)?;
    let capture = Written {
        shots,
        poses: &posed.poses,
        masks: masks.as_ref(),
        metres_known: posed.metres_known,
        up_known: posed.up_known,
        poses_from: &posed.from,
    };
    write::write(&capture, &command.output, hooks)?;
    as_json::give(command, shots, masks.as_ref(), &posed, &lines)
}

fn choice(command: &Capture) -> Choice {
    Choice {
        rate: command.rate,
        count: command.count,
        from_s: command.from,
        to_s: command.to,
        max_side: command.max_side,
        offsets_s: command.offset.iter().cloned().collect(),
        sharpest: command.nearest.then_some(false).or(command.sharpest.then_some(true)),
    }
}

/// Finds poses by structure from motion; of fixed cameras, by the first image of each.
fn find(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    places: &Places<'_>,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
    left: &mut Left,
) -> Result<Posed, Error> {
    let fixed = is_fixed(command, shots);
    let mut seen_still = |error: &cif_capture::Error| {
        left.stands_still = matches!(error, cif_capture::Error::StandsStill { .. })
    };
    frames::check(shots, fixed, notes).inspect_err(&mut seen_still)?;
    let mut solved: Vec<Shot> = shots.to_vec();
    if fixed {
        let mut seen = BTreeSet::new();
        solved.retain(|shot| seen.insert(shot.camera.clone()));
        notes.push(format!(
            "the {} cameras stand still: their poses are those of one moment, {}",
            solved.len(),
            "the first frame of each (--moving finds a pose for every frame)"
        ));
    }
    let black = left_out(command, &solved, masks, places.scratch, hooks)?;
    let work = work_folder(places)?;
    let request = request(command, &solved, black.as_deref(), fixed, &work, places.kept);
    let Found { mut poses, verdict, setting, tried } =
        structure::find(&request, hooks).inspect_err(seen_still)?;
    notes.extend(tried.into_iter().map(|tried| format!("not believed: {tried}")));
    if fixed {
        poses.images = all_frames(&poses, &solved, shots);
        if verdict.is_good() || command.accept {
            match structure::points_of_rig(&Request { shots, ..request }, &poses, hooks) {
                // Where a rig is wrong, mappers may have found points that its poses do not give.
                Ok(points) if points.len() > poses.points.len() => poses.points = points,
                Ok(_) => {}
                Err(cif_capture::Error::Stopped) => return Err(cif_capture::Error::Stopped.into()),
                Err(error) => notes.push(format!("points are those of one moment alone: {error}")),
            }
        }
    }
    Ok(Posed {
        poses,
        from: format!("cif capture: pycolmap, {setting}"),
        verdict: Some(verdict),
        metres_known: false,
        up_known: false,
    })
}

/// Points for poses that come without. Where none can be found, training starts from random ones, with a warning.
fn points(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    poses: &Poses,
    places: &Places<'_>,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Point>, Error> {
    let fixed = is_fixed(command, shots);
    let black = left_out(command, shots, masks, places.scratch, hooks)?;
    let work = work_folder(places)?;
    let request = request(command, shots, black.as_deref(), fixed, &work, places.kept);
    let find = if fixed { structure::points_of_rig } else { structure::points_of_images };
    let problem = match find(&request, poses, hooks) {
        Ok(points) if !points.is_empty() => return Ok(points),
        Ok(_) => "the images show none that fit the poses".to_owned(),
        Err(cif_capture::Error::Stopped) => return Err(cif_capture::Error::Stopped.into()),
        Err(error) => error.to_string(),
    };
    notes.push(format!(
        "the poses come without points, and none were found: {problem}; training starts from random points, which \
         shows less (pip install 'cif4d[capture]' brings pycolmap, which finds points)"
    ));
    Ok(Vec::new())
}

/// Pictures in which what moves is black, where there are masks.
fn left_out(
    command: &Capture,
    shots: &[Shot],
    masks: Option<&Masks>,
    scratch: &Path,
    hooks: &Hooks<'_>,
) -> Result<Option<PathBuf>, Error> {
    let Some(masks) = masks else { return Ok(None) };
    let black = scratch.join("masks");
    let moving = command.moving_ids.as_ref().map(|ids| ids.iter().copied().collect());
    masks::leave_out(masks, shots, moving.as_ref(), &black, hooks)?;
    Ok(Some(black))
}

/// Creates the folders for work on poses, and returns that of files of this run alone.
fn work_folder(places: &Places<'_>) -> Result<PathBuf, Error> {
    let work = places.scratch.join("work");
    for folder in [work.as_path(), places.kept] {
        std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    }
    Ok(work)
}

/// Work on images, as the command line has it, in the folders of this run and of those to come.
fn request<'a>(
    command: &Capture,
    shots: &'a [Shot],
    masks: Option<&'a Path>,
    fixed: bool,
    work: &'a Path,
    kept: &'a Path,
) -> Request<'a> {
    Request {
        shots,
        masks,
        order: order(command, shots, fixed),
        lenses: match command.lenses {
            LensesName::One => Lenses::PerSize,
            LensesName::Each => Lenses::PerCamera,
        },
        focal_px: command.focal,
        // Of fixed cameras one image each is solved.
        moving: command.moving,
        work,
        kept,
        threads: rayon::current_num_threads(),
    }
}

/// Every frame of a fixed camera has the pose of the one that was solved.
fn all_frames(poses: &Poses, solved: &[Shot], shots: &[Shot]) -> BTreeMap<String, cif_capture::poses::Pose> {
    let of_camera: BTreeMap<&str, _> = solved
        .iter()
        .filter_map(|shot| Some((shot.camera.as_str(), *poses.images.get(&shot.name)?)))
        .collect();
    let pose = |shot: &Shot| Some((shot.name.clone(), *of_camera.get(shot.camera.as_str())?));
    shots.iter().filter_map(pose).collect()
}
