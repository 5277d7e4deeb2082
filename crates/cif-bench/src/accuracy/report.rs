//! The report: a page that needs nothing else, JSON, and a table for spreadsheets.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::ser::Error as _;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use super::ladders::{BASE, Ladder, Rung, Work};
use super::pareto::{Climb, amount, front, sentence};
use super::record::Record;
use crate::error::{Error, write_file};
use crate::page::{self, Header, escape, picture};
use crate::plots::{Plot, Series, svg};
use crate::records::Records;

/// Subject of a report: capture, command and processor.
#[derive(Clone, Debug)]
pub struct Subject {
    /// Name of the capture.
    pub capture: String,
    /// One line on it.
    pub description: String,
    /// Command that made the report.
    pub command: String,
    /// Threads used.
    pub threads: usize,
    /// Vector instructions used.
    pub simd: String,
    /// Rungs that are not measured yet.
    pub missing: usize,
    /// Motion of the objects of the base; `None` where nothing moves or the base is not there.
    pub motion: Option<Motion>,
}

/// Motion of the objects of a scene.
#[derive(Clone, Debug, Default)]
pub struct Motion {
    /// Scores against known motion, JSON; null where it is not known.
    pub scores: Value,
    /// Headings of their table.
    pub headings: Vec<&'static str>,
    /// Rows of their table.
    pub rows: Vec<Vec<String>>,
    /// Picture of the paths of the objects, where any moves.
    pub picture: Option<PathBuf>,
}

/// Ladders with what was measured of their rungs, in their order.
pub type Measured = Vec<(Ladder, Vec<Option<Record>>)>;

/// Which columns a ladder has, and along which cost it is climbed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Train,
    Bytes,
    Frame,
    Export,
}

fn kind(ladder: &Ladder) -> Kind {
    match ladder.rungs.first().map(|rung| &rung.work) {
        Some(Work::Store { .. }) => Kind::Bytes,
        Some(Work::Render { .. } | Work::Reference { .. }) => Kind::Frame,
        Some(Work::Export(_)) => Kind::Export,
        _ => Kind::Train,
    }
}

fn cost(kind: Kind, record: &Record) -> (f64, &'static str) {
    match kind {
        Kind::Bytes | Kind::Export => (record.bytes.unwrap_or(0) as f64, "B"),
        Kind::Train | Kind::Frame => (record.cpu_s, "s"),
    }
}

/// A rung as all outputs see it.
struct Row<'a> {
    ladder: &'a Ladder,
    id: &'a str,
    label: &'a str,
    record: &'a Record,
    /// On the front of PSNR, of IoU.
    front: [bool; 2],
    /// Cost and gain against the rung below, in words; `None` for the lowest.
    climb: Option<String>,
}

fn rows(measured: &Measured) -> Vec<Row<'_>> {
    let mut rows = Vec::new();
    for (ladder, records) in measured {
        let present: Vec<(&str, &str, &Record)> = ladder
            .rungs
            .iter()
            .zip(records)
            .filter_map(|(rung, record)| Some((rung.id.as_str(), rung.label.as_str(), record.as_ref()?)))
            .collect();
        for (k, (id, label, record)) in present.iter().copied().enumerate() {
            let climb = k.checked_sub(1).map(|below| {
                let (_, from, lower) = present[below];
                let (cost_now, unit) = cost(kind(ladder), record);
                let (cost_below, _) = cost(kind(ladder), lower);
                let gain = |a: Option<f64>, b: Option<f64>| Some(a? - b?);
                let climb = Climb {
                    cost: cost_now - cost_below,
                    psnr: gain(record.psnr, lower.psnr),
                    iou: gain(record.iou, lower.iou),
                };
                let mut text = sentence(from, label, &climb, unit);
                if kind(ladder) == Kind::Export
                    && let (Some(now), Some(before)) = (record.residual, lower.residual)
                {
                    text = text.trim_end_matches('.').to_owned()
                        + &format!("; the residual goes from {before:.5} to {now:.5}.");
                }
                text
            });
            rows.push(Row { ladder, id, label, record, front: [false; 2], climb });
        }
    }
    mark_fronts(&mut rows);
    rows
}

