//! The page itself: its files, put together into one document without anything to load.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest, Sha256};

/// A file of the page.
macro_rules! file {
    ($name:literal) => {
        include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/../../plugin/web/", $name))
    };
}

const SKELETON: &str = file!("index.html");
const STYLE: &str = file!("style.css");

/// Modules of the script; each imports from those above it only.
const MODULES: [&str; 15] = [
    file!("src/math.js"),
    file!("src/arrays.js"),
    file!("src/motion.js"),
    file!("src/sort.js"),
    file!("src/shaders.js"),
    file!("src/engine.js"),
    file!("src/page.js"),
    file!("src/view_camera.js"),
    file!("src/player.js"),
    file!("src/objects.js"),
    file!("src/compare.js"),
    file!("src/overlay.js"),
    file!("src/edits.js"),
    file!("src/live.js"),
    file!("src/main.js"),
];

/// A page, ready to be sent or written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Html {
    /// The document.
    pub text: String,
    /// Its content security policy: this script and this style, and nothing from elsewhere.
    pub policy: String,
}

/// The page around `data`, elements that hold the scene; empty where the page asks its server for it.
#[must_use]
pub fn html(title: &str, data: &str) -> Html {
    let script = script();
    let style = format!("\n{STYLE}");
    let asks = if data.is_empty() { "'self'" } else { "'none'" };
    let policy = format!(
        "default-src 'none'; script-src '{}'; style-src '{}'; img-src 'self' data: blob:; connect-src {asks}; \
         base-uri 'none'; form-action 'none'",
        hash(&script),
        hash(&style)
    );
    let meta = format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">");
    // From the last place to the first, so that no text that was put in is searched.
    let pieces = [
        ("<!--script-->", format!("<script>{script}</script>")),
        ("<!--data-->", data.to_owned()),
        ("<!--style-->", style),
        ("<!--title-->", escaped(title)),
        ("<!--policy-->", meta),
    ];
    let mut text = SKELETON.to_owned();
    for (place, piece) in pieces {
        let at = text.find(place).unwrap_or_else(|| panic!("plugin/web/index.html has {place}"));
        text.replace_range(at..at + place.len(), &piece);
    }
    Html { text, policy }
}

/// All modules as one script: they share a scope, in which every name is declared once.
fn script() -> String {
    let mut script = String::from("\n\"use strict\";\n(() => {\n");
    for module in MODULES {
        for line in module.lines().filter(|line| !line.starts_with("import ")) {
            script.push_str(line.strip_prefix("export ").unwrap_or(line));
            script.push('\n');
        }
    }
    script.push_str("})();\n");
    script
}

fn hash(text: &str) -> String {
    format!("sha256-{}", BASE64_STANDARD.encode(Sha256::digest(text)))
}

/// Text as HTML shows it.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn titles_are_text() {
        let page = html("<script>alert(1)</script> & more", "").text;
        assert!(page.contains("<title>&lt;script&gt;alert(1)&lt;/script&gt; &amp; more</title>"));
        assert_eq!(page.matches("<script>").count(), 1);
    }

    #[test]
    fn a_page_loads_nothing() {
        let page = html("a", "");
        assert!(page.text.contains(&page.policy));
        for source in ["src=", "href=", "http://", "https://", "<!--"] {
            let markup = page.text.split("<script>").next().unwrap();
            let markup = markup.split("</style>").last().unwrap();
            assert!(!markup.contains(source), "{source} in {markup}");
        }
    }

    /// Modules end up in one scope, so that two of them must not declare one name.
    #[test]
    fn names_of_modules_are_unique() {
        let mut seen = BTreeMap::new();
        for (index, module) in MODULES.iter().enumerate() {
            // Between backticks are texts, such as those of shaders.
            for line in module.split('`').step_by(2).flat_map(str::lines) {
                let line = line.strip_prefix("export ").unwrap_or(line);
                let line = line.strip_prefix("async ").unwrap_or(line);
                let declared =
                    ["function ", "class ", "const ", "let "].iter().find_map(|word| line.strip_prefix(word));
                let Some(rest) = declared else { continue };
                let name: String =
                    rest.chars().take_while(|c| c.is_alphanumeric() || "_$".contains(*c)).collect();
                if name.is_empty() {
                    continue;
                }
                let before = seen.insert(name.clone(), index);
                assert!(before.is_none(), "{name} is declared by modules {before:?} and {index}");
            }
        }
        assert!(seen.len() > 50, "{}", seen.len());
    }
}
