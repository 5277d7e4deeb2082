//! From steps to jobs: every step on every capture, scene or batch that it is done for.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::TimeWindow;
use cif_system::Error;

use crate::job::{Batch, Job, Step};
use crate::plan::{Each, Plan, check_name};
use crate::steps::{COLLECT, SCENES, Template, templates};

/// A part of a bench that is a job of its own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// Name, as `--only` of the bench takes it.
    pub name: String,
    /// Parts that come first, by index.
    pub needs: Vec<usize>,
    /// Capture that it reads, from the folder of the plan.
    pub capture: PathBuf,
}

/// Takes benches apart into parts.
pub trait Benches {
    /// Parts of a bench, each after those that it needs; `words` is its command from the name of the bench on.
    ///
    /// # Errors
    /// When the command is not understood, or a capture cannot be read.
    fn parts(&self, words: &[String], folder: &Path) -> Result<Vec<Part>, Error>;
}

/// A scene to be trained.
#[derive(Clone, Debug)]
struct Run {
    /// Name, as in `table/draft.seed1`.
    name: String,
    /// Capture, by index.
    capture: usize,
    /// Options of its training.
    words: Vec<String>,
    /// The scene that it is a window of, by index; each is its own where there are no windows.
    whole: usize,
}

/// Runs that are the windows of one scene, in the order of time.
#[derive(Clone, Debug)]
struct Whole {
    name: String,
    capture: usize,
    runs: std::ops::Range<usize>,
}

/// A capture.
#[derive(Clone, Debug)]
struct Capture {
    name: String,
    /// Relative to the folder of the plan, where it lies below.
    path: PathBuf,
}

/// Expands a plan.
///
/// # Errors
/// When no folder is where captures are to be, two have one name, or steps do not fit together.
pub fn expand(plan: &Plan, benches: &dyn Benches) -> Result<Batch, Error> {
    let captures = captures(plan)?;
    let (runs, wholes) = runs(plan, &captures);
    let mut batch = Batch {
        name: plan.file.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        plan: plan.file.clone(),
        folder: plan.folder().to_owned(),
        output: plan.output.clone(),
        steps: Vec::new(),
        jobs: Vec::new(),
        engines: plan.engines.clone(),
    };
    let mut each_of = Vec::new();
    for template in templates(plan)? {
        let needs: Vec<usize> = template
            .needs
            .iter()
            .filter_map(|name| batch.steps.iter().position(|step| step.name == *name))
            .collect();
        let subjects: Vec<Subject<'_>> = match template.each {
            Each::Run => {
                runs.iter().enumerate().map(|(k, run)| Subject::of_run(plan, &captures, k, run)).collect()
            }
            Each::Whole => {
                (0..wholes.len()).map(|k| Subject::of_whole(plan, &captures, k, &wholes[k], &runs)).collect()
            }
            Each::Capture => captures
                .iter()
                .enumerate()
                .map(|(k, capture)| Subject::of_capture(plan, k, capture))
                .collect(),
            Each::Batch => vec![Subject::of_batch(plan)],
        };
        let first = batch.jobs.len();
        for subject in &subjects {
            let mut job = job(plan, &template, subject, batch.steps.len())?;
            for need in &needs {
                let jobs = batch.steps[*need].jobs.clone();
                job.needs.extend(match_jobs(each_of[*need], jobs, subject, &runs, &wholes));
            }
            batch.jobs.push(job);
        }
        batch.steps.push(Step {
            name: template.name,
            jobs: first..batch.jobs.len(),
            needs,
            resources: template.resources,
        });
        each_of.push(template.each);
    }
    for bench in &plan.bench {
        add_bench(&mut batch, plan, &bench.name, &bench.command.0, benches)?;
    }
    let all = 0..batch.jobs.len();
    let words = vec!["batch".to_owned(), file_name(&plan.file), "--collect".to_owned()];
    let index = plan.output.join("index.html");
    batch.jobs.push(Job {
        id: COLLECT.to_owned(),
        step: batch.steps.len(),
        words,
        needs: all.clone().collect(),
        makes: vec![index],
        capture: None,
        goes_on: false,
    });
    let needs = (0..batch.steps.len()).collect();
    let resources = plan.resources;
    batch.steps.push(Step { name: COLLECT.to_owned(), jobs: all.end..all.end + 1, needs, resources });
    Ok(batch)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Folders that the patterns of a plan name, sorted within each pattern.
