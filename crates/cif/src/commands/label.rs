//! `cif label`: other names for objects.

use std::path::{Path, PathBuf};

use cif_dataset::meant::meant;
use cif_field::{Checkpoint, Instance};
use cif_scene::naming::instance_name;
use clap::Args;
use serde::Serialize;

use crate::error::Error;
use crate::formats::Content;
use crate::lock::Lock;
use crate::output::Outputs;
use crate::report::{JsonReport, Report};

/// Give an object another label
#[derive(Debug, Args)]
#[command(after_help = "\
The file is written to a temporary file in the same folder, which then replaces it; nothing is lost when that fails.
Prims of a stage keep their names and paths; what changes is the semantic class label, the display
name and userProperties:label. In glTF it is `extras.cif`; nodes of other programs get another name.

  cif label table.cif --instance 3 'blue mug'
  cif label table.usda --instance red_mug_003 'blue mug' --category mug
  cif label table.cif --instance 3 'blue mug' -o renamed.cif")]
pub(super) struct Label {
    /// Trained scene (.cif), stage (.usda, .usdc) or glTF file (.glb, .gltf)
    #[arg(value_name = "FILE")]
    path: PathBuf,
    /// Object: its mask value, its unique name, or the path of its prim
    #[arg(long, value_name = "ID|NAME")]
    instance: String,
    /// New label
    #[arg(value_name = "LABEL")]
    label: String,
    /// New class [default: the old one, or the label where class and label were the same]
    #[arg(long, value_name = "CLASS")]
    category: Option<String>,
    /// Write to another file and leave this one as it is
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Replace existing files of -o and --json
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    report: Report,
}

pub(super) fn run(command: &Label) -> Result<(), Error> {
    let label = checked(&command.label, "the label")?;
    let category = command.category.as_deref().map(|category| checked(category, "--category")).transpose()?;
    let content = Content::of(&command.path)?;
    if let Some(output) = &command.output {
        let ending = |path: &Path| path.extension().map(|ending| ending.to_ascii_lowercase());
        if ending(output) != ending(&command.path) {
            return Err(Error::usage(
                format!("-o {}: labels do not change what a file is", output.display()),
                format!("give it the ending of {}; cif export writes other formats", command.path.display()),
            ));
        }
    }
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.path)?;
    command.output.as_deref().map_or(Ok(()), |output| outputs.file(output))?;
    command.report.check(&mut outputs)?;
    let target = command.output.as_deref().unwrap_or(&command.path);
    // From before it is read, so that no other change is lost.
    let _lock = Lock::wait(target)?;
    let renamed = match content {
        Content::Field => in_scene(&command.path, target, &command.instance, label, category)?,
        Content::Graph(format) => {
            let done = format.relabel(&command.path, target, &command.instance, label, category);
            let done = done.map_err(Error::plain)?;
            Renamed { object: done.object, before: done.before, label: done.label, category: done.category }
        }
    };
    let report = || {
        let Renamed { object, before, label, category } = &renamed;
        LabelReport { file: target, object, before, label, category }
    };
    command.report.give(report, || {
        let Renamed { object, before, label, category } = &renamed;
        println!("{}: '{before}' is now '{label}', class '{category}' ({object})", target.display());
    })
}

/// An object that got another label.
#[derive(Serialize)]
struct LabelReport<'a> {
    /// File that was written.
    file: &'a Path,
    /// The object: path of its prim, name of its node, or `id N` in a .cif.
    object: &'a str,
    /// Label that it had.
    before: &'a str,
    /// Label that it has now.
    label: &'a str,
    /// Class that it has now.
    category: &'a str,
}

impl JsonReport for LabelReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif label"];
}

/// An object with its names, before and now.
struct Renamed {
    object: String,
    before: String,
    label: String,
    category: String,
}

/// A label without surrounding space.
fn checked<'a>(text: &'a str, what: &str) -> Result<&'a str, Error> {
    let text = text.trim();
    if text.is_empty() || text.chars().any(char::is_control) {
        return Err(Error::usage(
            format!("{what} is empty or holds control characters"),
            "give a name that people can read, for example 'blue mug'",
        ));
    }
    Ok(text)
}

fn in_scene(
    path: &Path,
    target: &Path,
    object: &str,
    label: &str,
    category: Option<&str>,
) -> Result<Renamed, Error> {
    // The whole file, so that a training state in it stays.
    let mut checkpoint = Checkpoint::load(path).map_err(Error::plain)?;
    let instances = &mut checkpoint.field.instances;
    let index = find(instances, object).ok_or_else(|| {
        let known: Vec<String> =
            instances.iter().map(|instance| format!("{} {}", instance.id, instance.label)).collect();
        let names = instances.iter().map(|instance| instance_name(&instance.label, instance.id));
        let names: Vec<String> = names.collect();
        let help = match meant(object, names.iter().map(String::as_str)) {
            Some(name) => format!("did you mean --instance {name}?"),
            None => "give the number of one of them".to_owned(),
        };
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        Error::failed(format!("{} has no instance '{object}'; instances: {known}", path.display()), help)
    })?;
    let instance = &mut instances[index];
    let before = std::mem::replace(&mut instance.label, label.to_owned());
    if let Some(category) = category {
        category.clone_into(&mut instance.category);
    } else if instance.category == before {
        label.clone_into(&mut instance.category);
    }
    let (label, category) = (instance.label.clone(), instance.category.clone());
    let renamed = Renamed { object: format!("id {}", instance.id), before, label, category };
    checkpoint.save(target).map_err(Error::plain)?;
    Ok(renamed)
}

/// An instance by mask value or unique name, as exports name its node.
fn find(instances: &[Instance], object: &str) -> Option<usize> {
    let node = object.rsplit('/').next().unwrap_or(object);
    instances.iter().position(|instance| {
        object.parse() == Ok(instance.id) || instance_name(&instance.label, instance.id) == node
    })
}
