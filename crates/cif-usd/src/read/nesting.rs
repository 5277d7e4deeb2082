//! Nesting depth of the brackets of a text layer, checked before usd-core parses it: its parser calls itself once per
//! level, and a stack that runs out ends the process.

use std::fs::File;
use std::io::{BufRead, BufReader, Result};
use std::path::Path;

/// Start of text layers.
const HEADERS: [&[u8]; 2] = [b"#usda", b"#sdf"];

/// Deepest nesting of brackets in a text layer; 0 for files that are none.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn deepest(path: &Path) -> Result<usize> {
    let mut file = BufReader::with_capacity(1 << 16, File::open(path)?);
    let start = file.fill_buf()?;
    if !HEADERS.iter().any(|header| start.starts_with(header)) {
        return Ok(0);
    }
    let mut brackets = Brackets::default();
    loop {
        let bytes = file.fill_buf()?;
        if bytes.is_empty() {
            return Ok(brackets.deepest);
        }
        bytes.iter().for_each(|byte| brackets.read(*byte));
        let length = bytes.len();
        file.consume(length);
    }
}

/// Where in a text layer the scan stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Place {
    #[default]
    Code,
    /// `# ...` or `// ...`.
    Line,
    /// `/* ... */`.
    Block,
    /// `<...>`.
    Path,
    /// Behind one or two quotes (or `@`, around assets) with nothing between.
    Opening { mark: u8, marks: u8 },
    /// Inside quotes; `marks` closing ones were met in a row.
    Quoted { mark: u8, triple: bool, marks: u8, escaped: bool },
}

#[derive(Default)]
struct Brackets {
    place: Place,
    before: u8,
    depth: usize,
    deepest: usize,
}

impl Brackets {
    fn read(&mut self, byte: u8) {
        self.place = match self.place {
            Place::Code => self.code(byte),
            Place::Line if byte == b'\n' => Place::Code,
            Place::Block if self.before == b'*' && byte == b'/' => Place::Code,
            Place::Path if byte == b'>' || byte == b'\n' => Place::Code,
            Place::Opening { mark, marks } if byte == mark => match marks {
                1 => Place::Opening { mark, marks: 2 },
                _ => Place::Quoted { mark, triple: true, marks: 0, escaped: false },
            },
            // Two quotes with nothing between are a whole text.
            Place::Opening { marks: 2, .. } => self.code(byte),
            Place::Opening { mark, .. } => Self::quoted(mark, false, 0, false, byte),
            Place::Quoted { mark, triple, marks, escaped } => {
                Self::quoted(mark, triple, marks, escaped, byte)
            }
            place => place,
        };
        self.before = byte;
    }

    fn code(&mut self, byte: u8) -> Place {
        match byte {
            b'{' | b'(' | b'[' => {
                self.depth += 1;
                self.deepest = self.deepest.max(self.depth);
            }
            b'}' | b')' | b']' => self.depth = self.depth.saturating_sub(1),
            b'#' => return Place::Line,
            b'/' if self.before == b'/' => return Place::Line,
            b'*' if self.before == b'/' => return Place::Block,
            b'<' => return Place::Path,
            b'"' | b'\'' | b'@' => return Place::Opening { mark: byte, marks: 1 },
            _ => {}
        }
        Place::Code
    }

    fn quoted(mark: u8, triple: bool, marks: u8, escaped: bool, byte: u8) -> Place {
        let inside = |marks, escaped| Place::Quoted { mark, triple, marks, escaped };
        match byte {
            _ if escaped => inside(0, false),
            // Assets between single `@` are paths, which may hold backslashes.
            b'\\' if triple || mark != b'@' => inside(0, true),
            _ if byte == mark && (!triple || marks == 2) => Place::Code,
            _ if byte == mark => inside(marks + 1, false),
            b'\n' if !triple => Place::Code,
            _ => inside(0, false),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn depth_of(text: &str) -> usize {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("layer.usda");
        std::fs::write(&path, text).unwrap();
        deepest(&path).unwrap()
    }

    #[test]
    fn brackets_of_the_layer_count_and_those_in_texts_do_not() {
        for (text, expected) in [
            ("#usda 1.0\n", 0),
            ("#usda 1.0\n(\n doc = \"((((\"\n)\ndef \"a\"\n{\n}\n", 1),
            ("#usda 1.0\ndef \"a\"\n{\n def \"b\" (\n  kind = \"x\"\n )\n {\n int[] x = [1]\n }\n}\n", 3),
            ("#usda 1.0\n# {{{\n// {{{\n/* {{ * / {{ */\n{}", 1),
            ("#usda 1.0\n'{{' \"\"\"{ \" {{\n\"\" {\"\"\" ''  {{}}", 2),
            ("#usda 1.0\n\"a\\\"{{{\" {{{}}}", 3),
            ("#usda 1.0\n@{{.usd@ @@@{{@{@@{@@@ @C:\\{{\\@ {}", 1),
            ("#usda 1.0\nrel x = </World{lod=full}A>\n{}", 1),
            ("{{{{{{{{{ is no layer", 0),
        ] {
            assert_eq!(depth_of(text), expected, "{text}");
        }
        let nested = format!("#usda 1.0\n{}{}", "def \"a\" {\n".repeat(15_000), "}\n".repeat(15_000));
        assert_eq!(depth_of(&nested), 15_000);
    }
}