fn captures(plan: &Plan) -> Result<Vec<Capture>, Error> {
    let folder = plan.folder();
    let refused =
        |problem: String, fix: &str| Error::refused(format!("{}: {problem}", plan.file.display()), fix);
    let mut found: Vec<Capture> = Vec::new();
    for pattern in &plan.captures {
        // The folder of the plan may hold what would be a wildcard.
        let base = glob::Pattern::escape(&folder.to_string_lossy());
        let whole = match Path::new(pattern).is_absolute() {
            true => pattern.clone(),
            false => format!("{base}/{pattern}"),
        };
        let paths = glob::glob(&whole)
            .map_err(|error| refused(format!("`{pattern}` is no pattern: {error}"), "as in captures/*"))?;
        let before = found.len();
        for path in paths.filter_map(Result::ok).filter(|path| path.is_dir()) {
            let name = match path.file_name() {
                Some(name) => name.to_string_lossy().into_owned(),
                // As of `.`.
                None => file_name(&path.canonicalize().map_err(Error::io("find", &path))?),
            };
            check_name(&name).map_err(|problem| refused(problem, "rename the folder of the capture"))?;
            let path = path.strip_prefix(folder).map_or(path.clone(), Path::to_owned);
            if found.iter().any(|capture| capture.path == path) {
                continue;
            }
            if found.iter().any(|capture| capture.name == name) {
                let problem = format!("two captures are called `{name}`");
                return Err(refused(problem, "results are named by captures: rename one of the folders"));
            }
            found.push(Capture { name, path });
        }
        if found.len() == before {
            let problem = format!("there is no folder `{pattern}`");
            return Err(refused(
                problem,
                "captures are folders, named from that of the plan, with * for any",
            ));
        }
    }
    Ok(found)
}

/// A run for every value of each axis of a plan, of which one that it does not name has none, and for every window of time;
/// and the scenes that they are windows of.
fn runs(plan: &Plan, captures: &[Capture]) -> (Vec<Run>, Vec<Whole>) {
    let mut settings: Vec<(Vec<String>, Vec<String>)> = vec![Default::default()];
    let flag = |flag: &str, values: &[String]| -> Vec<(String, Vec<String>)> {
        values.iter().map(|value| (value.clone(), vec![flag.to_owned(), value.clone()])).collect()
    };
    let variants = plan.variants.iter().map(|(name, words)| (name.clone(), words.0.clone())).collect();
    let seeds = plan
        .train
        .seed
        .iter()
        .map(|seed| (format!("seed{seed}"), vec!["--seed".to_owned(), seed.to_string()]));
    let axes =
        [flag("--preset", &plan.train.preset), flag("--head", &plan.train.head), variants, seeds.collect()];
    for axis in axes.into_iter().filter(|axis| !axis.is_empty()) {
        let extended = |(names, words): &(Vec<String>, Vec<String>)| {
            let with = |(name, more): &(String, Vec<String>)| {
                ([&names[..], std::slice::from_ref(name)].concat(), [&words[..], more].concat())
            };
            axis.iter().map(with).collect::<Vec<_>>()
        };
        settings = settings.iter().flat_map(extended).collect();
    }
    let windows: Vec<Option<TimeWindow>> = match plan.train.windows {
        0 => vec![None],
        count => TimeWindow::all(count).map(Some).collect(),
    };
    let (mut runs, mut wholes) = (Vec::new(), Vec::new());
    for (capture, of) in captures.iter().enumerate() {
        for (names, words) in &settings {
            let setting = if names.is_empty() { "run".to_owned() } else { names.join(".") };
            let (name, whole, first) = (format!("{}/{setting}", of.name), wholes.len(), runs.len());
            for window in &windows {
                let mut run = Run { name: name.clone(), capture, words: words.clone(), whole };
                if let Some(window) = window {
                    // Folders are in the order of time, whatever lists them.
                    run.name += &format!("{WINDOW}{:03}", window.number());
                    run.words.extend(["--window".to_owned(), window.to_string()]);
                }
                runs.push(run);
            }
            wholes.push(Whole { name, capture, runs: first..runs.len() });
        }
    }
    (runs, wholes)
}