/// Marks the fronts of everything that was trained, each scene counted once.
fn mark_fronts(rows: &mut [Row<'_>]) {
    let trained: Vec<usize> = (0..rows.len()).filter(|row| kind(rows[*row].ladder) == Kind::Train).collect();
    let values: [fn(&Record) -> Option<f64>; 2] = [|record| record.psnr, |record| record.iou];
    for (which, value) in values.iter().enumerate() {
        let points: Vec<(f64, Option<f64>)> =
            trained.iter().map(|row| (rows[*row].record.cpu_s, value(rows[*row].record))).collect();
        for (row, on_front) in trained.iter().zip(front(&points)) {
            rows[*row].front[which] = on_front;
        }
    }
}

/// Writes `report.html`, `report.json`, `rungs.csv` and the plots.
///
/// # Errors
/// When a file cannot be written or a picture not be read.
pub fn write(
    folder: &Path,
    rungs: &Records<Record>,
    subject: &Subject,
    measured: &Measured,
) -> Result<(), Error> {
    let rows = rows(measured);
    let plots = plots(measured, &rows);
    for (name, _, text) in &plots {
        write_file(&folder.join(format!("{name}.svg")), text.as_bytes())?;
    }
    write_file(&folder.join("report.json"), format!("{:#}\n", json!(report_of(subject, &rows))).as_bytes())?;
    write_file(&folder.join("rungs.csv"), csv(&rows).as_bytes())?;
    let page = page(rungs, subject, measured, &rows, &plots)?;
    write_file(&folder.join("report.html"), page.as_bytes())
}

/// Ladders of accuracy.
#[derive(Serialize)]
pub struct AccuracyReport<'a> {
    /// Name of the capture.
    capture: &'a str,
    /// One line on it.
    description: &'a str,
    /// Command that made the report.
    command: &'a str,
    /// Threads.
    threads: usize,
    /// Vector instructions.
    simd: &'a str,
    /// Rungs that are not measured yet.
    rungs_missing: usize,
    /// Motion of the objects of the base, as `motion` of `cif eval`; null where it is not known.
    motion: Option<&'a Value>,
    /// Every rung that was measured.
    rungs: Vec<RungReport<'a>>,
}

/// A rung.
#[derive(Serialize)]
struct RungReport<'a> {
    #[serde(flatten, serialize_with = "without_bookkeeping")]
    record: &'a Record,
    /// Name of the ladder.
    ladder: &'a str,
    /// Name of the rung.
    rung: &'a str,
    /// Name of its files.
    id: &'a str,
    /// True where nothing measured costs less and has a higher PSNR.
    front_psnr: bool,
    /// True where nothing measured costs less and has a higher IoU.
    front_iou: bool,
    /// Cost and gain against the rung below, in words; null for the lowest.
    climb: Option<&'a str>,
}

/// A record without the fields that only its own file needs.
fn without_bookkeeping<S: Serializer>(record: &&Record, serializer: S) -> Result<S::Ok, S::Error> {
    let mut value = serde_json::to_value(record).map_err(S::Error::custom)?;
    if let Some(table) = value.as_object_mut() {
        table.remove("fingerprint");
        table.remove("pictures");
    }
    value.serialize(serializer)
}

fn report_of<'a>(subject: &'a Subject, rows: &'a [Row<'_>]) -> AccuracyReport<'a> {
    let rung = |row: &'a Row<'_>| RungReport {
        record: row.record,
        ladder: row.ladder.name,
        rung: row.label,
        id: row.id,
        front_psnr: row.front[0],
        front_iou: row.front[1],
        climb: row.climb.as_deref(),
    };
    AccuracyReport {
        capture: &subject.capture,
        description: &subject.description,
        command: &subject.command,
        threads: subject.threads,
        simd: &subject.simd,
        rungs_missing: subject.missing,
        motion: subject.motion.as_ref().map(|motion| &motion.scores),
        rungs: rows.iter().map(rung).collect(),
    }
}

