use super::*;

/// Place of mIoU among [`MEASURES`].
const MIOU: usize = 4;

fn row(capture: &str, head: &str, seed: u64, miou: f64) -> Row {
    Row {
        capture: capture.into(),
        head: head.into(),
        seed,
        panoptic: Some(88.0),
        macc_pix: Some(90.0),
        miou: Some(miou),
        gaussians: 1_000,
        seconds: 12.5,
        ..Row::default()
    }
}

fn rows() -> Vec<Row> {
    vec![
        row("americano", "cif", 0, 80.0),
        row("americano", "cif", 1, 84.0),
        row("a_b", "cif", 0, 60.0),
        row("a_b", "cif", 1, 60.0),
        row("americano", "vlgs", 0, 90.0),
        row("americano", "vlgs", 1, 70.0),
        row("a_b", "vlgs", 0, 50.0),
    ]
}

#[test]
fn means_are_over_captures_first_and_spreads_over_seeds() {
    let (rows, names) = (rows(), ["cif", "vlgs", "sa4d"].map(str::to_owned));
    let subject = Subject { rows: &rows, names: &names, camera: "", ablation: false, missing: &[] };
    let tables = subject.tables();
    assert_eq!(
        tables.iter().map(|t| &t.caption[..]).collect::<Vec<_>>(),
        ["americano", "a_b", "average of americano, a_b"]
    );
    let miou = |table: usize, line: usize| tables[table].lines[line].means[MIOU];
    assert_eq!(miou(0, 0), Mean { mean: Some(82.0), spread: Some(8f64.sqrt()) });
    assert_eq!(miou(0, 1).mean, Some(80.0));
    assert_eq!((miou(2, 0).mean, miou(2, 1)), (Some(71.0), Mean { mean: Some(70.0), spread: None }));
    let best = |table: usize| tables[table].lines.iter().map(|line| line.best[MIOU]).collect::<Vec<_>>();
    assert_eq!((best(0), best(2)), (vec![true, false], vec![true, false]));
    assert_eq!(tables[0].lines[0].best[0], tables[0].lines[1].best[0], "equals are both the best");
    assert_eq!(tables[0].lines.len(), 2, "what was not run has no line");
    assert_eq!(tables[0].lines[1].published, "97.56 / 86.38 / 82.50");
    assert_eq!(
        tables[1].lines[1].published,
        "94.31 / 73.91 / 68.05 (HyperNeRF); 90.25 / 90.69 / 82.50 (Neu3D)"
    );
}

#[test]
fn every_form_has_every_run() {
    let (rows, names) = (rows(), ["cif", "vlgs"].map(str::to_owned));
    let subject = Subject { rows: &rows, names: &names, camera: "", ablation: false, missing: &[] };
    let markdown = subject.markdown();
    assert!(markdown.contains("| CIF | 88.00 ± 0.00 |") || markdown.contains("| CIF | **88.00 ± 0.00** |"));
    assert!(markdown.contains("VLGS (re-implementation)") && markdown.contains("no public code"));
    assert!(markdown.contains("published mAcc-pix % / mAcc-inst % / mIoU %, other masks"));
    let latex = subject.latex();
    assert!(latex.contains("a\\_b") && latex.contains("82.00 $\\pm$ 2.83") && !latex.contains(" % "));
    assert_eq!(subject.csv().lines().count(), rows.len() + 1);
    let json: serde_json::Value = serde_json::from_str(&subject.json()).unwrap();
    let keys = [
        "capture",
        "head",
        "seed",
        "panoptic",
        "iou",
        "macc_pix",
        "macc_inst",
        "miou",
        "psnr",
        "ssim",
        "gaussians",
        "seconds",
    ];
    for row in json.as_array().unwrap() {
        assert_eq!(row.as_object().unwrap().len(), keys.len());
        assert!(keys.iter().all(|key| row.get(key).is_some()));
    }
    let ablation = Subject {
        ablation: true,
        names: &["v".to_owned()],
        rows: &[row("x", "v", 0, 1.0)],
        camera: "",
        missing: &[],
    };
    assert!(ablation.markdown().contains("97.93 / 90.40 / 86.03 / 32.42 (split-cookie)"));
}

#[test]
fn what_is_missing_is_stated_in_the_tables_that_lack_it() {
    let (rows, names) = (rows(), ["cif", "vlgs"].map(str::to_owned));
    let missing =
        |capture: &str, head: &str, seed| Missing { capture: capture.into(), head: head.into(), seed };
    let missing = [missing("a_b", "vlgs", 1), missing("a_b", "iii", 0), missing("a_b", "vlgs", 2)];
    let subject = Subject { rows: &rows, names: &names, camera: "", ablation: false, missing: &missing };
    let note = "Missing, and not in the means: a_b with VLGS (re-implementation) (seed 1, 2).";
    assert!(subject.markdown().contains(note), "{}", subject.markdown());
    assert!(subject.latex().contains(note));
    let parts = ["iii".to_owned()];
    let of_parts = Subject { names: &parts, ablation: true, ..subject };
    assert!(of_parts.markdown().contains("a_b with (iii) no calibration (seed 0)"));
    let whole = Subject { missing: &[], names: &names, ..of_parts };
    assert!(!whole.markdown().contains("Not done yet"));
}