/// Stands between the name of a scene and the number of a window of it, as in `walk/draft.window002`.
pub const WINDOW: &str = ".window";

/// The scene, capture or batch that a job works on.
struct Subject<'a> {
    name: String,
    capture: Option<usize>,
    run: Option<(usize, &'a Run)>,
    whole: Option<usize>,
    /// Files of the scenes that it works on.
    scenes: Vec<String>,
    path: Option<&'a Path>,
    /// Values of placeholders.
    values: BTreeMap<&'static str, String>,
}

impl<'a> Subject<'a> {
    fn of_batch(plan: &Plan) -> Self {
        let values = BTreeMap::from([("output", plan.output.display().to_string())]);
        let scenes = Vec::new();
        Self { name: String::new(), capture: None, run: None, whole: None, scenes, path: None, values }
    }

    fn of_capture(plan: &Plan, index: usize, capture: &'a Capture) -> Self {
        let mut subject = Self::of_batch(plan);
        let folder = plan.output.join("captures").join(&capture.name);
        subject.values.insert("capture", capture.path.display().to_string());
        subject.values.insert("name", capture.name.clone());
        subject.values.insert("folder", folder.display().to_string());
        Self { name: capture.name.clone(), capture: Some(index), path: Some(&capture.path), ..subject }
    }

    fn of_run(plan: &Plan, captures: &'a [Capture], index: usize, run: &'a Run) -> Self {
        let mut subject = Self::of_capture(plan, run.capture, &captures[run.capture]);
        let (folder, scene) = (folder_of(plan, &run.name), scene_of(plan, &run.name));
        subject.values.insert("scene", scene.clone());
        subject.values.insert("folder", folder.display().to_string());
        subject.values.insert("name", run.name.clone());
        let (name, run) = (run.name.clone(), Some((index, run)));
        Self { name, run, whole: run.map(|(_, run)| run.whole), scenes: vec![scene], ..subject }
    }

    fn of_whole(plan: &Plan, captures: &'a [Capture], index: usize, whole: &Whole, runs: &[Run]) -> Self {
        let mut subject = Self::of_capture(plan, whole.capture, &captures[whole.capture]);
        subject.scenes = runs[whole.runs.clone()].iter().map(|run| scene_of(plan, &run.name)).collect();
        if let [scene] = subject.scenes.as_slice() {
            subject.values.insert("scene", scene.clone());
        }
        subject.values.insert("folder", folder_of(plan, &whole.name).display().to_string());
        subject.values.insert("name", whole.name.clone());
        Self { name: whole.name.clone(), whole: Some(index), ..subject }
    }

    /// A text with the values in place of the placeholders.
    fn fill(&self, text: &str) -> Result<String, String> {
        let mut filled = String::new();
        let mut rest = text;
        while let Some((before, after)) = rest.split_once('{') {
            let Some((name, after)) = after.split_once('}') else { break };
            filled += before;
            filled += self.values.get(name).ok_or_else(|| {
                let known: Vec<String> = self.values.keys().map(|name| format!("{{{name}}}")).collect();
                format!("`{{{name}}}` in `{text}` stands for nothing here; there are {}", known.join(", "))
            })?;
            rest = after;
        }
        Ok(filled + rest)
    }
}

/// Folder of the results of a scene.
fn folder_of(plan: &Plan, name: &str) -> PathBuf {
    plan.output.join("scenes").join(name)
}

fn scene_of(plan: &Plan, name: &str) -> String {
    folder_of(plan, name).join("scene.cif").display().to_string()
}

