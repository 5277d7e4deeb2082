//! Patterns that labels are looked for by.

/// A label with wildcards: `*` stands for any characters, also none, and `?` for one. Everything else stands for
/// itself, so that every label is found by its own name. Case and space at the ends do not matter.
///
/// A match takes at most time in proportion to the lengths of pattern and label multiplied, whatever they hold.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LabelPattern {
    characters: Vec<char>,
}

/// Characters to compare, without case and without space at the ends.
fn folded(text: &str) -> impl Iterator<Item = char> {
    text.trim().chars().flat_map(char::to_lowercase)
}

impl LabelPattern {
    /// The pattern that a text spells.
    #[must_use]
    pub fn new(text: &str) -> Self {
        let mut characters: Vec<char> = folded(text).collect();
        // Several stars in a row say what one says.
        characters.dedup_by(|next, before| *next == '*' && *before == '*');
        Self { characters }
    }

    /// True where a label is spelled so.
    #[must_use]
    pub fn matches(&self, label: &str) -> bool {
        let pattern = self.characters.as_slice();
        let label: Vec<char> = folded(label).collect();
        let (mut at, mut next) = (0, 0);
        // Behind the last star, and how much of the label it has taken: only the last one ever has to take more.
        let mut star = None;
        while next < label.len() {
            match pattern.get(at) {
                Some('*') => {
                    at += 1;
                    star = Some((at, next));
                }
                Some(&expected) if expected == '?' || expected == label[next] => {
                    at += 1;
                    next += 1;
                }
                _ => {
                    let Some((behind, taken)) = star else { return false };
                    at = behind;
                    next = taken + 1;
                    star = Some((behind, next));
                }
            }
        }
        pattern[at..].iter().all(|rest| *rest == '*')
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn stars_and_question_marks_are_wildcards_and_nothing_else_is() {
        for (pattern, label, found) in [
            ("red*", "Red Mug", true),
            ("*MUG", "red mug", true),
            ("*d?m*g*", "red mug", true),
            ("red mug", "red mugs", false),
            ("red mug?", "red mug", false),
            ("*", "", true),
            ("", "", true),
            ("", "a", false),
            ("?", "杯", true),
            ("shelf [left] {2}", "shelf [left] {2}", true),
            ("shelf [left]", "shelf l", false),
            ("{red,blue} mug", "red mug", false),
            ("[!a]", "b", false),
            ("back\\slash", "back\\slash", true),
            (" red mug ", "red mug", true),
            ("red mug", " red mug", true),
            ("a*b*c", "a b b c c", true),
            ("a*b*c", "a c b", false),
            ("GROSSE TASSE", "grosse tasse", true),
        ] {
            assert_eq!(LabelPattern::new(pattern).matches(label), found, "{pattern:?} and {label:?}");
        }
    }

    #[test]
    fn a_hundred_thousand_stars_are_one() {
        let stars = "*".repeat(100_000);
        assert_eq!(LabelPattern::new(&stars), LabelPattern::new("*"));
        // What would take exponential time by trying every split: answered at once.
        let pattern = LabelPattern::new(&"a*".repeat(200));
        assert!(!pattern.matches(&format!("{}b", "a".repeat(150))));
        assert!(pattern.matches(&"a".repeat(400)));
    }

    /// By trying every split.
    fn naive(pattern: &[char], label: &[char]) -> bool {
        match pattern.split_first() {
            None => label.is_empty(),
            Some(('*', rest)) => (0..=label.len()).any(|taken| naive(rest, &label[taken..])),
            Some((expected, rest)) => label.split_first().is_some_and(|(first, others)| {
                (*expected == '?' || expected == first) && naive(rest, others)
            }),
        }
    }

    proptest! {
        #[test]
        fn every_label_is_found_by_its_own_name(label in any::<String>()) {
            prop_assert!(LabelPattern::new(&label).matches(&label));
        }

        #[test]
        fn matches_are_those_of_trying_every_split(pattern in "[ab*?]{0,8}", label in "[ab]{0,8}") {
            let characters = |text: &str| text.chars().collect::<Vec<char>>();
            let expected = naive(&characters(&pattern), &characters(&label));
            prop_assert_eq!(LabelPattern::new(&pattern).matches(&label), expected);
        }
    }
}
