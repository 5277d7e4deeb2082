//! Damage: what copying, cutting, editing and malice make of a file.

use rand::RngExt;
use rand_pcg::Pcg64;
use serde_json::{Value, json};

/// What a file is made of, so that damage gets past its first line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    /// Bytes.
    Binary,
    /// Lines with numbers.
    Text,
    Json,
    Toml,
    /// The JSON of a `.glb`, and its bytes.
    Glb,
    /// The header of a `.cif` and the JSON in it, and its bytes.
    Cif,
}

/// A file that no reader may read, which damage puts where files are named.
pub(crate) const OUTSIDE: &str = "/dev/zero";

/// Numbers that break arithmetic, as a text spells them.
const NUMBERS: [&str; 18] = [
    "0",
    "-0",
    "-1",
    "1",
    "0.5",
    "255",
    "65535",
    "65536",
    "2147483648",
    "4294967295",
    "18446744073709551615",
    "18446744073709551616",
    "-9223372036854775808",
    "1e30",
    "-1e30",
    "1e308",
    "1e-320",
    "nan",
];

/// The same for bytes.
const WORDS: [u64; 12] = [
    0,
    1,
    0xff,
    0xffff,
    0x1_0000,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    u64::MAX,
    1 << 62,
    0x7fc0_0000, // NaN in single precision
    0x7f80_0000, // infinity
];

/// A damaged copy of a file.
pub(crate) fn damaged(original: &[u8], form: Form, rng: &mut Pcg64) -> Vec<u8> {
    let mut bytes = original.to_vec();
    for _ in 0..1 + rng.random_range(0..3_u32) {
        let structured = rng.random_bool(0.7).then(|| in_form(&bytes, form, rng)).flatten();
        bytes = structured.unwrap_or_else(|| in_bytes(&bytes, rng));
    }
    bytes
}

fn in_form(bytes: &[u8], form: Form, rng: &mut Pcg64) -> Option<Vec<u8>> {
    match form {
        Form::Binary => None,
        Form::Text => in_text(bytes, rng),
        Form::Json if rng.random_bool(0.3) => in_text(bytes, rng),
        Form::Json => {
            let mut value = serde_json::from_slice(bytes).ok()?;
            in_value(&mut value, rng);
            Some(value.to_string().into_bytes())
        }
        Form::Toml if rng.random_bool(0.3) => in_text(bytes, rng),
        Form::Toml => {
            let table: toml::Table = std::str::from_utf8(bytes).ok()?.parse().ok()?;
            let mut value = serde_json::to_value(table).ok()?;
            in_value(&mut value, rng);
            Some(toml::to_string(&value).ok()?.into_bytes())
        }
        Form::Glb => {
            let length = word(bytes, 12)?;
            let mut value = serde_json::from_slice(bytes.get(20..20 + length)?).ok()?;
            in_value(&mut value, rng);
            let mut json = value.to_string().into_bytes();
            json.resize(json.len().next_multiple_of(4), b' ');
            let rest = &bytes[20 + length..];
            let whole = 20 + json.len() + rest.len();
            let mut out = bytes[..8].to_vec();
            out.extend((whole as u32).to_le_bytes());
            out.extend((json.len() as u32).to_le_bytes());
            out.extend(b"JSON");
            out.extend(json);
            out.extend(rest);
            Some(out)
        }
        Form::Cif => {
            let length = word(bytes, 0)?;
            let mut header: Value = serde_json::from_slice(bytes.get(8..8 + length)?).ok()?;
            // Most of what a scene says stands as JSON in strings of the header.
            let key = ["cif.field", "cif.training"][rng.random_range(0..2)];
            match header.pointer_mut(&format!("/__metadata__/{key}")) {
                Some(Value::String(text)) if rng.random_bool(0.8) => {
                    let mut inner = serde_json::from_str(text).ok()?;
                    in_value(&mut inner, rng);
                    *text = inner.to_string();
                }
                _ => in_value(&mut header, rng),
            }
            let json = header.to_string().into_bytes();
            let mut out = (json.len() as u64).to_le_bytes().to_vec();
            out.extend(json);
            out.extend(&bytes[8 + length..]);
            Some(out)
        }
    }
}

/// A little-endian length.
fn word(bytes: &[u8], at: usize) -> Option<usize> {
    let word: [u8; 4] = bytes.get(at..at + 4)?.try_into().ok()?;
    Some(u32::from_le_bytes(word) as usize)
}