fn job(plan: &Plan, template: &Template, subject: &Subject<'_>, step: usize) -> Result<Job, Error> {
    let fill = |text: &String| {
        subject.fill(text).map_err(|problem| {
            let problem = format!("{}: step `{}`: {problem}", plan.file.display(), template.name);
            Error::refused(problem, "a brace that is no placeholder cannot stand in a plan")
        })
    };
    let mut words = Vec::with_capacity(template.words.len());
    for word in &template.words {
        match word.as_str() {
            SCENES if !subject.scenes.is_empty() => words.extend(subject.scenes.iter().cloned()),
            _ => words.push(fill(word)?),
        }
    }
    if template.goes_on
        && let Some((_, run)) = subject.run
    {
        words.extend(run.words.iter().cloned());
    }
    let makes =
        template.makes.iter().map(|text| fill(text).map(PathBuf::from)).collect::<Result<Vec<_>, _>>()?;
    let id = if subject.name.is_empty() {
        template.name.clone()
    } else {
        format!("{}/{}", template.name, subject.name)
    };
    Ok(Job {
        id,
        step,
        words,
        needs: Vec::new(),
        makes,
        capture: subject.path.map(Path::to_owned),
        goes_on: template.goes_on,
    })
}

/// Jobs of a needed step that belong to what a job works on.
fn match_jobs(
    each: Each,
    jobs: std::ops::Range<usize>,
    subject: &Subject<'_>,
    runs: &[Run],
    wholes: &[Whole],
) -> Vec<usize> {
    match (each, subject.capture) {
        (Each::Run, Some(capture)) => match (subject.run, subject.whole) {
            (Some((run, _)), _) => vec![jobs.start + run],
            (None, Some(whole)) => wholes[whole].runs.clone().map(|run| jobs.start + run).collect(),
            _ => jobs.zip(runs).filter(|(_, run)| run.capture == capture).map(|(job, _)| job).collect(),
        },
        (Each::Whole, Some(capture)) => match subject.whole {
            Some(whole) => vec![jobs.start + whole],
            None => jobs.zip(wholes).filter(|(_, of)| of.capture == capture).map(|(job, _)| job).collect(),
        },
        (Each::Capture, Some(capture)) => vec![jobs.start + capture],
        _ => jobs.collect(),
    }
}