fn csv(rows: &[Row<'_>]) -> String {
    let mut text = String::from(
        "ladder,rung,cpu_s,wall_s,psnr_db,ssim,panoptic_percent,iou_percent,miou_percent,gaussians,bytes,residual,psnr_to_exact_db,render_ms,\
         front_psnr,front_iou\n",
    );
    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    for row in rows {
        let record = row.record;
        let quoted = format!("\"{}\"", row.label.replace('"', "\"\""));
        let _ = writeln!(
            text,
            "{},{quoted},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            row.ladder.name,
            record.cpu_s,
            record.wall_s,
            number(record.psnr),
            number(record.ssim),
            number(record.panoptic),
            number(record.iou),
            number(record.miou),
            number(record.gaussians.map(|count| count as f64)),
            number(record.bytes.map(|count| count as f64)),
            number(record.residual),
            number(record.psnr_to_exact),
            number(record.render_ms),
            row.front[0],
            row.front[1],
        );
    }
    text
}

/// Value of a record that a plot shows.
type Plotted = fn(&Record) -> Option<f64>;

/// File name, caption and SVG of every plot; the overviews first.
fn plots(measured: &Measured, rows: &[Row<'_>]) -> Vec<(String, String, String)> {
    let overviews: [(&str, &str, Plotted, usize); 2] = [
        ("psnr", "PSNR of held-out frames, dB", |record| record.psnr, 0),
        ("iou", "IoU of held-out frames over the whole image, %", |record| record.iou, 1),
    ];
    let overviews = overviews.into_iter().filter_map(|(name, axis, value, which)| {
        let caption = format!(
            "Every trained rung: {axis}, against processor time. The dashed line joins what nothing else beats; \
             its rungs are named."
        );
        Some((format!("overview-{name}"), caption, svg(&overview(measured, rows, axis, value, which))?))
    });
    let of_ladders = measured.iter().filter_map(|(ladder, records)| {
        let records: Vec<(&Rung, &Record)> =
            ladder.rungs.iter().zip(records).filter_map(|(rung, r)| Some((rung, r.as_ref()?))).collect();
        let (caption, plot) = match kind(ladder) {
            Kind::Train => {
                let caption = "Quality while training went on, each rung measured on a few held-out frames.";
                (caption, curves(&records))
            }
            kind => ("What accuracy costs here.", costs(ladder, kind, &records)),
        };
        Some((format!("ladder-{}", ladder.name), caption.to_owned(), svg(&plot)?))
    });
    overviews.chain(of_ladders).collect()
}

/// A value of every trained rung against processor time, with the front of the best; `which` is the column of fronts.
fn overview<'a>(
    measured: &Measured,
    rows: &[Row<'_>],
    axis: &'a str,
    value: Plotted,
    which: usize,
) -> Plot<'a> {
    let series: Vec<Series> = measured
        .iter()
        .filter(|(ladder, _)| kind(ladder) == Kind::Train)
        .map(|(ladder, _)| Series {
            name: ladder.title.to_owned(),
            points: rows
                .iter()
                .filter(|row| row.ladder.name == ladder.name)
                .filter_map(|row| {
                    // The base is in most ladders; it is named once.
                    let named = row.front[which] && (row.id != BASE || ladder.name == "iterations");
                    let name = if named { row.label.to_owned() } else { String::new() };
                    Some((row.record.cpu_s, value(row.record)?, name))
                })
                .collect(),
            line: false,
        })
        .filter(|series| !series.points.is_empty())
        .collect();
    let mut front: Vec<(f64, f64)> = rows
        .iter()
        .filter(|row| row.front[which])
        .filter_map(|row| Some((row.record.cpu_s, value(row.record)?)))
        .collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    front.dedup();
    Plot {
        axes: ["processor time of training, s (all threads together)", axis],
        log: true,
        series,
        front,
        size: (900, 470),
    }
}

/// The curves of trained rungs.
fn curves(records: &[(&Rung, &Record)]) -> Plot<'static> {
    let series = records
        .iter()
        .filter_map(|(rung, record)| {
            let curve = record.curve.as_ref()?;
            let points = curve.points.iter();
            let points = points.filter_map(|p| Some((p.cpu_s, p.psnr?, String::new()))).collect();
            Some(Series { name: rung.label.clone(), points, line: true })
        })
        .collect();
    Plot {
        axes: ["processor time, s", "PSNR of the curve's frames, dB"],
        log: false,
        series,
        front: Vec::new(),
        size: (640, 340),
    }
}

