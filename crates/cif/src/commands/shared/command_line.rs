//! Commands to be pasted into a shell.

/// A command of cif that can be pasted into a shell, whatever its words hold.
pub(in crate::commands) fn command_line<S: AsRef<str>>(words: &[S]) -> String {
    let words = std::iter::once("cif").chain(words.iter().map(AsRef::as_ref));
    // Arguments hold no NUL character, the only one that no shell takes.
    shlex::Quoter::new().allow_nul(true).join(words).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::command_line;

    #[test]
    fn commands_can_be_pasted_into_a_shell() {
        let words = ["train", "my table", "-o", "it's \"new\".cif", "--masks", "$HOME/*", "--resume"];
        let line = command_line(&words);
        assert_eq!(shlex::split(&line).unwrap()[1..], words);
        assert_eq!(command_line(&["train", "table", "-o", "a.cif"]), "cif train table -o a.cif");
    }
}
