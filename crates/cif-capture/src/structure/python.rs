//! pycolmap, run in a Python of its own: the one that the wheel runs in, `$CIF_PYTHON`, or the first on the
//! path.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use cif_geometry::{LensDistortion, RigidTransform};
use cif_system::environment;
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::features::Features;
use super::request::Request;
use super::stage::Staged;
use crate::poses::{Lens, Point, Pose, Poses};
use crate::{Error, Hooks, child};

/// The program that Python runs.
const SCRIPT: &str = include_str!("reconstruct.py");

/// Environment variable that names the Python.
const VARIABLE: &str = environment::PYTHON.name();

/// Points that are seen from fewer images, or lie further from where they are seen, are left out.
const MIN_TRACK: usize = 3;
const MAX_ERROR_PX: f64 = 2.0;

/// Points that two images with known poses see may lie this far from where they are seen: 1.5 % of them were
/// more than a tenth of the scene from any surface, 3 % at twice the distance.
const MAX_ERROR_OF_TWO_PX: f64 = 1.0;

/// Parts of the lines with which COLMAP's global mapper begins its steps, and their number.
const STEP_OF_GLOBAL_MAPPER: [&str; 2] = ["global_mapper.cc", "=== Running "];
const STEPS_OF_GLOBAL_MAPPER: usize = 5;

static OWN: OnceLock<PathBuf> = OnceLock::new();

/// Names the Python that this process is part of; the first call counts. `CIF_PYTHON` still wins.
pub fn set_python(program: PathBuf) {
    let _ = OWN.set(program);
}

/// Pythons to try for packages of Python, in order.
#[must_use]
pub fn pythons() -> Vec<OsString> {
    if let Some(program) = environment::PYTHON.value().filter(|program| !program.is_empty()) {
        return vec![program];
    }
    match OWN.get() {
        Some(program) => vec![program.clone().into_os_string()],
        None => ["python3", "python"].map(OsString::from).to_vec(),
    }
}

/// Work for pycolmap; `reconstruct.py` says what the fields mean.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Job<'a> {
    pub(super) kept: &'a Path,
    pub(super) work: &'a Path,
    pub(super) images: &'a Path,
    pub(super) masks: Option<&'a Path>,
    pub(super) pictures: &'a Path,
    pub(super) names: &'a [String],
    pub(super) keys: &'a [String],
    pub(super) matched: String,
    pub(super) verified: String,
    pub(super) side: u32,
    pub(super) peak: Option<f64>,
    pub(super) pairs: &'a [(usize, usize)],
    pub(super) cameras: &'a [Group],
    pub(super) model: &'static str,
    pub(super) runs: &'a [Run],
    /// Where images are known to be, by name, for points.
    pub(super) poses: Option<BTreeMap<String, KnownPose>>,
    pub(super) threads: usize,
}

impl<'a> Job<'a> {
    /// Features and matches of images; the lens model, runs and poses are for the caller to add.
    pub(super) fn of(
        request: &Request<'a>,
        staged: &'a Staged,
        pairs: &'a [(usize, usize)],
        cameras: &'a [Group],
        features: Features,
    ) -> Self {
        let Features { side, peak } = features;
        let matched = format!("{side} {peak:?}");
        Job {
            kept: request.kept,
            work: request.work,
            images: &staged.images,
            masks: staged.masks.as_deref(),
            pictures: &staged.pictures,
            names: &staged.names,
            keys: &staged.keys,
            verified: staged.fingerprint(&format!("{matched} {cameras:?} {pairs:?}")),
            matched: staged.fingerprint(&matched),
            side,
            peak,
            pairs,
            cameras,
            model: "",
            runs: &[],
            poses: None,
            threads: request.threads,
        }
    }
}

/// Where an image is known to be: camera from world.
#[derive(Clone, Debug, Serialize)]
pub(super) struct KnownPose {
    /// Quaternion w, x, y, z.
    rotation: [f64; 4],
    translation: [f64; 3],
}

impl KnownPose {
    pub(super) fn of(world_from_camera: &RigidTransform) -> Self {
        let camera_from_world = world_from_camera.inverse();
        let [x, y, z, w] = DQuat::from_mat3(&camera_from_world.rotation).to_array();
        Self { rotation: [w, x, y, z], translation: camera_from_world.translation.to_array() }
    }
}

/// Images that share a lens.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Group {
    pub(super) images: Vec<usize>,
    /// Of the lens to start from, as its model has them: focal lengths, principal point, distortion.
    pub(super) params: Option<Vec<f64>>,
    pub(super) size: (u32, u32),
}

/// One run of a mapper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Run {
    pub(super) mapper: Mapper,
    pub(super) seed: u32,
}

/// Mappers of COLMAP.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Mapper {
    /// All images at once (GLOMAP).
    Global,
    /// One image after the other.
    Incremental,
}

/// Result of a mapper.
#[derive(Clone, Debug)]
pub(super) struct Model {
    /// Of the images that have some.
    pub(super) poses: Poses,
    /// Share of the verified matches of these whose rays meet by the poses.
    pub(super) fitting: f64,
}

