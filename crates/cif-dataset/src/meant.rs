//! The name that was meant where none is spelled as asked.

use std::collections::BTreeSet;

use strsim::damerau_levenshtein;

/// Words of a name in lower case, without the number at the end of unique names; of the path of a prim, its last part.
fn words(name: &str) -> Vec<String> {
    let name = if name.starts_with('/') { name.rsplit('/').next().unwrap_or(name) } else { name };
    let mut words: Vec<String> = name
        .split(|letter: char| !letter.is_alphanumeric())
        .filter(|word| !word.is_empty())
        .map(str::to_lowercase)
        .collect();
    if words.len() > 1 && words.last().is_some_and(|word| word.chars().all(|c| c.is_ascii_digit())) {
        words.pop();
    }
    words
}

/// How far a name is from the one that was asked for, in edits of letters; `None` where they have nothing in common.
/// Case, underscores, dashes and the numbers of unique names do not count, and a name with all words of the other
/// is one edit away for each word that it has more.
fn distance(asked: &[String], name: &str) -> Option<usize> {
    let name = words(name);
    let (one, other) = (asked.join(" "), name.join(" "));
    let edits = damerau_levenshtein(&one, &other);
    let close = edits <= 1.max(one.chars().count() / 3);
    let (few, many): (BTreeSet<_>, BTreeSet<_>) = (asked.iter().collect(), name.iter().collect());
    let shares_words = !few.is_empty() && !many.is_empty() && (few.is_subset(&many) || many.is_subset(&few));
    let more = few.symmetric_difference(&many).count();
    match (close, shares_words) {
        (true, true) => Some(edits.min(more)),
        (true, false) => Some(edits),
        (false, true) => Some(more),
        (false, false) => None,
    }
}

/// The known name that is most like the one that was asked for; patterns with wildcards mean no single name.
///
/// ```
/// use cif_dataset::meant::meant;
/// assert_eq!(meant("red_mug", ["box", "mug", "red mug"]), Some("red mug"));
/// assert_eq!(meant("Mugs", ["box", "mug"]), Some("mug"));
/// assert_eq!(meant("teapot", ["box", "mug"]), None);
/// ```
#[must_use]
pub fn meant<'a>(asked: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if asked.contains(['*', '?']) {
        return None;
    }
    let asked_words = words(asked);
    let far = known.into_iter().filter_map(|name| Some((distance(&asked_words, name)?, name)));
    // Of equal ones that which is spelled most alike.
    far.min_by_key(|(far, name)| (*far, damerau_levenshtein(asked, name))).map(|(_, name)| name)
}

/// The names that there are, for the end of a message: with the one that was meant before them, where there is one.
#[must_use]
pub fn known_names(asked: &str, what: &str, known: &[String]) -> String {
    let all = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    match meant(asked, known.iter().map(String::as_str)) {
        Some(name) => format!("did you mean '{name}'? {what}: {all}"),
        None => format!("{what}: {all}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spelling_case_and_numbers_do_not_hide_a_name() {
        let known = ["background", "box", "mug", "red mug", "red_mug_001", "toy car", "yellow-box"];
        for (asked, expected) in [
            ("red_mug", Some("red mug")),
            ("Red-Mug", Some("red mug")),
            ("red mugs", Some("red mug")),
            ("rde mug", Some("red mug")),
            ("boxs", Some("box")),
            ("car", Some("toy car")),
            ("the toy car", Some("toy car")),
            ("red_mug_002", Some("red_mug_001")),
            ("yellow box", Some("yellow-box")),
            ("teapot", None),
            ("x", None),
            ("", None),
            ("red_*", None),
        ] {
            assert_eq!(meant(asked, known), expected, "{asked}");
        }
    }

    #[test]
    fn paths_of_prims_are_known_by_their_last_part() {
        let known = ["/World/background", "/World/ball_006", "/World/red_mug_001"];
        assert_eq!(meant("red_ball", known), Some("/World/ball_006"));
        assert_eq!(meant("red mug", known), Some("/World/red_mug_001"));
        assert_eq!(meant("world", known), None);
    }

    #[test]
    fn messages_have_the_name_before_the_others() {
        let known = ["box".to_owned(), "red mug".to_owned()];
        assert_eq!(
            known_names("red_mug", "known labels", &known),
            "did you mean 'red mug'? known labels: box, red mug"
        );
        assert_eq!(known_names("red_mug", "objects", &[]), "objects: none");
    }
}
