//! `cif query --text`: objects that a text describes, by their embeddings, or by the words of their names.

use std::collections::BTreeSet;
use std::path::Path;

use cif_scene::{ObjectMatch, ObjectQuery, known_names};
use cif_vision::embedding::TextEmbedder;
use cif_vision::{Models, library};
use serde::Serialize;

use super::find::{point, search};
use super::options::Query;
use crate::error::Error;
use crate::messages::note;
use crate::report::JsonReport;
use crate::words::{self, words};

/// Texts of anything: an object that is nearer to one of them than to the question is no answer. Source: LERF (2023),
/// whose relevancy above a half is that.
const ANYTHING: [&str; 4] = ["object", "things", "stuff", "texture"];

/// An object and how well a text describes it.
#[derive(Serialize)]
struct Scored {
    #[serde(flatten)]
    object: ObjectMatch,
    /// Cosine of the angle between embeddings, or the share of the words of the text that the object has.
    score: f64,
    /// True when it is an answer.
    chosen: bool,
}

/// Objects by how well a text describes them, the best first.
#[derive(Serialize)]
#[serde(transparent)]
struct Ranking<'a>(&'a [Scored]);

impl JsonReport for Ranking<'_> {
    const COMMANDS: &'static [&'static str] = &["cif query --text"];
}

pub(super) fn run(command: &Query, text: &str, query: ObjectQuery) -> Result<(), Error> {
    if words(text).is_empty() {
        return Err(Error::usage(
            "--text has no words",
            "for example --text 'something to drink from', or --text mug",
        ));
    }
    // Missing models are reported before a stage is read.
    let models = command.models.as_deref().map(Models::open).transpose()?;
    if let Some(models) = &models {
        models.embedder_name()?;
    }
    let objects = search(command, query)?;
    let has_embeddings = objects.iter().any(|object| object.embedding.is_some());
    let scored = match models {
        Some(models) if has_embeddings => by_meaning(&models, text, objects, &command.path)?,
        models => {
            let reason = match (models, has_embeddings) {
                (Some(_), _) => format!(
                    "{} has no embeddings, which cif embed makes of a capture",
                    command.path.display()
                ),
                (None, true) => "embeddings are compared by models: --models DIR".to_owned(),
                (None, false) => "there are no models (--models DIR)".to_owned(),
            };
            note!("{reason}; the text is matched with labels, classes and taxonomies, word by word");
            by_words(text, objects, &command.path)?
        }
    };
    report(command, &scored)
}

/// Objects that have an embedding, nearest to the text first.
fn by_meaning(
    models: &Models,
    text: &str,
    objects: Vec<ObjectMatch>,
    place: &Path,
) -> Result<Vec<Scored>, Error> {
    let name = models.embedder_name()?;
    let library = library::find(&crate::pythons())?;
    let mut embedder = TextEmbedder::open(&library, models)?;
    let question = embedder.embed(text)?;
    let anything = ANYTHING.iter().map(|text| embedder.embed(text)).collect::<Result<Vec<_>, _>>()?;
    let mut scored = Vec::new();
    for object in objects {
        let Some(embedding) = &object.embedding else { continue };
        if embedding.model != name || embedding.direction.len() != question.len() {
            return Err(Error::failed(
                format!(
                    "{} has embeddings of {} ({} numbers), and the models in {} are {name} ({} numbers)",
                    place.display(),
                    embedding.model,
                    embedding.direction.len(),
                    models.folder().display(),
                    question.len()
                ),
                "give the models that they were made by, or make them anew with cif embed",
            ));
        }
        let score = cosine(&question, &embedding.direction);
        let chosen = anything.iter().all(|other| cosine(other, &embedding.direction) < score);
        scored.push(Scored { score, chosen, object });
    }
    scored.sort_by(|a, b| b.score.total_cmp(&a.score));
    Ok(scored)
}

/// Cosine of the angle between two vectors of length 1.
fn cosine(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

/// Objects that have any word of the text in their names, those with the most first; these are the answer.
fn by_words(text: &str, objects: Vec<ObjectMatch>, place: &Path) -> Result<Vec<Scored>, Error> {
    let asked = words(text);
    let share = |object: &ObjectMatch| words::share(&asked, object.names.iter().map(String::as_str));
    let shares: Vec<f64> = objects.iter().map(share).collect();
    if shares.iter().all(|share| *share <= 0.0) {
        let known: BTreeSet<String> = objects.into_iter().map(|object| object.found.label).collect();
        let known: Vec<String> = known.into_iter().collect();
        let known = known_names(text, "labels", &known);
        return Err(Error::failed(
            format!("no object of {} has a word of '{text}'; {known}", place.display()),
            "use words of the labels; embeddings, which cif embed makes, are found by meaning",
        ));
    }
    let chosen = words::best(&shares);
    let mut scored: Vec<Scored> = objects
        .into_iter()
        .zip(shares.into_iter().zip(chosen))
        .filter(|(_, (score, _))| *score > 0.0)
        .map(|(object, (score, chosen))| Scored { object, score, chosen })
        .collect();
    scored.sort_by(|a, b| b.score.total_cmp(&a.score));
    Ok(scored)
}

fn report(command: &Query, scored: &[Scored]) -> Result<(), Error> {
    command.report.give(|| Ranking(scored), || print(scored))
}

fn print(scored: &[Scored]) {
    let mut table = crate::commands::shared::table(["", "score", "object", "label", "class", "position"]);
    for Scored { object, score, chosen } in scored {
        let rows = &object.found.transform;
        table.add_row([
            if *chosen { "*".to_owned() } else { String::new() },
            format!("{score:.3}"),
            object.found.path.clone(),
            object.found.label.clone(),
            object.found.class.clone(),
            point(&[rows[0][3], rows[1][3], rows[2][3]]),
        ]);
    }
    println!("{table}");
    if !scored.iter().any(|one| one.chosen) {
        println!("none is nearer to the text than to 'object', 'things', 'stuff' or 'texture'");
    }
}