/// Flipped bits, foreign numbers, lost, repeated and exchanged pieces.
fn in_bytes(bytes: &[u8], rng: &mut Pcg64) -> Vec<u8> {
    let mut out = bytes.to_vec();
    if out.is_empty() {
        return vec![rng.random_range(0..=255); 8];
    }
    let at = rng.random_range(0..out.len());
    let end = (at + rng.random_range(1..=64)).min(out.len());
    match rng.random_range(0..8) {
        0 => out[at] ^= 1 << rng.random_range(0..8),
        1 => out[at] = [0, 1, 0x7f, 0x80, 0xff, b'-', b'\n', b'"'][rng.random_range(0..8)],
        2 => out.truncate(at),
        3 => {
            out.drain(at..end);
        }
        4 => {
            let piece = out[at..end].to_vec();
            let place = rng.random_range(0..=out.len());
            out.splice(place..place, piece);
        }
        5 => {
            let piece = out[at..end].to_vec();
            let place = rng.random_range(0..out.len());
            let behind = (place + piece.len()).min(out.len());
            out.splice(place..behind, piece);
        }
        6 => out.extend(std::iter::repeat_n(out[at], rng.random_range(1..64))),
        _ => {
            let word = WORDS[rng.random_range(0..WORDS.len())];
            let size = [1, 2, 4, 8][rng.random_range(0..4)];
            let word =
                if rng.random_bool(0.8) { word.to_le_bytes() } else { word.swap_bytes().to_le_bytes() };
            for (byte, new) in out[at..].iter_mut().zip(&word[..size]) {
                *byte = *new;
            }
        }
    }
    out
}

/// Foreign numbers, lost and repeated lines.
fn in_text(bytes: &[u8], rng: &mut Pcg64) -> Option<Vec<u8>> {
    let text = std::str::from_utf8(bytes).ok()?;
    if rng.random_bool(0.3) {
        let mut lines: Vec<&str> = text.split_inclusive('\n').collect();
        let at = rng.random_range(0..lines.len().max(1));
        let line = *lines.get(at)?;
        match rng.random_range(0..3) {
            0 => {
                lines.remove(at);
            }
            1 => lines.insert(at, line),
            _ => lines.swap(at, 0),
        }
        return Some(lines.concat().into_bytes());
    }
    let numeric = |c: char| c.is_ascii_digit() || ".-+eE".contains(c);
    let mut numbers = Vec::new();
    let mut start = None;
    for (index, character) in text.char_indices().chain([(text.len(), ' ')]) {
        match (start, numeric(character)) {
            (None, true) => start = Some(index),
            (Some(begun), false) => {
                if text[begun..index].contains(|c: char| c.is_ascii_digit()) {
                    numbers.push(begun..index);
                }
                start = None;
            }
            _ => {}
        }
    }
    let chosen = numbers.get(rng.random_range(0..numbers.len().max(1)))?.clone();
    let number = NUMBERS[rng.random_range(0..NUMBERS.len())];
    Some(format!("{}{number}{}", &text[..chosen.start], &text[chosen.end..]).into_bytes())
}

/// Values that no reader expects.
fn hostile(rng: &mut Pcg64) -> Value {
    let nested = |depth: usize| (0..depth).fold(json!([]), |inner, _| json!([inner]));
    match rng.random_range(0..24) {
        0 => Value::Null,
        1 => json!(true),
        2 => json!(""),
        3 => json!("\0"),
        4 => json!("name".repeat(100)),
        5 => json!("../../../etc/passwd"),
        6 => json!(OUTSIDE),
        7 => json!([]),
        8 => json!({}),
        9 => nested(100),
        10 => json!([1e30, -1e30, 0.0]),
        11 => json!(1e30),
        12 => json!(-1e30),
        13 => json!(1e308),
        14 => json!(1e-320),
        15 => json!(-1),
        16 => json!(0),
        17 => json!(1),
        18 => json!(65_535),
        19 => json!(65_536),
        20 => json!(u32::MAX),
        21 => json!(u64::MAX),
        22 => json!(i64::MIN),
        _ => json!(0.1),
    }
}

/// Foreign, lost, repeated and exchanged values.
fn in_value(root: &mut Value, rng: &mut Pcg64) {
    let copy = chosen(root, rng).clone();
    let children = |value: &Value| match value {
        Value::Array(items) => items.len(),
        Value::Object(map) => map.len(),
        _ => 0,
    };
    let place = chosen(root, rng);
    match rng.random_range(0..6) {
        0 | 1 => *place = hostile(rng),
        2 => *place = copy,
        3 => {
            if let Some(number) = place.as_f64() {
                *place = json!(number * [-1.0, 2.0, 0.5, 1e6][rng.random_range(0..4)]);
            } else {
                *place = hostile(rng);
            }
        }
        action => {
            // One of the parts of a list or table.
            let count = children(place);
            if count == 0 {
                return *place = copy;
            }
            let index = rng.random_range(0..count);
            match place {
                Value::Array(items) if action == 4 => {
                    items.remove(index);
                }
                Value::Array(items) => items.insert(index, items[index].clone()),
                Value::Object(map) => {
                    let name = map.keys().nth(index).cloned().unwrap_or_default();
                    if let Some(value) = map.remove(&name)
                        && action == 5
                    {
                        map.insert(format!("{name}x"), value);
                    }
                }
                _ => {}
            }
        }
    }
}

/// Any value of a document, itself included.
fn chosen<'a>(value: &'a mut Value, rng: &mut Pcg64) -> &'a mut Value {
    let count = match value {
        Value::Array(items) => items.len(),
        Value::Object(map) => map.len(),
        _ => 0,
    };
    if count == 0 || rng.random_bool(0.1) {
        return value;
    }
    let index = rng.random_range(0..count);
    match value {
        Value::Array(items) => chosen(&mut items[index], rng),
        Value::Object(map) => chosen(map.values_mut().nth(index).expect("it is below the count"), rng),
        other => other,
    }
}