/// Findings of pycolmap.
#[derive(Debug)]
pub(super) struct Outcome {
    /// Features of every image.
    pub(super) features: BTreeMap<String, usize>,
    /// Median distance of the matches of every pair from the same place in the other image, as a share of the larger
    /// side; `None` where there are few. Of jobs without runs.
    pub(super) moved: Vec<Option<f64>>,
    /// The largest model of every run.
    pub(super) runs: Vec<Option<Model>>,
    /// Points that images with known poses see, and by how many of them each is seen.
    pub(super) points: Vec<(Point, usize)>,
}

#[derive(Deserialize)]
struct AnswerJson {
    missing: Option<String>,
    python: Option<String>,
    version: Option<String>,
    #[serde(default)]
    features: BTreeMap<String, usize>,
    #[serde(default)]
    moved: Vec<Option<f64>>,
    #[serde(default)]
    runs: Vec<Option<ModelJson>>,
    #[serde(default)]
    points: Vec<PointJson>,
}

#[derive(Deserialize)]
struct ModelJson {
    cameras: BTreeMap<u32, CameraJson>,
    images: BTreeMap<String, ImageJson>,
    points: Vec<PointJson>,
    reprojection_px: f64,
    fitting: f64,
}

#[derive(Deserialize)]
struct CameraJson {
    model: String,
    width: u32,
    height: u32,
    params: Vec<f64>,
}

#[derive(Deserialize)]
struct ImageJson {
    camera: u32,
    rotation: [f64; 4],
    translation: [f64; 3],
    points: usize,
}

#[derive(Deserialize)]
struct PointJson {
    position: [f64; 3],
    color: [u8; 3],
    error: f64,
    images: usize,
}

impl PointJson {
    fn point(&self) -> Point {
        Point { position: DVec3::from_array(self.position), color: self.color }
    }
}

/// Runs a job.
///
/// # Errors
/// When Python or pycolmap is missing or fails, or the caller stops.
pub(super) fn run(job: &Job<'_>, hooks: &Hooks<'_>) -> Result<Outcome, Error> {
    let mut input = serde_json::to_vec(job).map_err(|error| {
        Error::refused(format!("a name cannot be passed to Python: {error}"), "rename it")
    })?;
    input.push(b'\n');
    let programs = pythons();
    for program in &programs {
        let mut command = cif_system::python::script(program, SCRIPT);
        // A thread of one library must not start a thread per processor in another.
        command.env("OMP_NUM_THREADS", job.threads.to_string());
        // Logs of COLMAP go to the standard error alone, and whatever else is temporary goes with this run.
        command.env("GLOG_logtostderr", "1").env("GLOG_log_dir", job.work).env("TMPDIR", job.work);
        let mut steps = 0;
        let line = |line: &str| {
            if let Some((done, total, words)) = counted(line) {
                if total > 0 { hooks.count(words, done, total) } else { hooks.say(words) }
            } else if STEP_OF_GLOBAL_MAPPER.iter().all(|part| line.contains(part)) {
                steps += 1;
                hooks.count(
                    "steps of poses, global mapper",
                    steps.min(STEPS_OF_GLOBAL_MAPPER) - 1,
                    STEPS_OF_GLOBAL_MAPPER,
                );
            }
        };
        let Some(answer) = child::run_attended(&mut command, &input, hooks.should_stop, line)? else {
            continue;
        };
        let parsed: Option<AnswerJson> = serde_json::from_slice(&answer.output).ok();
        return match parsed {
            Some(AnswerJson { missing: Some(problem), python, version, .. }) => {
                Err(pycolmap_missing(&problem, &python.unwrap_or_default(), &version.unwrap_or_default()))
            }
            Some(answer) => outcome(answer),
            None => Err(child::died("pycolmap", answer.status, &words_of(&answer.last_words))),
        };
    }
    Err(Error::refused(
        "poses and points are found by pycolmap, which needs Python, and there is none on the PATH",
        format!(
            "install Python 3.10 to 3.13 and pycolmap (pip install pycolmap), and name it by {VARIABLE}; or give \
                 poses of another tool with --poses"
        ),
    ))
}

/// pycolmap cannot be imported.
fn pycolmap_missing(problem: &str, python: &str, version: &str) -> Error {
    Error::refused(
        format!(
            "poses and points are found by pycolmap, which Python {version} ({python}) does not have: {problem}"
        ),
        format!(
            "install it: {python} -m pip install 'cif4d[capture]', or pip install pycolmap; {VARIABLE} names another \
             Python; or give poses of another tool with --poses"
        ),
    )
}

/// Progress of a line `@ DONE TOTAL WORDS`.
fn counted(line: &str) -> Option<(usize, usize, &str)> {
    let mut parts = line.strip_prefix("@ ")?.splitn(3, ' ');
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?, parts.next()?))
}

