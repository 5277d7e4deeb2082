//! The command line, from the parser itself.

use std::fmt::Write as _;

use cif::commands::Arguments;
use clap::{Arg, Command, CommandFactory};

use super::escape;

const HEAD: &str = "\
# Commands

Generated from the help of the command by `make docs`; do not edit.

Every command prints this text with `--help`, and a summary with `-h`. `cif -V` prints the version, `cif --version` also
the commit that was built, what was built in, and the vector instructions that this machine has. The options of `cif`
itself may stand after any command.
";

/// The page.
pub(super) fn page() -> String {
    let mut root = Arguments::command().disable_help_subcommand(true);
    root.build();
    let mut page = HEAD.to_owned();
    write_command(&mut page, &root, 2);
    page
}

/// A command, then its subcommands; `level` is that of its heading.
fn write_command(page: &mut String, command: &Command, level: usize) {
    let name = command.get_bin_name().unwrap_or_else(|| command.get_name());
    write!(page, "\n{} {name}\n", "#".repeat(level)).unwrap();
    if let Some(about) = command.get_long_about().or(command.get_about()) {
        write!(page, "\n{}\n", escape(&about.to_string())).unwrap();
    }
    let usage = command.clone().render_usage().to_string();
    let usage: Vec<&str> = usage.trim_start_matches("Usage:").lines().map(str::trim).collect();
    write!(page, "\n```text\n{}\n```\n", usage.join("\n")).unwrap();

    let subcommands: Vec<&Command> = command.get_subcommands().filter(|sub| !sub.is_hide_set()).collect();
    if !subcommands.is_empty() {
        page.push_str("\nCommands:\n\n");
    }
    for sub in &subcommands {
        let name = sub.get_bin_name().unwrap_or_else(|| sub.get_name());
        let about = sub.get_about().map(ToString::to_string).unwrap_or_default();
        writeln!(page, "- [`{name}`](#{}): {}", name.replace(' ', "-"), escape(&about)).unwrap();
    }
    write_arguments(page, command, level == 2 && name == "cif");
    if let Some(examples) = command.get_after_long_help().or(command.get_after_help()) {
        let examples = examples.to_string();
        if examples.trim_start().starts_with("cif ") {
            page.push_str("\nExamples:\n");
        }
        write!(page, "\n```text\n{}\n```\n", examples.trim_end()).unwrap();
    }
    for sub in subcommands {
        write_command(page, sub, if name == "cif" { 2 } else { level + 1 });
    }
}

/// Arguments by their headings, in the order of the help; global ones where `is_root`.
fn write_arguments(page: &mut String, command: &Command, is_root: bool) {
    let mut groups: Vec<(&str, Vec<&Arg>)> = Vec::new();
    let shown = |arg: &&Arg| {
        let is_generated = matches!(arg.get_id().as_str(), "help" | "version");
        !arg.is_hide_set()
            && !arg.is_hide_long_help_set()
            && !is_generated
            && (is_root || !arg.is_global_set())
    };
    for arg in command.get_arguments().filter(shown) {
        let default = if arg.is_positional() { "Arguments" } else { "Options" };
        let heading = arg.get_help_heading().unwrap_or(default);
        match groups.iter_mut().find(|(name, _)| *name == heading) {
            Some((_, args)) => args.push(arg),
            None => groups.push((heading, vec![arg])),
        }
    }
    // As in the help: arguments, options, then headings of their own.
    groups.sort_by_key(|(heading, _)| {
        ["Arguments", "Options"].iter().position(|default| default == heading).unwrap_or(2)
    });
    for (heading, args) in groups {
        write!(page, "\n{heading}:\n\n").unwrap();
        args.into_iter().for_each(|arg| write_argument(page, arg));
    }
}

/// One argument as an entry of a list.
fn write_argument(page: &mut String, arg: &Arg) {
    let mut term = arg.to_string();
    if let (Some(short), Some(_)) = (arg.get_short(), arg.get_long()) {
        term = format!("-{short}, {term}");
    }
    let help = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    write!(page, "- `{term}`: {}", escape(&help).replace("\n\n", "\n\n  ")).unwrap();
    let mut notes = Vec::new();
    let quoted =
        |words: &[String]| words.iter().map(|word| format!("`{word}`")).collect::<Vec<_>>().join(", ");
    let takes_value = arg.get_action().takes_values();
    if arg.is_required_set() && !arg.is_positional() {
        notes.push("required".to_owned());
    }
    let defaults: Vec<String> =
        arg.get_default_values().iter().map(|value| value.to_string_lossy().into_owned()).collect();
    if takes_value && !defaults.is_empty() && !arg.is_hide_default_value_set() {
        notes.push(format!("default: {}", quoted(&defaults)));
    }
    if let Some(name) = arg.get_env().filter(|_| !arg.is_hide_env_set()) {
        notes.push(format!("environment: `{}`", name.to_string_lossy()));
    }
    let aliases: Vec<String> =
        arg.get_visible_aliases().unwrap_or_default().iter().map(|alias| format!("--{alias}")).collect();
    if !aliases.is_empty() {
        notes.push(format!("also {}", quoted(&aliases)));
    }
    let mut values = arg.get_possible_values();
    values.retain(|value| takes_value && !value.is_hide_set() && !arg.is_hide_possible_values_set());
    let are_explained = values.iter().any(|value| value.get_help().is_some());
    if !values.is_empty() && !are_explained {
        let names: Vec<String> = values.iter().map(|value| value.get_name().to_owned()).collect();
        notes.push(format!("values: {}", quoted(&names)));
    }
    if !notes.is_empty() {
        write!(page, " ({})", notes.join("; ")).unwrap();
    }
    page.push('\n');
    for value in values.iter().filter(|_| are_explained) {
        let help =
            value.get_help().map(|help| format!(": {}", escape(&help.to_string()))).unwrap_or_default();
        writeln!(page, "  - `{}`{help}", value.get_name()).unwrap();
    }
}