/// Accuracy against cost of rungs that nothing is trained for.
fn costs(ladder: &Ladder, kind: Kind, records: &[(&Rung, &Record)]) -> Plot<'static> {
    let (axes, value): ([&str; 2], Plotted) = match kind {
        Kind::Export => (["size of the file, kB", "largest residual, world units"], |record| record.residual),
        Kind::Bytes => (["size of the parameters, kB", "PSNR of held-out frames, dB"], |r| r.psnr),
        _ => (["processor time of a frame, ms", "PSNR of held-out frames, dB"], |record| record.psnr),
    };
    // Both bytes and seconds are shown in thousands or thousandths.
    let scale = if kind == Kind::Frame { 1e3 } else { 1e-3 };
    let points = records
        .iter()
        .filter_map(|(rung, record)| Some((scale * cost(kind, record).0, value(record)?, rung.label.clone())))
        .collect();
    let series = vec![Series { name: ladder.title.to_owned(), points, line: false }];
    Plot { axes, log: kind == Kind::Frame, series, front: Vec::new(), size: (640, 300) }
}

fn page(
    rungs: &Records<Record>,
    subject: &Subject,
    measured: &Measured,
    rows: &[Row<'_>],
    plots: &[(String, String, String)],
) -> Result<String, Error> {
    let title = format!("What accuracy costs: {}", subject.capture);
    let mut page = page::open(&Header {
        title: &title,
        heading: &title,
        description: &subject.description,
        how: page::measured_on(subject.threads, &subject.simd),
        command: &subject.command,
        missing: (subject.missing > 0).then(|| {
            format!("{} rungs are not measured yet; run the same command again for them.", subject.missing)
        }),
    });
    page += "<nav>";
    for (ladder, records) in measured.iter().filter(|(_, records)| records.iter().any(Option::is_some)) {
        debug_assert_eq!(ladder.rungs.len(), records.len());
        let _ = write!(page, "<a href=\"#{}\">{}</a>", ladder.name, escape(ladder.title));
    }
    if subject.motion.is_some() {
        page += "<a href=\"#motion\">Motion of objects</a>";
    }
    page += "</nav>\n</header>\n<main>\n";
    page += SUMMARY_OPEN;
    for line in summary(rows) {
        let _ = writeln!(page, "<li>{}</li>", escape(&line));
    }
    page += "</ul>\n";
    figures(&mut page, plots, "overview-");
    page += "</section>\n";
    for (ladder, records) in measured {
        let of_ladder: Vec<&Row<'_>> = rows.iter().filter(|row| row.ladder.name == ladder.name).collect();
        if of_ladder.is_empty() {
            continue;
        }
        let _ = write!(
            page,
            "<section id=\"{}\">\n<h2>{}</h2>\n<p>{}</p>\n",
            ladder.name,
            escape(ladder.title),
            escape(ladder.about)
        );
        table(&mut page, kind(ladder), &of_ladder);
        page += "<ul class=\"climbs\">\n";
        for climb in of_ladder.iter().filter_map(|row| row.climb.as_ref()) {
            let _ = writeln!(page, "<li>{}</li>", escape(climb));
        }
        page += "</ul>\n<div class=\"beside\">\n";
        figures(&mut page, plots, &format!("ladder-{}", ladder.name));
        page += "</div>\n";
        pictures(&mut page, rungs, &of_ladder)?;
        page += "</section>\n";
        debug_assert!(records.len() >= of_ladder.len());
    }
    if let Some(motion) = &subject.motion {
        motion_section(&mut page, motion)?;
    }
    page::close(
        &mut page,
        "PSNR and SSIM are means over the held-out frames; PQ is panoptic quality \
         and IoU over pairs of instance and frame, both over the whole image; mIoU is IoU over labelled pixels, as papers \
         count it. Processor time counts \
         all threads together and everything from the decoding of frames on, fits of objects too, but no measuring. Filled dots mark the fronts: no other trained rung is both cheaper and \
         better.",
    );
    Ok(page)
}

/// Scores of the motion of objects, and a picture of their paths.
fn motion_section(page: &mut String, motion: &Motion) -> Result<(), Error> {
    page.push_str("<section id=\"motion\">\n<h2>Motion of objects</h2>\n");
    if !motion.rows.is_empty() {
        page.push_str(
            "<p>Of the base as it is exported by default, against the followed surface points of the capture: mean \
             distance from the true points, the same had nothing moved, and shares of points within a distance.</p>\n",
        );
        let headings: Vec<String> = motion.headings.iter().map(|heading| escape(heading)).collect();
        let rows = motion.rows.iter().map(|row| ("", row.iter().map(|cell| escape(cell)).collect()));
        page::table(page, headings.iter().map(String::as_str), rows);
    }
    if let Some(path) = &motion.picture {
        page.push_str("<div class=\"pictures\">\n");
        picture(page, path, "paths of the objects of the base, fainter after the shown time")?;
        page.push_str("</div>\n");
    }
    page.push_str("</section>\n");
    Ok(())
}

const SUMMARY_OPEN: &str = "<section id=\"summary\">\n<h2>In short</h2>\n<ul class=\"climbs\">\n";

/// The front from cheap to dear, in sentences.
fn summary(rows: &[Row<'_>]) -> Vec<String> {
    let mut lines = Vec::new();
    let values: [(&str, &str, Plotted); 2] =
        [("PSNR", "dB", |record| record.psnr), ("IoU", "%", |record| record.iou)];
    for (which, (name, unit, value)) in values.into_iter().enumerate() {
        let mut on_front: Vec<&Row<'_>> = rows.iter().filter(|row| row.front[which]).collect();
        on_front.sort_by(|a, b| a.record.cpu_s.total_cmp(&b.record.cpu_s));
        on_front.dedup_by(|a, b| a.id == b.id);
        let describe = |row: &&Row<'_>| {
            let value = value(row.record).unwrap_or(f64::NAN);
            let what = match row.id {
                BASE => "the base".to_owned(),
                _ => format!("{}: {}", row.ladder.title.to_lowercase(), row.label),
            };
            format!("{value:.2} {unit} in {} ({what})", amount(row.record.cpu_s, "s"))
        };
        if !on_front.is_empty() {
            let steps: Vec<String> = on_front.iter().map(describe).collect();
            lines.push(format!("{name}, best for its time: {}.", steps.join("; ")));
        }
    }
    lines
}

fn figures(page: &mut String, plots: &[(String, String, String)], prefix: &str) {
    for (name, caption, text) in plots.iter().filter(|(name, ..)| name.starts_with(prefix)) {
        let whole = name == prefix || prefix.ends_with('-');
        if whole {
            page::figure(page, text, caption);
        }
    }
}

fn table(page: &mut String, kind: Kind, rows: &[&Row<'_>]) {
    let number =
        |value: Option<f64>, digits: usize| value.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
    type Cell = Box<dyn Fn(&Row<'_>) -> String>;
    let mark = |on: bool| if on { " ●" } else { "" };
    let mut columns: Vec<(&str, Cell)> = vec![("", Box::new(|row| escape(row.label)))];
    match kind {
        Kind::Train => {
            columns.push(("processor time, s", Box::new(|row| format!("{:.1}", row.record.cpu_s))));
            columns.push(("wall time, s", Box::new(|row| format!("{:.1}", row.record.wall_s))));
            columns.push(("PSNR, dB", Box::new(move |row| number(row.record.psnr, 2) + mark(row.front[0]))));
            columns.push(("SSIM", Box::new(move |row| number(row.record.ssim, 4))));
            columns.push(("PQ, %", Box::new(move |row| number(row.record.panoptic, 1))));
            columns.push(("IoU, %", Box::new(move |row| number(row.record.iou, 1) + mark(row.front[1]))));
            columns.push(("mIoU, %", Box::new(move |row| number(row.record.miou, 1))));
            columns.push((
                "Gaussians",
                Box::new(|row| row.record.gaussians.map_or("–".into(), |n| n.to_string())),
            ));
            columns.push((
                "parameters, MB",
                Box::new(move |row| number(row.record.bytes.map(|b| b as f64 / 1e6), 2)),
            ));
            columns.push(("a frame, ms", Box::new(move |row| number(row.record.render_ms, 1))));
            columns.push((
                "settings over the base",
                Box::new(|row| {
                    let settings = row.record.settings.iter().map(|s| escape(s));
                    settings.map(|setting| format!("<code>{setting}</code>")).collect::<Vec<_>>().join(" ")
                }),
            ));
        }
        Kind::Bytes => {
            columns.push((
                "parameters, MB",
                Box::new(move |row| number(row.record.bytes.map(|b| b as f64 / 1e6), 3)),
            ));
            columns.push(("PSNR, dB", Box::new(move |row| number(row.record.psnr, 3))));
            columns.push(("SSIM", Box::new(move |row| number(row.record.ssim, 4))));
            columns.push(("IoU, %", Box::new(move |row| number(row.record.iou, 2))));
        }
        Kind::Frame => {
            columns.push(("processor time, ms", Box::new(|row| format!("{:.2}", 1e3 * row.record.cpu_s))));
            columns.push(("wall time, ms", Box::new(|row| format!("{:.2}", 1e3 * row.record.wall_s))));
            columns.push(("PSNR, dB", Box::new(move |row| number(row.record.psnr, 3))));
            columns.push((
                "PSNR to the exact picture, dB",
                Box::new(move |row| number(row.record.psnr_to_exact, 1)),
            ));
            columns.push((
                "largest difference of a colour",
                Box::new(|row| {
                    row.record.residual.map_or("–".into(), |value| {
                        if value == 0.0 { "0".into() } else { format!("{value:.1e}") }
                    })
                }),
            ));
            columns.push((
                "Gaussians",
                Box::new(|row| row.record.gaussians.map_or("–".into(), |n| n.to_string())),
            ));
        }
        Kind::Export => {
            columns
                .push(("file, kB", Box::new(move |row| number(row.record.bytes.map(|b| b as f64 / 1e3), 1))));
            columns.push(("wall time, s", Box::new(|row| format!("{:.2}", row.record.wall_s))));
            columns
                .push(("largest residual, world units", Box::new(move |row| number(row.record.residual, 5))));
        }
    }
    let tag = |row: &&&Row<'_>| if row.id == BASE { " class=\"base\"" } else { "" };
    let cells = |row: &&Row<'_>| columns.iter().map(|(_, cell)| cell(row)).collect();
    let headings = columns.iter().map(|(name, _)| *name);
    page::table(page, headings, rows.iter().map(|row| (tag(&row), cells(row))));
}

/// The same frame of every rung that has pictures, the captured one first.
fn pictures(page: &mut String, rungs: &Records<Record>, rows: &[&Row<'_>]) -> Result<(), Error> {
    if rows.iter().all(|row| row.record.pictures.is_empty()) {
        return Ok(());
    }
    page.push_str("<div class=\"pictures\">\n");
    let truth = rungs.file("truth.png");
    if truth.is_file() {
        picture(page, &truth, "captured")?;
    }
    for row in rows {
        for name in &row.record.pictures {
            let what = if name.ends_with(".instances.png") { ", instances" } else { "" };
            picture(page, &rungs.file(name), &format!("{}{what}", row.label))?;
        }
    }
    page.push_str("</div>\n");
    Ok(())
}

#[cfg(test)]
mod tests {
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;

    use super::super::ladders::{Base, ladders};
    use super::*;

    fn measured() -> Measured {
        let base = Base {
            quick: true,
            steps: [60, 600, 200],
            until: [400, 160],
            gaussians: 3_000,
            points: 1_500,
            nodes: 32,
            width: 64,
            sh_degree: 3,
            downscale: 1,
            is_dynamic: true,
            has_instances: true,
            instances_move_geometry: false,
            paper: None,
        };
        let record = |k: usize| Record {
            cpu_s: 1.0 + k as f64,
            wall_s: 1.0,
            psnr: Some(20.0 + (k as f64).sqrt()),
            iou: Some(60.0 + k as f64),
            bytes: Some(1_000 * (k as u64 + 1)),
            residual: Some(0.1 / (k + 1) as f64),
            ..Record::default()
        };
        ladders(&base)
            .into_iter()
            .map(|ladder| {
                let records =
                    (0..ladder.rungs.len()).map(|k| (k != 1 || ladder.rungs.len() > 2).then(|| record(k)));
                let records = records.collect();
                (ladder, records)
            })
            .collect()
    }

    #[test]
    fn a_report_is_whole_without_a_network() {
        let folder = tempfile::tempdir().unwrap();
        let rungs = Records::inside(folder.path()).unwrap();
        let subject = Subject {
            capture: "table <1>".into(),
            description: "80 frames".into(),
            command: "cif bench accuracy table".into(),
            threads: 2,
            simd: "Avx2".into(),
            missing: 1,
            motion: Some(Motion {
                scores: json!({ "instances": [{ "id": 3 }] }),
                headings: vec!["instance", "< 10 mm"],
                rows: vec![vec!["red <mug>".into(), "97.5".into()]],
                picture: Some(rungs.file("paths.png")),
            }),
        };
        std::fs::write(rungs.file("paths.png"), b"paths").unwrap();
        let measured = measured();
        write(folder.path(), &rungs, &subject, &measured).unwrap();
        let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
        assert!(page.contains("What accuracy costs: table &lt;1&gt;"));
        for (ladder, _) in &measured {
            assert!(page.contains(&format!("<section id=\"{}\"", ladder.name)), "{}", ladder.name);
        }
        // The name space of SVG is no address that is loaded.
        let loaded = page.replace("http://www.w3.org/2000/svg", "");
        for outside in ["http:", "https:", "<script", "@import", "<link"] {
            assert!(!loaded.contains(outside), "{outside}");
        }
        assert!(page.contains("1 rungs are not measured yet") && page.contains("●"));
        for part in ["<section id=\"motion\"", "<th>&lt; 10 mm</th>", "<td>red &lt;mug&gt;</td><td>97.5</td>"]
        {
            assert!(page.contains(part), "{part}");
        }
        assert!(page.contains(&STANDARD.encode(b"paths")));
        let report: Value =
            serde_json::from_str(&std::fs::read_to_string(folder.path().join("report.json")).unwrap())
                .unwrap();
        assert_eq!(report["motion"]["instances"][0]["id"], 3);
        let rungs = report["rungs"].as_array().unwrap();
        let present: usize = measured.iter().flat_map(|(_, records)| records).flatten().count();
        assert_eq!(rungs.len(), present);
        assert!(rungs.iter().any(|rung| rung["climb"].as_str().is_some_and(|text| text.contains("per dB"))));
        let table = std::fs::read_to_string(folder.path().join("rungs.csv")).unwrap();
        assert_eq!(table.lines().count(), present + 1);
        assert!(folder.path().join("overview-psnr.svg").is_file());
        let still = Subject { motion: None, ..subject };
        write(folder.path(), &Records::<Record>::inside(folder.path()).unwrap(), &still, &measured).unwrap();
        let page = std::fs::read_to_string(folder.path().join("report.html")).unwrap();
        assert!(!page.contains("#motion"));
    }

    #[test]
    fn the_front_is_marked_only_among_what_was_trained() {
        let measured = measured();
        let rows = rows(&measured);
        assert!(rows.iter().any(|row| row.front[0] && row.front[1]));
        assert!(rows.iter().filter(|row| kind(row.ladder) != Kind::Train).all(|row| row.front == [false; 2]));
        let lines = summary(&rows);
        assert_eq!(lines.len(), 2);
        assert!(lines[0].starts_with("PSNR, best for its time: "), "{lines:?}");
    }
}