/// The lines of pycolmap that say what failed.
fn words_of(text: &str) -> String {
    let is_log = |line: &str| line.starts_with("@ ") || line.starts_with("I20") || line.starts_with("W20");
    text.lines().filter(|line| !is_log(line)).collect::<Vec<_>>().join("\n")
}

fn outcome(answer: AnswerJson) -> Result<Outcome, Error> {
    let model = |model: ModelJson| Ok(Model { fitting: model.fitting, poses: poses(model)? });
    let runs = answer.runs.into_iter().map(|found| found.map(model).transpose());
    // Where poses are known, two views fix a place too, if they agree well.
    let is_sure = |point: &&PointJson| {
        (point.images >= MIN_TRACK && point.error <= MAX_ERROR_PX) || point.error <= MAX_ERROR_OF_TWO_PX
    };
    let points = answer.points.iter().filter(is_sure).map(|point| (point.point(), point.images)).collect();
    let runs = runs.collect::<Result<_, Error>>()?;
    Ok(Outcome { features: answer.features, moved: answer.moved, runs, points })
}

/// A model in the types of this crate.
fn poses(model: ModelJson) -> Result<Poses, Error> {
    let mut numbers = BTreeMap::new();
    let mut lenses = Vec::new();
    for (number, camera) in &model.cameras {
        let (focal_px, principal_px, k1) = match (camera.model.as_str(), camera.params.as_slice()) {
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], k),
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], 0.0),
            (other, _) => {
                let problem = format!("pycolmap answered with a lens of the unexpected kind {other}");
                return Err(Error::refused(
                    problem,
                    "install the version of pycolmap that cif4d[capture] asks for",
                ));
            }
        };
        numbers.insert(*number, lenses.len());
        lenses.push(Lens {
            size: (camera.width, camera.height),
            focal_px,
            principal_px,
            distortion: LensDistortion { radial: [k1, 0.0, 0.0, 0.0], ..LensDistortion::default() },
        });
    }
    let pose = |image: &ImageJson| {
        let [w, x, y, z] = image.rotation;
        let camera_from_world = RigidTransform {
            rotation: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()),
            translation: DVec3::from_array(image.translation),
        };
        let lens = numbers.get(&image.camera).copied()?;
        Some(Pose { lens, world_from_camera: camera_from_world.inverse(), points: image.points })
    };
    let images = model.images.iter().filter_map(|(name, image)| Some((name.clone(), pose(image)?))).collect();
    let points = model
        .points
        .iter()
        .filter(|point| point.images >= MIN_TRACK && point.error <= MAX_ERROR_PX)
        .map(PointJson::point)
        .collect();
    Ok(Poses { lenses, images, points, reprojection_px: Some(model.reprojection_px) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_come_in_the_axes_of_this_crate() {
        let text = r#"{"cameras": {"3": {"model": "SIMPLE_RADIAL", "width": 64, "height": 48,
            "params": [50.0, 32.0, 24.0, -0.1]}}, "images": {"a.png": {"camera": 3,
            "rotation": [0.70710678, 0.0, 0.0, 0.70710678], "translation": [1.0, 2.0, 3.0], "points": 7}},
            "points": [{"position": [1, 2, 3], "color": [9, 8, 7], "error": 0.5, "images": 4},
            {"position": [1, 2, 9], "color": [9, 8, 7], "error": 3.5, "images": 4},
            {"position": [1, 2, 9], "color": [9, 8, 7], "error": 0.1, "images": 2}], "reprojection_px": 0.4, "fitting": 0.97}"#;
        let poses = poses(serde_json::from_str(text).unwrap()).unwrap();
        let camera = poses.images["a.png"].world_from_camera;
        // Camera to world: the camera's place maps to its origin.
        assert!(camera.inverse().apply(camera.translation).length() < 1e-9);
        assert!((camera.translation - DVec3::new(-2.0, 1.0, -3.0)).length() < 1e-6, "{camera:?}");
        assert_eq!(poses.lenses[0].distortion.radial[0], -0.1);
        assert_eq!(poses.points.len(), 1, "points seen by few images, or badly, are left out");
    }

    #[test]
    fn progress_is_read_and_logs_are_no_reasons() {
        assert_eq!(counted("@ 3 40 features of images"), Some((3, 40, "features of images")));
        assert_eq!(counted("3 40 features"), None);
        assert_eq!(words_of("@ 3 40 features\nI2026 global\nW2026 slow\nno such file"), "no such file");
    }

    #[test]
    fn a_missing_pycolmap_is_reported_with_how_to_install_it() {
        let error = pycolmap_missing("No module named 'pycolmap'", "/usr/bin/python3", "3.12.1");
        let Error::System(cif_system::Error::Refused { problem, fix }) = error else {
            panic!("another error")
        };
        assert!(problem.contains("/usr/bin/python3") && problem.contains("3.12.1"), "{problem}");
        assert!(fix.contains("pip install 'cif4d[capture]'") && fix.contains("--poses"), "{fix}");
    }
}
