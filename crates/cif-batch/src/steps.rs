//! Steps of a plan: commands with placeholders, each done for every scene, every capture or once.

use cif_system::Error;

use crate::plan::{Each, Plan, Resources, Toggle};

/// Names of the steps that every plan has or may have.
pub const TRAIN: &str = "train";
/// Scores.
pub const EVAL: &str = "eval";
/// Files for other tools.
pub const EXPORT: &str = "export";
/// The page over all.
pub const COLLECT: &str = "collect";

/// Word of a command that stands for all windows of a scene, each a word of its own.
pub(crate) const SCENES: &str = "{scenes}";

/// A step.
#[derive(Clone, Debug)]
pub(crate) struct Template {
    pub(crate) name: String,
    pub(crate) each: Each,
    /// Names of steps that come first.
    pub(crate) needs: Vec<String>,
    /// The command, with placeholders.
    pub(crate) words: Vec<String>,
    /// Files and folders that it makes, with placeholders.
    pub(crate) makes: Vec<String>,
    pub(crate) resources: Resources,
    pub(crate) goes_on: bool,
}

fn texts(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

/// Steps of a plan besides benches and the collecting one, each after those that it needs.
///
/// # Errors
/// When a step needs one that is not there, or itself.
pub(crate) fn templates(plan: &Plan) -> Result<Vec<Template>, Error> {
    let mut steps = Vec::new();
    let options = &plan.capture_options.0;
    if !plan.captures.is_empty() {
        let mut train =
            texts(&["train", "{capture}", "-o", "{scene}", "--json={folder}/train.json", "--force"]);
        train.extend(options.iter().chain(&plan.train.options.0).cloned());
        steps.push(Template {
            name: TRAIN.to_owned(),
            each: Each::Run,
            needs: plan.train.needs.clone(),
            words: train,
            makes: texts(&["{scene}", "{folder}/train.json"]),
            resources: plan.resources,
            goes_on: true,
        });
        let eval = match &plan.eval {
            Toggle::Is(false) => None,
            Toggle::Is(true) => Some((true, Vec::new())),
            Toggle::With(eval) => Some((eval.pictures, eval.options.0.clone())),
        };
        if let Some((pictures, own)) = eval {
            let mut words =
                texts(&["eval", "{scene}", "{capture}", "--json={folder}/scores.json", "--force"]);
            let mut makes = texts(&["{folder}/scores.json"]);
            if pictures {
                words.extend(texts(&["--images", "{folder}/pictures"]));
                makes.extend(texts(&["{folder}/pictures"]));
            }
            words.extend(options.iter().cloned().chain(own));
            steps.push(after_training(EVAL, words, makes, plan));
        }
        if let Some(export) = &plan.export {
            let files: Vec<String> = export.files.iter().map(|file| format!("{{folder}}/{file}")).collect();
            let mut words = texts(&["export", SCENES]);
            words.extend(files.iter().cloned());
            words.extend(texts(&["--force"]).into_iter().chain(export.options.0.iter().cloned()));
            steps.push(Template { each: Each::Whole, ..after_training(EXPORT, words, files, plan) });
        }
    }
    for own in &plan.step {
        let mut needs = own.needs.clone();
        if matches!(own.each, Each::Run | Each::Whole) && !needs.iter().any(|name| name == TRAIN) {
            needs.push(TRAIN.to_owned());
        }
        steps.push(Template {
            name: own.name.clone(),
            each: own.each,
            needs,
            words: own.command.0.clone(),
            makes: own.makes.clone(),
            resources: own.resources.or(plan.resources),
            goes_on: false,
        });
    }
    check_names(plan, &steps)?;
    in_order(plan, steps)
}

fn after_training(name: &str, words: Vec<String>, makes: Vec<String>, plan: &Plan) -> Template {
    Template {
        name: name.to_owned(),
        each: Each::Run,
        needs: texts(&[TRAIN]),
        words,
        makes,
        resources: plan.resources,
        goes_on: false,
    }
}

fn check_names(plan: &Plan, steps: &[Template]) -> Result<(), Error> {
    let names = steps.iter().map(|step| &step.name).chain(plan.bench.iter().map(|bench| &bench.name));
    let mut seen = vec![COLLECT.to_owned()];
    for name in names {
        if seen.contains(name) {
            return Err(Error::refused(
                format!("{}: two steps are called `{name}`", plan.file.display()),
                "give each step and each bench a name of its own; train, eval, export and collect are taken",
            ));
        }
        seen.push(name.clone());
    }
    Ok(())
}

/// The steps so that each comes after those that it needs.
fn in_order(plan: &Plan, mut left: Vec<Template>) -> Result<Vec<Template>, Error> {
    let all: Vec<String> = left.iter().map(|step| step.name.clone()).collect();
    for step in &left {
        if let Some(missing) = step.needs.iter().find(|name| !all.contains(name)) {
            return Err(Error::refused(
                format!(
                    "{}: the step `{}` needs `{missing}`, which is no step",
                    plan.file.display(),
                    step.name
                ),
                format!("name one of: {}", all.join(", ")),
            ));
        }
    }
    let mut ordered: Vec<Template> = Vec::new();
    while !left.is_empty() {
        let is_ready =
            |step: &Template| step.needs.iter().all(|name| ordered.iter().any(|done| done.name == *name));
        let Some(next) = left.iter().position(is_ready) else {
            let names: Vec<&str> = left.iter().map(|step| step.name.as_str()).collect();
            return Err(Error::refused(
                format!("{}: these steps need each other: {}", plan.file.display(), names.join(", ")),
                "remove one of their `needs`",
            ));
        };
        ordered.push(left.remove(next));
    }
    Ok(ordered)
}
