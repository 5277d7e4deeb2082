//! All scenes of a batch: the page `index.html`, and its tables `scores.csv` and `costs.csv`.
//!
//! Scenes are in the order of their names, so that scores are the same bytes in whatever order and wherever jobs ran.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::comparison::tables::Mean;
use crate::error::{Error, write_file};
use crate::page::{self, Header, close, escape, open};

/// Scores by the heading of their column, and their place in the report of `cif eval`.
const SCORES: [(&str, &str, usize); 7] = [
    ("PSNR dB", "/psnr", 2),
    ("SSIM", "/ssim", 3),
    ("PQ %", "/panoptic/quality", 2),
    ("IoU %", "/panoptic/iou", 2),
    ("mAcc-pix %", "/macc_pix", 2),
    ("mAcc-inst %", "/macc_inst", 2),
    ("mIoU %", "/miou", 2),
];

/// A scene of a batch.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// Name of its capture.
    pub capture: String,
    /// Its settings, joined by dots; the seed is the part `seedN`.
    pub settings: String,
    /// Report of `cif eval`; null without one.
    pub scores: Value,
    /// Report of `cif train`; null without one.
    pub training: Value,
    /// A picture of it, relative to the page.
    pub picture: Option<PathBuf>,
    /// Files that it left as, relative to the page.
    pub files: Vec<PathBuf>,
    /// Processor time of all its jobs, seconds.
    pub cpu_s: f64,
    /// Largest memory of its jobs, bytes.
    pub peak_bytes: u64,
}

/// A job that is not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Undone {
    /// Name.
    pub job: String,
    /// Why, where it failed; `None` where it was not run.
    pub error: Option<String>,
    /// Its log, relative to the page.
    pub log: PathBuf,
}

/// Subject of a page.
#[derive(Clone, Debug)]
pub struct Batch<'a> {
    /// Name.
    pub name: &'a str,
    /// Command that made it.
    pub command: &'a str,
    /// Number of jobs.
    pub jobs: usize,
    /// Scenes.
    pub scenes: &'a [Scene],
    /// Jobs that are not done.
    pub undone: &'a [Undone],
    /// Pages of benches, relative to the page.
    pub benches: &'a [PathBuf],
}

impl Scene {
    fn score(&self, place: &str) -> Option<f64> {
        self.scores.pointer(place)?.as_f64()
    }

    /// Its settings without the seed.
    fn without_seed(&self) -> String {
        let is_seed =
            |part: &&str| part.strip_prefix("seed").is_some_and(|number| number.parse::<u64>().is_ok());
        let parts: Vec<&str> = self.settings.split('.').filter(|part| !is_seed(part)).collect();
        if parts.is_empty() { "run".to_owned() } else { parts.join(".") }
    }

    fn phases(&self) -> Vec<(String, f64)> {
        let phases = self.training.pointer("/run/cpu_s_by_phase").and_then(Value::as_object);
        let seconds = |(name, seconds): (&String, &Value)| Some((name.clone(), seconds.as_f64()?));
        phases.into_iter().flatten().filter_map(seconds).collect()
    }
}

/// Writes the page and the tables.
///
/// # Errors
/// When a file cannot be written.
pub fn write(folder: &Path, batch: &Batch<'_>) -> Result<(), Error> {
    write_file(&folder.join("scores.csv"), scores_csv(batch.scenes).as_bytes())?;
    write_file(&folder.join("costs.csv"), costs_csv(batch.scenes).as_bytes())?;
    write_file(&folder.join("index.html"), page(batch).as_bytes())
}