/// Adds the parts of a bench, a step per layer of parts that need each other, and the bench itself, which collects them.
fn add_bench(
    batch: &mut Batch,
    plan: &Plan,
    name: &str,
    command: &[String],
    benches: &dyn Benches,
) -> Result<(), Error> {
    let subject = Subject::of_batch(plan);
    let words =
        command.iter().map(|word| subject.fill(word)).collect::<Result<Vec<_>, _>>().map_err(|problem| {
            Error::refused(
                format!("{}: bench `{name}`: {problem}", plan.file.display()),
                "name the folder of its report with -o {output}/NAME",
            )
        })?;
    let parts = benches.parts(&words, &batch.folder)?;
    let mut layer: Vec<usize> = Vec::new();
    for part in &parts {
        layer.push(part.needs.iter().map(|need| layer[*need] + 1).max().unwrap_or(0));
    }
    let layers = layer.iter().max().map_or(0, |last| last + 1);
    let job = |id: String, step, words: Vec<String>, needs| Job {
        id,
        step,
        words: std::iter::once("bench".to_owned()).chain(words).collect(),
        needs,
        makes: Vec::new(),
        capture: None,
        goes_on: false,
    };
    let mut place = vec![0; parts.len()];
    let first_step = batch.steps.len();
    for of in 0..layers {
        let (first, step) = (batch.jobs.len(), batch.steps.len());
        for (k, part) in parts.iter().enumerate().filter(|(k, _)| layer[*k] == of) {
            place[k] = batch.jobs.len();
            let needs = part.needs.iter().map(|need| place[*need]).collect();
            let words = [&words[..], &["--only".to_owned(), part.name.clone()]].concat();
            let job = job(format!("{name}/{}", part.name), step, words, needs);
            batch.jobs.push(Job { capture: Some(part.capture.clone()), ..job });
        }
        let needs = (first_step..step).collect();
        let jobs = first..batch.jobs.len();
        batch.steps.push(Step { name: format!("{name}-{}", of + 1), jobs, needs, resources: plan.resources });
    }
    let (end, step) = (batch.jobs.len(), batch.steps.len());
    batch.jobs.push(job(name.to_owned(), step, words, place));
    let needs = (first_step..step).collect();
    batch.steps.push(Step { name: name.to_owned(), jobs: end..end + 1, needs, resources: plan.resources });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    struct TwoLayers;

    impl Benches for TwoLayers {
        fn parts(&self, words: &[String], _: &Path) -> Result<Vec<Part>, Error> {
            assert_eq!(words, ["compare", "a", "-o", "results/compare"]);
            let part = |name: &str, needs: &[usize]| Part {
                name: name.to_owned(),
                needs: needs.to_vec(),
                capture: "a".into(),
            };
            Ok(vec![part("base", &[]), part("cif", &[0]), part("sa4d", &[0])])
        }
    }

    fn batch(text: &str) -> Result<Batch, String> {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a", "b"] {
            std::fs::create_dir_all(folder.path().join("captures").join(name)).unwrap();
        }
        std::fs::create_dir(folder.path().join("a")).unwrap();
        std::fs::write(folder.path().join("captures/notes.txt"), "").unwrap();
        let file = folder.path().join("plan.toml");
        std::fs::write(&file, text).unwrap();
        let plan = Plan::read(&file).map_err(|error| error.to_string())?;
        expand(&plan, &TwoLayers).map_err(|error| error.to_string())
    }

    fn ids(batch: &Batch, jobs: &[usize]) -> Vec<String> {
        jobs.iter().map(|job| batch.jobs[*job].id.clone()).collect()
    }

    #[test]
    fn a_plan_becomes_a_job_per_step_and_value() {
        let batch = batch(
            "captures = ['captures/*']\ncapture_options = '--masks tracked'\n[train]\nseed = [0, 1]\npreset = ['draft']\n\
             [variants]\nplain = []\nsoft = '--set a.b=1'\n[export]\nfiles = ['scene.usda']\n\
             [[step]]\nname = 'sheet'\neach = 'capture'\nneeds = ['export']\ncommand = 'info {capture}'\n\
             [[step]]\nname = 'masks'\neach = 'capture'\ncommand = 'info {capture}'\n",
        )
        .unwrap();
        let sizes: Vec<(&str, usize)> =
            batch.steps.iter().map(|step| (step.name.as_str(), step.jobs.len())).collect();
        assert_eq!(
            sizes,
            [("train", 8), ("eval", 8), ("export", 8), ("sheet", 2), ("masks", 2), ("collect", 1)]
        );
        let train = &batch.jobs[batch.named("train/a/draft.soft.seed1").unwrap().start];
        let scene = "results/scenes/a/draft.soft.seed1/scene.cif";
        assert_eq!(
            train.words.join(" "),
            format!(
                "train captures/a -o {scene} --json=results/scenes/a/draft.soft.seed1/train.json --force --masks tracked \
                 --preset draft --set a.b=1 --seed 1"
            )
        );
        assert!(train.goes_on && train.makes[0] == Path::new(scene));
        let export = &batch.jobs[batch.named("export/a/draft.soft.seed1").unwrap().start];
        assert_eq!(ids(&batch, &export.needs), ["train/a/draft.soft.seed1"]);
        let sheet = &batch.jobs[batch.named("sheet/b").unwrap().start];
        let needed = ["plain.seed0", "plain.seed1", "soft.seed0", "soft.seed1"]
            .map(|run| format!("export/b/draft.{run}"));
        assert_eq!(ids(&batch, &sheet.needs), needed);
        assert_eq!(batch.jobs.last().unwrap().needs.len(), 28);
        for (k, job) in batch.jobs.iter().enumerate() {
            assert!(job.needs.iter().all(|need| *need < k), "{} comes before what it needs", job.id);
        }
    }

    #[test]
    fn windows_are_trained_and_scored_one_by_one_and_exported_together() {
        let batch = batch(
            "captures = ['captures/*']\n[train]\nseed = [0, 1]\nwindows = 2\n[export]\nfiles = ['scene.usda']\n\
             [[step]]\nname = 'sheet'\neach = 'whole'\nneeds = ['eval']\ncommand = 'info {folder}'\n\
             [[step]]\nname = 'page'\neach = 'capture'\nneeds = ['export']\ncommand = 'info {capture}'\n",
        )
        .unwrap();
        let sizes: Vec<(&str, usize)> =
            batch.steps.iter().map(|step| (step.name.as_str(), step.jobs.len())).collect();
        assert_eq!(
            sizes,
            [("train", 8), ("eval", 8), ("export", 4), ("sheet", 4), ("page", 2), ("collect", 1)]
        );
        let train = &batch.jobs[batch.named("train/b/seed1.window002").unwrap().start];
        assert!(train.words.join(" ").ends_with("--seed 1 --window 2/2"), "{:?}", train.words);
        let export = &batch.jobs[batch.named("export/b/seed1").unwrap().start];
        let folder = "results/scenes/b/seed1";
        assert_eq!(
            export.words.join(" "),
            format!(
                "export {folder}.window001/scene.cif {folder}.window002/scene.cif {folder}/scene.usda --force"
            )
        );
        let windows = ["train/b/seed1.window001", "train/b/seed1.window002"];
        assert_eq!(ids(&batch, &export.needs), windows);
        let sheet = &batch.jobs[batch.named("sheet/b/seed1").unwrap().start];
        assert_eq!(sheet.words, ["info", folder]);
        let scored = ["eval/b/seed1.window001", "eval/b/seed1.window002"];
        assert_eq!(ids(&batch, &sheet.needs), [&scored[..], &windows[..]].concat());
        let page = &batch.jobs[batch.named("page/b").unwrap().start];
        assert_eq!(ids(&batch, &page.needs), ["export/b/seed0", "export/b/seed1"]);
    }

    #[test]
    fn benches_are_taken_apart_in_layers() {
        let batch = batch("[[bench]]\nname = 'heads'\ncommand = 'compare a -o {output}/compare'\n").unwrap();
        let all: Vec<&str> = batch.jobs.iter().map(|job| job.id.as_str()).collect();
        assert_eq!(all, ["heads/base", "heads/cif", "heads/sa4d", "heads", "collect"]);
        assert_eq!(batch.jobs[2].words.join(" "), "bench compare a -o results/compare --only sa4d");
        assert_eq!(batch.jobs[3].words.join(" "), "bench compare a -o results/compare");
        assert_eq!(batch.jobs[3].needs, [0, 1, 2]);
        assert_eq!(batch.steps[1].needs, [0]);
    }

    #[test]
    fn plans_that_do_not_fit_together_are_refused() {
        for (text, said) in [
            ("captures = ['nowhere/*']", "there is no folder `nowhere/*`"),
            ("captures = ['a', 'captures/a']", "two captures are called `a`"),
            (
                "captures = ['a']\n[[step]]\nname = 'x'\ncommand = 'info {sceen}'",
                "`{sceen}` in `{sceen}` stands for nothing",
            ),
            (
                "captures = ['a']\n[[step]]\nname = 'x'\nneeds = ['y']\ncommand = 'info'",
                "needs `y`, which is no step",
            ),
            (
                "captures = ['a']\n[train]\nneeds = ['x']\n[[step]]\nname = 'x'\ncommand = 'info'",
                "need each other",
            ),
            ("captures = ['a']\n[[step]]\nname = 'eval'\ncommand = 'info'", "two steps are called `eval`"),
            (
                "captures = ['a']\n[[step]]\nname = 'x'\neach = 'batch'\ncommand = 'info {capture}'",
                "stands for nothing",
            ),
        ] {
            let error = batch(text).unwrap_err();
            assert!(error.contains(said), "{text}: {error}");
        }
    }

    #[test]
    fn ten_thousand_jobs_are_expanded_at_once() {
        let seeds: Vec<String> = (0..2_500).map(|seed| seed.to_string()).collect();
        let text = format!("captures = ['captures/*']\n[train]\nseed = [{}]\n", seeds.join(", "));
        assert_eq!(batch(&text).unwrap().jobs.len(), 10_001);
    }
}
