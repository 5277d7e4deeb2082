use super::*;

fn answer(
    capture: &str,
    head: &str,
    seed: u64,
    question: &str,
    by: Rule,
    scores: Option<(f64, f64)>,
) -> Answer {
    Answer {
        capture: capture.into(),
        head: head.into(),
        seed,
        question: question.into(),
        by,
        macc: scores.map(|(macc, _)| macc),
        miou: scores.map(|(_, miou)| miou),
        frames: usize::from(scores.is_some()),
        empty_frames: 0,
        chosen: vec![3, 7],
    }
}

fn queries() -> Queries {
    let (labels, models) = (Rule::Labels, Rule::Reproject);
    Queries {
        questions: vec![
            ("americano".into(), vec!["mat".into(), "glass_cup".into()]),
            ("table".into(), vec!["red, \"round\" ball".into()]),
        ],
        answers: vec![
            answer("americano", "cif", 0, "mat", labels, Some((90.0, 50.0))),
            answer("americano", "cif", 0, "glass_cup", labels, Some((80.0, 40.0))),
            answer("americano", "cif", 1, "mat", labels, Some((92.0, 54.0))),
            answer("americano", "cif", 1, "glass_cup", labels, Some((84.0, 44.0))),
            answer("americano", "sa4d", 0, "mat", labels, Some((95.0, 45.0))),
            answer("americano", "sa4d", 0, "glass_cup", labels, None),
            answer("americano", "cif", 0, "mat", models, Some((70.0, 60.0))),
            answer("table", "cif", 0, "red, \"round\" ball", labels, Some((60.0, 30.0))),
        ],
        heads: ["cif", "sa4d"].map(str::to_owned).to_vec(),
        ..Queries::default()
    }
}

#[test]
fn means_are_over_questions_then_over_seeds_of_one_rule() {
    let tables = queries().tables();
    let captions: Vec<&str> = tables.iter().map(|table| &table.caption[..]).collect();
    assert_eq!(captions, ["americano", "table", "all questions of americano, table"]);
    let lines: Vec<(&str, Rule)> = tables[0].lines.iter().map(|line| (&line.title[..], line.rule)).collect();
    let expected = [("CIF", Rule::Labels), ("SA4D (all cameras)", Rule::Labels), ("CIF", Rule::Reproject)];
    assert_eq!(lines, expected);
    let means = |table: usize, line: usize| -> Vec<Option<f64>> {
        tables[table].lines[line].cells.iter().map(|(mean, _)| mean.mean).collect()
    };
    // Both scores of every question, then of both.
    assert_eq!(means(0, 0), [91.0, 52.0, 82.0, 42.0, 86.5, 47.0].map(Some));
    assert_eq!(tables[0].lines[0].cells[1].0.spread, Some(8f64.sqrt()));
    // A question without a frame that shows its answer does not count.
    assert_eq!(means(0, 1), [Some(95.0), Some(45.0), None, None, Some(95.0), Some(45.0)]);
    // One that is not answered yet leaves no mean of all.
    assert_eq!(means(0, 2), [Some(70.0), Some(60.0), None, None, None, None]);
    // The second seed has not answered on the other capture.
    assert_eq!(tables[2].lines.len(), 1);
    assert_eq!(means(2, 0), [Some((90.0 + 80.0 + 60.0) / 3.0), Some(40.0)]);
}

#[test]
fn the_best_are_marked_among_answers_by_the_same_rule() {
    let tables = queries().tables();
    let best = |line: usize| tables[0].lines[line].cells.iter().map(|(_, best)| *best).collect::<Vec<_>>();
    assert_eq!(best(0), [false, true, true, true, false, true]);
    assert_eq!(best(1), [true, false, false, false, true, false]);
    assert_eq!(best(2), [false; 6], "there is no other line by this rule");
}

#[test]
fn published_numbers_stand_next_to_answers_with_a_detector() {
    let mut queries = queries();
    queries.answers.push(answer("table", "cif", 0, "red, \"round\" ball", Rule::Grouping, Some((1.0, 1.0))));
    let tables = queries.tables();
    let published = |table: usize, line: usize| &tables[table].lines[line].published[..];
    assert_eq!(published(0, 0), "–");
    assert_eq!(published(0, 2), "'glass cup' 99.02 / 88.52; 'mat' 94.68 / 77.66");
    assert_eq!(published(1, 1), "98.29 / 84.90 (mean of four questions, HyperNeRF)");
}

#[test]
fn every_form_holds_the_answers_and_tells_what_is_missing() {
    let mut queries = queries();
    queries.missing.push(Missing { capture: "table".into(), head: "sa4d".into(), seed: 0 });
    let markdown = queries.markdown();
    assert!(markdown.contains("| CIF | labels | 91.00 ± 1.41 | **52.00 ± 2.83** |"), "{markdown}");
    for part in ["No models were given", "table with SA4D (all cameras) (seed 0)"] {
        assert!(markdown.contains(part) && queries.latex().contains(part), "{part}");
    }
    assert!(queries.latex().contains("'glass\\_cup' mAcc \\% &"), "{}", queries.latex());
    let csv = queries.csv();
    assert!(csv.contains("\"table\",cif,0,\"red, \"\"round\"\" ball\",labels,60,30,1,0,3 7\n"), "{csv}");
    assert!(csv.contains("\"americano\",sa4d,0,\"glass_cup\",labels,,,0,0,3 7\n"), "{csv}");
    assert_eq!(serde_json::from_str::<Vec<Answer>>(&queries.json()).unwrap(), queries.answers);
    queries.has_models = true;
    assert!(!queries.markdown().contains("No models") && queries.markdown().contains("Grounding DINO"));
}
