//! Words of a text, matched with the names of objects.

use std::collections::BTreeSet;

/// Words of a text in lower case, without numbers such as those at the end of unique names.
#[must_use]
pub fn words(text: &str) -> BTreeSet<String> {
    text.split(|letter: char| !letter.is_alphanumeric())
        .filter(|word| word.chars().any(char::is_alphabetic))
        .map(str::to_lowercase)
        .collect()
}

/// Share of the words of a text that are among the names of an object, `[0, 1]`.
#[must_use]
pub fn share<'a>(text: &BTreeSet<String>, names: impl IntoIterator<Item = &'a str>) -> f64 {
    let own: BTreeSet<String> = names.into_iter().flat_map(words).collect();
    text.intersection(&own).count() as f64 / text.len().max(1) as f64
}

/// Marks the objects that have the most words of a text, none where no object has any.
#[must_use]
pub fn best(shares: &[f64]) -> Vec<bool> {
    let most = shares.iter().copied().fold(0.0, f64::max);
    shares.iter().map(|share| *share > 0.0 && *share >= most).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_compared_without_case_and_numbers() {
        let of = |text: &str| words(text).into_iter().collect::<Vec<_>>();
        assert_eq!(of("The red_Mug_001, MUG!"), ["mug", "red", "the"]);
        assert_eq!(of("Q81727"), ["q81727"]);
        assert!(of(" 12 -- ").is_empty());
    }

    #[test]
    fn objects_with_the_most_words_are_the_answer() {
        let asked = words("a red mug");
        let shares =
            [["red mug", "cup"], ["blue mug", "cup"], ["box", "box"]].map(|names| share(&asked, names));
        assert_eq!(shares.map(|share| (3.0 * share).round()), [2.0, 1.0, 0.0]);
        assert_eq!(best(&shares), [true, false, false]);
        assert_eq!(best(&[0.5, 0.5]), [true, true]);
        assert_eq!(best(&[0.0, 0.0]), [false, false]);
    }
}
