//! Choice of effects by the user: `all`, `auto`, `none`, and single ones on or off.

use std::collections::BTreeMap;

use super::effect::EffectKind;

/// Where the decisions start from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Basis {
    /// As the preset says; nothing is left out.
    All,
    /// As the capture calls for.
    #[default]
    Auto,
    /// Nothing that can be left out.
    None,
}

/// `--effects`: a basis, and single effects that are switched.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EffectChoice {
    /// Where the decisions start from.
    pub basis: Basis,
    /// Effects switched on or off, whatever the basis says.
    pub switched: BTreeMap<EffectKind, bool>,
}

impl std::str::FromStr for EffectChoice {
    type Err = String;

    /// Reads a list such as `auto,-instances` or `none,+motion`; without a basis it is `auto`.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut choice = Self::default();
        for (place, word) in text.split(',').map(str::trim).enumerate() {
            let basis = match word {
                "all" => Some(Basis::All),
                "auto" => Some(Basis::Auto),
                "none" => Some(Basis::None),
                _ => None,
            };
            if let Some(basis) = basis {
                if place > 0 {
                    return Err(format!("`{word}` must come first: {word},+motion"));
                }
                choice.basis = basis;
                continue;
            }
            let (on, name) = match (word.strip_prefix('+'), word.strip_prefix('-')) {
                (Some(name), _) => (true, name),
                (_, Some(name)) => (false, name),
                _ => {
                    return Err(format!(
                        "`{word}` is neither all, auto nor none, nor an effect with + or - before it; effects: {}",
                        names()
                    ));
                }
            };
            let kind = EffectKind::SWITCHED
                .into_iter()
                .find(|kind| kind.name() == name)
                .ok_or_else(|| format!("there is no effect `{name}` to switch; effects: {}", names()))?;
            choice.switched.insert(kind, on);
        }
        Ok(choice)
    }
}

/// Effects that can be switched, in words.
fn names() -> String {
    EffectKind::SWITCHED.map(EffectKind::name).join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_switch_single_effects_of_a_basis() {
        let read = |text: &str| text.parse::<EffectChoice>();
        assert_eq!(read("all").unwrap().basis, Basis::All);
        let choice = read("none, +motion,-instances").unwrap();
        assert_eq!(choice.basis, Basis::None);
        assert_eq!(
            choice.switched,
            BTreeMap::from([(EffectKind::Motion, true), (EffectKind::Instances, false)])
        );
        assert_eq!(read("-instances").unwrap().basis, Basis::Auto);
        for (text, word) in [
            ("motion", "+ or -"),
            ("+motoin", "view-dependence"),
            ("+background", "no effect `background`"),
            ("+motion,auto", "must come first"),
            ("", "neither"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(word), "{text}: {error}");
        }
    }
}