/// A cell of a table in CSV; names have no quotes.
fn csv_cell(text: &str) -> String {
    if text.contains([',', '"', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

fn scores_csv(scenes: &[Scene]) -> String {
    let mut text = "capture,settings".to_owned();
    SCORES.iter().for_each(|(name, ..)| text += &format!(",{name}"));
    text.push('\n');
    for scene in scenes {
        text += &format!("{},{}", csv_cell(&scene.capture), csv_cell(&scene.settings));
        for (_, place, _) in SCORES {
            text.push(',');
            let _ = scene.score(place).map(|value| write!(text, "{value}"));
        }
        text.push('\n');
    }
    text
}

/// Names of phases in the order in which they first take time.
fn phases(scenes: &[Scene]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for (name, _) in scenes.iter().flat_map(Scene::phases) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

fn costs_csv(scenes: &[Scene]) -> String {
    let phases = phases(scenes);
    let mut text = "capture,settings,gaussians,processor s,peak MB".to_owned();
    phases.iter().for_each(|name| text += &format!(",training {} s", csv_cell(name)));
    text.push('\n');
    for scene in scenes {
        let gaussians = scene.training.pointer("/gaussians").and_then(Value::as_u64);
        let gaussians = gaussians.map_or_else(String::new, |count| count.to_string());
        let (capture, settings) = (csv_cell(&scene.capture), csv_cell(&scene.settings));
        let peak = scene.peak_bytes as f64 / 1e6;
        text += &format!("{capture},{settings},{gaussians},{:.2},{peak:.1}", scene.cpu_s);
        let spent: BTreeMap<String, f64> = scene.phases().into_iter().collect();
        for name in &phases {
            text.push(',');
            let _ = spent.get(name).map(|seconds| write!(text, "{seconds:.2}"));
        }
        text.push('\n');
    }
    text
}

fn page(batch: &Batch<'_>) -> String {
    let (scenes, undone) = (batch.scenes, batch.undone);
    let failed = undone.iter().filter(|job| job.error.is_some()).count();
    let description = format!(
        "{} scenes by {} jobs: {failed} failed, {} not run.",
        scenes.len(),
        batch.jobs,
        undone.len() - failed
    );
    let mut page = open(&Header {
        title: batch.name,
        heading: batch.name,
        description: &description,
        how: "Times are those of processors, all threads together.".to_owned(),
        command: batch.command,
        missing: (!undone.is_empty()).then(|| {
            "Some jobs are not done; they are listed below, and the same command runs them.".to_owned()
        }),
    });
    page += "</header>\n<main>\n";
    if !undone.is_empty() {
        add_undone(&mut page, undone);
    }
    if !batch.benches.is_empty() {
        page += "<section>\n<h2>Benches</h2>\n<ul>\n";
        for bench in batch.benches {
            let _ = writeln!(page, "<li>{}</li>", link(bench));
        }
        page += "</ul>\n</section>\n";
    }
    add_means(&mut page, scenes);
    add_scenes(&mut page, scenes);
    add_times(&mut page, scenes);
    add_pictures(&mut page, scenes);
    close(
        &mut page,
        "Scores are of the held-out frames, as by cif eval. scores.csv and costs.csv hold the same numbers.",
    );
    page
}

/// A link to a file next to the page.
fn link(path: &Path) -> String {
    let text = escape(&path.display().to_string());
    format!("<a href=\"{}\">{text}</a>", address(path))
}

/// The address of a file next to the page.
fn address(path: &Path) -> String {
    let text = path.display().to_string().replace('\\', "/");
    // A name that ends in a colon would be a scheme.
    escape(&format!(
        "./{}",
        text.replace('%', "%25").replace('#', "%23").replace('?', "%3F").replace(' ', "%20")
    ))
}

fn add_undone(page: &mut String, undone: &[Undone]) {
    *page += "<section>\n<h2>Jobs that are not done</h2>\n";
    let rows = undone.iter().map(|job| {
        let why = job.error.as_deref().map_or_else(|| "not run".to_owned(), escape);
        let log = if job.error.is_some() { link(&job.log) } else { String::new() };
        ("", vec![escape(&job.job), format!("<code>{why}</code>"), log])
    });
    page::table(page, ["job", "why", "log"], rows);
    *page += "</section>\n";
}

/// Means over captures and seeds of the same settings.
fn add_means(page: &mut String, scenes: &[Scene]) {
    let mut groups: BTreeMap<String, Vec<&Scene>> = BTreeMap::new();
    for scene in scenes.iter().filter(|scene| !scene.scores.is_null()) {
        groups.entry(scene.without_seed()).or_default().push(scene);
    }
    if groups.is_empty() {
        return;
    }
    *page += "<section>\n<h2>Settings</h2>\n<p class=\"how\">Means over captures and seeds, and the standard deviation over \
              seeds of one capture, in the mean over captures.</p>\n";
    let headings = ["settings", "scenes"]
        .into_iter()
        .chain(SCORES.iter().map(|(name, ..)| *name))
        .chain(["processor s"]);
    let rows = groups.iter().map(|(name, scenes)| {
        let mut cells = vec![escape(name), scenes.len().to_string()];
        for (_, place, digits) in SCORES {
            let of = |scene: &&Scene| scene.score(place);
            cells.push(with_spread(scenes, &of, digits));
        }
        cells.push(with_spread(scenes, &|scene| Some(scene.cpu_s), 1));
        ("", cells)
    });
    page::table(page, headings, rows);
    *page += "</section>\n";
}

/// The mean over captures of the means over their seeds, and behind `±` the mean of the deviations between seeds.
fn with_spread(scenes: &[&Scene], of: &dyn Fn(&&Scene) -> Option<f64>, digits: usize) -> String {
    let mut captures: BTreeMap<&str, Vec<Option<f64>>> = BTreeMap::new();
    for scene in scenes {
        captures.entry(&scene.capture).or_default().push(of(scene));
    }
    let captures: Vec<Mean> = captures.into_values().map(Mean::of).collect();
    let mean = Mean::of(captures.iter().map(|capture| capture.mean)).mean;
    Mean { mean, spread: Mean::of(captures.iter().map(|capture| capture.spread)).mean }.text(digits)
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "n/a".to_owned(), |value| format!("{value:.digits$}"))
}

fn add_scenes(page: &mut String, scenes: &[Scene]) {
    *page += "<section>\n<h2>Scenes</h2>\n";
    let headings = ["capture", "settings"]
        .into_iter()
        .chain(SCORES.iter().map(|(name, ..)| *name))
        .chain(["Gaussians", "files"]);
    let rows = scenes.iter().map(|scene| {
        let mut cells = vec![escape(&scene.capture), escape(&scene.settings)];
        cells.extend(SCORES.iter().map(|(_, place, digits)| number(scene.score(place), *digits)));
        let gaussians = scene.training.pointer("/gaussians").and_then(Value::as_u64);
        cells.push(gaussians.map_or_else(|| "n/a".to_owned(), |count| count.to_string()));
        cells.push(scene.files.iter().map(|file| link_by_name(file)).collect::<Vec<_>>().join(" "));
        ("", cells)
    });
    page::table(page, headings, rows);
    *page += "</section>\n";
}

/// A link to a file that shows its name alone.
fn link_by_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    format!("<a href=\"{}\">{}</a>", address(path), escape(&name))
}

fn add_times(page: &mut String, scenes: &[Scene]) {
    let phases = phases(scenes);
    *page += "<section>\n<h2>Time and memory</h2>\n<p class=\"how\">Processor seconds of training by phase, of all jobs of a scene \
              together, and the largest memory of any of them.</p>\n";
    let names: Vec<String> = phases.iter().map(|name| escape(name)).collect();
    let headings = ["capture", "settings"]
        .into_iter()
        .chain(names.iter().map(String::as_str))
        .chain(["all jobs s", "MB"]);
    let rows = scenes.iter().map(|scene| {
        let spent: BTreeMap<String, f64> = scene.phases().into_iter().collect();
        let mut cells = vec![escape(&scene.capture), escape(&scene.settings)];
        cells.extend(phases.iter().map(|name| number(spent.get(name).copied(), 1)));
        cells.extend([format!("{:.1}", scene.cpu_s), format!("{:.0}", scene.peak_bytes as f64 / 1e6)]);
        ("", cells)
    });
    page::table(page, headings, rows);
    *page += "</section>\n";
}

fn add_pictures(page: &mut String, scenes: &[Scene]) {
    let shown: Vec<(&Scene, &PathBuf)> =
        scenes.iter().filter_map(|scene| Some((scene, scene.picture.as_ref()?))).collect();
    if shown.is_empty() {
        return;
    }
    *page += "<section>\n<h2>Pictures</h2>\n<p class=\"how\">A held-out frame of each scene: truth, render, instances, error and \
              depth. All frames are in its folder.</p>\n";
    for (scene, picture) in shown {
        let caption = escape(&format!("{}, {}", scene.capture, scene.settings));
        let source = address(picture);
        let _ = writeln!(
            page,
            "<figure><a href=\"{source}\"><img loading=\"lazy\" style=\"max-width: 100%\" alt=\"{caption}\" src=\"{source}\"></a>\
             <figcaption>{caption}</figcaption></figure>"
        );
    }
    *page += "</section>\n";
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn scene(capture: &str, settings: &str, psnr: f64) -> Scene {
        Scene {
            capture: capture.to_owned(),
            settings: settings.to_owned(),
            scores: json!({ "psnr": psnr, "panoptic": { "iou": 90.0 } }),
            training: json!({ "gaussians": 7, "run": { "cpu_s_by_phase": { "fine": 3.0, "coarse": 1.5 } } }),
            cpu_s: 5.0,
            peak_bytes: 2_000_000,
            ..Scene::default()
        }
    }

    #[test]
    fn means_are_over_captures_and_spreads_over_seeds() {
        let scenes = [
            scene("a", "draft.seed0", 30.0),
            scene("a", "draft.seed1", 32.0),
            scene("b", "draft.seed0", 20.0),
        ];
        let all: Vec<&Scene> = scenes.iter().collect();
        let of = |scene: &&Scene| scene.score("/psnr");
        assert_eq!(with_spread(&all, &of, 2), "25.50 ± 1.41");
        assert_eq!(scenes[0].without_seed(), "draft");
        assert_eq!(scene("a", "seed3", 1.0).without_seed(), "run");
    }

    #[test]
    fn tables_and_page_hold_what_there_is() {
        let folder = tempfile::tempdir().unwrap();
        let mut scenes = vec![
            scene("<a>", "draft", 30.25),
            Scene { capture: "b".to_owned(), settings: "draft".to_owned(), ..Scene::default() },
        ];
        scenes[0].picture = Some("scenes/<a>/draft/pictures/0 1#.png".into());
        let undone = [Undone {
            job: "train/b/draft".to_owned(),
            error: Some("b.png: damaged".to_owned()),
            log: "jobs/train/b/draft.log".into(),
        }];
        let batch = Batch {
            name: "plan",
            command: "cif batch plan.toml",
            jobs: 5,
            scenes: &scenes,
            undone: &undone,
            benches: &[],
        };
        write(folder.path(), &batch).unwrap();
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        assert_eq!(
            read("scores.csv"),
            "capture,settings,PSNR dB,SSIM,PQ %,IoU %,mAcc-pix %,mAcc-inst %,mIoU %\n<a>,draft,30.25,,,90,,,\nb,draft,,,,,,,\n"
        );
        assert_eq!(read("costs.csv").lines().nth(1), Some("<a>,draft,7,5.00,2.0,1.50,3.00"));
        let page = read("index.html");
        for part in
            ["b.png: damaged", "&lt;a&gt;", "0%201%23.png", "jobs/train/b/draft.log", "1 failed, 0 not run"]
        {
            assert!(page.contains(part), "{part}");
        }
        assert!(!page.contains("<a>,"), "names are escaped");
    }
}
