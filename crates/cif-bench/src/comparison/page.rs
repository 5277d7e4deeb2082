//! The page of a comparison, and its tables as files.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use image::ImageReader;

use super::crops::Crop;
use super::queries::{PUBLISHED_HEADING, Queries, shown};
use super::record::Record;
use super::tables::{MEASURES, Missing, Subject, cells};
use super::title;
use crate::accuracy::measure::save;
use crate::error::{Error, write_file};
use crate::page::{self, Header, close, escape, open, picture, video};
use crate::plots::{Plot, Series, svg};
use crate::records::Records;

/// Subject of a page.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// A few lines on it.
    pub description: String,
    /// Command that made it.
    pub command: String,
    /// Threads used.
    pub threads: usize,
    /// Vector instructions used.
    pub simd: String,
    /// Runs that are not done yet.
    pub missing: Vec<Missing>,
    /// Videos, by capture.
    pub videos: Vec<Video>,
    /// Heads in the order of tables.
    pub heads: Vec<String>,
    /// True when ablations were asked for.
    pub ablations: bool,
    /// The only camera that SA4D trained on; empty for all.
    pub camera: String,
    /// Questions in words and their answers, where any were asked.
    pub queries: Option<Queries>,
    /// Colour of pixels without a label in pictures of labels.
    pub empty: [u8; 3],
}

/// A video of the runs of a capture.
#[derive(Clone, Debug)]
pub struct Video {
    /// Name of the capture.
    pub capture: String,
    /// MP4 file.
    pub file: PathBuf,
    /// Its parts, from left to right.
    pub parts: Vec<String>,
}

/// Numbers of the ablations, in the order of tables; the last is the whole method.
const ABLATIONS: [&str; 5] = ["i", "ii", "iii", "iv", "v"];

/// Writes the page `compare.html` and the tables `panoptic` and, where there are any, `ablation` and `queries`, each as
/// `.md`, `.csv`, `.json` and `.tex`.
///
/// # Errors
/// When a file cannot be written or a picture not be read.
pub fn write(
    folder: &Path,
    runs: &Records<Record>,
    comparison: &Comparison,
    records: &[Record],
) -> Result<(), Error> {
    let is_ablation = |record: &&Record| ABLATIONS.contains(&record.row.head.as_str());
    // Heads that only answer questions have no labels to be scored.
    let is_head = |record: &&Record| comparison.heads.contains(&record.row.head);
    let rows = |of: &dyn Fn(&&Record) -> bool| {
        records.iter().filter(of).map(|record| record.row.clone()).collect::<Vec<_>>()
    };
    let (panoptic, mut ablation) = (rows(&is_head), rows(&is_ablation));
    // The whole method is the row of its head.
    let whole = panoptic.iter().filter(|row| row.head == "cif").cloned();
    ablation.extend(whole.map(|row| super::record::Row { head: "v".to_owned(), ..row }));
    let ablations = ABLATIONS.map(str::to_owned);
    let missing = &comparison.missing;
    let of_heads = Subject {
        rows: &panoptic,
        names: &comparison.heads,
        camera: &comparison.camera,
        ablation: false,
        missing,
    };
    let of_parts = Subject { rows: &ablation, names: &ablations, camera: "", ablation: true, missing };
    let mut subjects = vec![("panoptic", &of_heads)];
    if comparison.ablations {
        subjects.push(("ablation", &of_parts));
    }
    for (name, subject) in &subjects {
        let texts = [subject.markdown(), subject.csv(), subject.json(), subject.latex()];
        write_forms(folder, name, texts)?;
    }
    if let Some(queries) = &comparison.queries {
        write_forms(folder, "queries", [queries.markdown(), queries.csv(), queries.json(), queries.latex()])?;
    }
    let page = page(runs, comparison, &subjects, records)?;
    write_file(&folder.join("compare.html"), page.as_bytes())
}

/// Writes a table as Markdown, CSV, JSON and LaTeX.
fn write_forms(folder: &Path, name: &str, texts: [String; 4]) -> Result<(), Error> {
    for (extension, text) in ["md", "csv", "json", "tex"].into_iter().zip(texts) {
        write_file(&folder.join(format!("{name}.{extension}")), text.as_bytes())?;
    }
    Ok(())
}

fn page(
    runs: &Records<Record>,
    comparison: &Comparison,
    subjects: &[(&str, &Subject<'_>)],
    records: &[Record],
) -> Result<String, Error> {
    let mut page = open(&Header {
        title: "Comparison",
        heading: "The method compared with others, on one reconstruction",
        description: &comparison.description,
        how: page::measured_on(comparison.threads, &comparison.simd),
        command: &comparison.command,
        missing: (!comparison.missing.is_empty()).then(|| {
            format!("{} runs are missing; run the same command again for them.", comparison.missing.len())
        }),
    });
    page += "</header>\n<main>\n";
    for (name, subject) in subjects {
        let heading = if subject.ablation { "Without parts of the method" } else { "Panoptic segmentation" };
        let _ = writeln!(page, "<section id=\"{name}\">\n<h2>{heading}</h2>");
        for table in subject.tables() {
            let _ = writeln!(page, "<h3>{}</h3>", escape(&table.caption));
            let published = escape(&subject.published_heading());
            let measures = MEASURES.iter().map(|measure| measure.name);
            let headings = std::iter::once("").chain(measures).chain([published.as_str()]);
            let rows = table.lines.iter().map(|line| {
                let measured = cells(line).into_iter().map(cell);
                let row = std::iter::once(escape(&line.title)).chain(measured);
                ("", row.chain([escape(&line.published)]).collect())
            });
            page::table(&mut page, headings, rows);
        }
        for note in subject.notes() {
            let _ = writeln!(page, "<p class=\"how\">{}</p>", escape(&note));
        }
        if let Some(plot) = costs(subject) {
            let caption = "Accuracy against what it costs in time; a dot per capture and seed.";
            page::figure(&mut page, &plot, caption);
        }
        page += "</section>\n";
    }
    if let Some(queries) = &comparison.queries {
        answers(&mut page, queries);
    }
    pictures(&mut page, runs, comparison, records)?;
    if !comparison.videos.is_empty() {
        page += "<section id=\"videos\">\n<h2>Along the held-out frames</h2>\n";
        for shown in &comparison.videos {
            let _ = writeln!(page, "<h3>{}</h3>", escape(&shown.capture));
            video(&mut page, &shown.file, &format!("From left to right: {}.", shown.parts.join(", ")))?;
        }
        page += "</section>\n";
    }
    close(
        &mut page,
        "Percent over the held-out frames. Over all pixels, what spills onto the background included: PQ, panoptic quality, \
         and IoU, per pair of instance and frame. Over labelled pixels alone, as the papers count: mAcc-pix per frame, \
         mAcc-inst per instance, mIoU per pair of instance and frame. Every row but Trace3D has the Gaussians of the same reconstruction, \
         the same masks and the same frames.",
    );
    Ok(page)
}

/// A cell of a table, and whether it is the best of its column.
fn cell((text, best): (String, bool)) -> String {
    if best { format!("<strong>{}</strong>", escape(&text)) } else { escape(&text) }
}

/// Questions in words, a table per capture.
fn answers(page: &mut String, queries: &Queries) {
    page.push_str("<section id=\"queries\">\n<h2>Questions in words</h2>\n");
    for table in queries.tables() {
        let _ = writeln!(page, "<h3>{}</h3>", escape(&table.caption));
        let escaped: Vec<String> = table.headings.iter().map(|heading| escape(heading)).collect();
        let headings = escaped.iter().map(String::as_str);
        let headings = ["", "by"].into_iter().chain(headings).chain([PUBLISHED_HEADING]);
        let rows = table.lines.iter().map(|line| {
            let row = [escape(&line.title), line.rule.name().to_owned()].into_iter();
            let row = row.chain(line.cells.iter().map(shown).map(cell));
            ("", row.chain([escape(&line.published)]).collect())
        });
        page::table(page, headings, rows);
    }
    for note in queries.notes() {
        let _ = writeln!(page, "<p class=\"how\">{}</p>", escape(&note));
    }
    page.push_str("</section>\n");
}

/// IoU over the whole image against processor time.
fn costs(subject: &Subject<'_>) -> Option<String> {
    let of = |name: &String| Series {
        name: title(name, subject.camera),
        points: subject
            .rows
            .iter()
            .filter(|row| row.head == *name)
            .filter_map(|row| Some((row.seconds.max(1e-2), row.iou?, String::new())))
            .collect(),
        line: false,
    };
    let series: Vec<Series> =
        subject.names.iter().map(of).filter(|series| !series.points.is_empty()).collect();
    svg(&Plot {
        axes: [
            "processor time on top of the reconstruction, s",
            "IoU of held-out frames over the whole image, %",
        ],
        log: true,
        series,
        front: Vec::new(),
        size: (900, 420),
    })
}

/// A picture of the folder of runs.
fn read(path: &Path) -> Result<PixelGrid<[u8; 3]>, Error> {
    let failed = |error: &dyn std::fmt::Display| Error::plain(format!("{}: {error}", path.display()));
    let reader = ImageReader::open(path).map_err(Error::io("read", path))?;
    let image = reader.decode().map_err(|error| failed(&error))?.into_rgb8();
    let pixels = image.pixels().map(|pixel| pixel.0).collect();
    Ok(PixelGrid::from_pixels(image.width(), image.height(), pixels))
}

/// Per capture, the captured frame, its true labels and those of every run of the first seed; below them the part of it
/// in which they differ most.
fn pictures(
    page: &mut String,
    runs: &Records<Record>,
    comparison: &Comparison,
    records: &[Record],
) -> Result<(), Error> {
    let mut captures: Vec<(&str, u64)> = Vec::new();
    for row in records.iter().map(|record| &record.row) {
        if captures.iter().all(|(capture, _)| *capture != row.capture) {
            captures.push((&row.capture, row.seed));
        }
    }
    page.push_str("<section id=\"pictures\">\n<h2>One held-out frame</h2>\n");
    page.push_str(
        "<p class=\"how\">CIF draws no label where a pixel is mostly background, nor do heads with a class for unlabelled \
         pixels (Gaussian Grouping, SA4D); VLGS, Dr. Splat and Trace3D give the background to instances too. The scores \
         above count only pixels with a true label, and take the most probable label there.</p>\n",
    );
    for (capture, seed) in captures {
        let of_capture: Vec<&Record> = records
            .iter()
            .filter(|record| record.row.capture == capture && record.row.seed == seed)
            .collect();
        let named = |record: &Record, suffix: &str| {
            record.pictures.iter().find(|name| name.ends_with(suffix)).map(|name| runs.file(name))
        };
        let first = of_capture
            .iter()
            .find_map(|record| Some((named(record, ".truth.png")?, named(record, ".mask.png")?)));
        let Some((truth, mask)) = first else { continue };
        let mut shown = vec![("captured".to_owned(), truth), ("true labels".to_owned(), mask)];
        for record in &of_capture {
            if let Some(path) = named(record, ".instances.png") {
                shown.push((title(&record.row.head, &comparison.camera), path));
            }
        }
        let loaded: Vec<PixelGrid<[u8; 3]>> =
            shown.iter().map(|(_, path)| read(path)).collect::<Result<_, _>>()?;
        let _ = writeln!(page, "<h3>{}</h3>\n<div class=\"pictures\">", escape(capture));
        for (name, path) in &shown {
            picture(page, path, name)?;
        }
        page.push_str("</div>\n");
        let of_runs: Vec<&PixelGrid<[u8; 3]>> = loaded[2..].iter().collect();
        if let Some(crop) = Crop::of_differences(&loaded[1], &of_runs, comparison.empty) {
            page.push_str("<p class=\"how\">Where they differ most:</p>\n<div class=\"pictures\">\n");
            for (k, ((name, _), whole)) in shown.iter().zip(&loaded).enumerate() {
                let path = runs.file(&format!("{capture}.crop{k}.png"));
                save(&path, &crop.of(whole))?;
                picture(page, &path, name)?;
            }
            page.push_str("</div>\n");
        }
    }
    page.push_str("</section>\n");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::queries::{Answer, Rule};
    use super::super::record::Row;
    use super::*;

    #[test]
    fn the_page_and_the_tables_are_whole_without_a_network() {
        let folder = tempfile::tempdir().unwrap();
        let runs = Records::inside(folder.path()).unwrap();
        let record = |head: &str, color: u8| {
            let mut pictures = Vec::new();
            for (suffix, value) in [(".truth", 9), (".mask", 1), (".instances", color)] {
                let name = format!("{head}{suffix}.png");
                save(&runs.file(&name), &PixelGrid::from_pixels(6, 6, vec![[value; 3]; 36])).unwrap();
                pictures.push(name);
            }
            let row = Row {
                capture: "table <1>".into(),
                head: head.into(),
                macc_pix: Some(91.25),
                miou: Some(70.0 + f64::from(color)),
                psnr: Some(30.0),
                seconds: 3.0,
                ..Row::default()
            };
            Record { row, pictures, ..Record::default() }
        };
        let records = [record("cif", 1), record("vlgs", 2), record("i", 3)];
        let comparison = Comparison {
            description: "one capture".into(),
            command: "cif bench compare table".into(),
            threads: 2,
            simd: "Avx2".into(),
            videos: vec![Video {
                capture: "table <1>".into(),
                file: runs.file("table.mp4"),
                parts: vec!["colours".into(), "CIF".into()],
            }],
            missing: vec![Missing { capture: "table <1>".into(), head: "vlgs".into(), seed: 1 }],
            heads: ["cif", "vlgs"].map(str::to_owned).to_vec(),
            ablations: true,
            camera: String::new(),
            queries: Some(Queries {
                questions: vec![("table <1>".into(), vec!["what is <red>?".into()])],
                answers: vec![Answer {
                    capture: "table <1>".into(),
                    head: "cif".into(),
                    seed: 0,
                    question: "what is <red>?".into(),
                    by: Rule::Labels,
                    macc: Some(98.5),
                    miou: Some(76.25),
                    frames: 2,
                    empty_frames: 0,
                    chosen: vec![3],
                }],
                heads: vec!["cif".into()],
                ..Queries::default()
            }),
            empty: [0; 3],
        };
        std::fs::write(runs.file("table.mp4"), b"video").unwrap();
        write(folder.path(), &runs, &comparison, &records).unwrap();
        let text = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let page = text("compare.html");
        for part in [
            "table &lt;1&gt;",
            "1 runs are missing",
            "table &lt;1&gt; with VLGS (re-implementation) (seed 1)",
            "VLGS (re-implementation)",
            "(i) constant occupancy",
            "(v) full",
            "Where they differ most",
            "src=\"data:video/mp4;base64,dmlkZW8=\"",
            "From left to right: colours, CIF.",
            "<strong>72.00</strong>",
            "'what is &lt;red&gt;?' mIoU %",
            "76.25",
            "No models were given",
        ] {
            assert!(page.contains(part), "{part}");
        }
        let loaded = page.replace("http://www.w3.org/2000/svg", "");
        for outside in ["http:", "https:", "<script", "@import", "<link"] {
            assert!(!loaded.contains(outside), "{outside}");
        }
        let rows = |name: &str| serde_json::from_str::<Vec<Row>>(&text(name)).unwrap();
        let heads = |rows: &[Row]| rows.iter().map(|row| row.head.clone()).collect::<Vec<_>>();
        assert_eq!(heads(&rows("panoptic.json")), ["cif", "vlgs"]);
        assert_eq!(
            heads(&rows("ablation.json")),
            ["i", "v"],
            "the whole method is its row of the other table"
        );
        for name in ["panoptic", "ablation", "queries"] {
            for extension in ["md", "csv", "tex"] {
                assert!(!text(&format!("{name}.{extension}")).is_empty());
            }
        }
        let alone = Comparison { ablations: false, missing: Vec::new(), queries: None, ..comparison };
        let other = tempfile::tempdir().unwrap();
        write(other.path(), &runs, &alone, &records[..2]).unwrap();
        assert!(!other.path().join("ablation.md").exists() && !other.path().join("queries.md").exists());
    }
}
