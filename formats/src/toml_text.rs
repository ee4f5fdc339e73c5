//! TOML files that people write: reading them, and saying where an error is: line, column and dotted key; and what key
//! may have been meant.

use crate::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Longest text that is read, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Reads the text of a file, which may be at most 1 MiB long.
pub fn read(path: &Path) -> Result<String> {
    let mut text = String::new();
    let io = |e| Error::io(path, e);
    File::open(path).map_err(io)?.take(MAX_BYTES + 1).read_to_string(&mut text).map_err(io)?;
    if text.len() as u64 > MAX_BYTES {
        return Err(Error::invalid(path, "file size", "more", format!("at most {MAX_BYTES} bytes")));
    }
    Ok(text)
}

/// One line for an error of the TOML reader: `path` and where in `text` it is.
pub fn error(path: &Path, text: &str, error: &toml::de::Error) -> Error {
    let span = error.span().unwrap_or(0..0);
    let position = line_and_column(text, span.start);
    let message = error.message().lines().collect::<Vec<_>>().join(" ");
    let Ok(table) = DeTable::parse(text) else {
        return Error::invalid(path, position, message, "TOML");
    };
    let key = key_at(table.get_ref(), &span);
    let what = if key.is_empty() { position } else { format!("{position}: {key}") };
    if let Some(unknown) = message.strip_prefix("unknown field ") {
        // Serde's message: unknown field `a`, expected one of `b`, `c` (or: expected `b`).
        let names: Vec<&str> = unknown.split('`').skip(1).step_by(2).collect();
        let (given, known) = names.split_first().map_or(("", &[][..]), |(given, known)| (*given, known));
        let guess = closest(given, known).map_or(String::new(), |name| format!("; did you mean `{name}`?"));
        return Error::invalid(path, what, "an unknown key", format!("one of {}{guess}", known.join(", ")));
    }
    match message.split_once(", expected ") {
        // Serde's messages: invalid type: string "wide", expected f64; invalid length 2, expected an array of length 3.
        Some((found, expected)) => {
            let found = found.trim_start_matches("invalid type: ").trim_start_matches("invalid value: ");
            let found = found.trim_start_matches("string ").replace("invalid length ", "an array of ");
            let expected = if expected == "f64" { "a number" } else { expected };
            Error::invalid(path, what, found, expected)
        }
        None => Error::invalid(path, what, message, "another value"),
    }
}

/// `line L, column C: ` (or nothing, for a broken text) of the value at dotted `key`, or of the closest table above it that is in the text.
pub fn position(text: &str, key: &str) -> String {
    let Ok(table) = DeTable::parse(text) else { return String::new() };
    let mut at = 0;
    let mut value: Option<&Spanned<DeValue<'_>>> = None;
    for part in key.split('.') {
        let (name, index) = match part.split_once('[') {
            Some((name, index)) => (name, index.trim_end_matches(']').parse::<usize>().ok()),
            None => (part, None),
        };
        let inner = match value {
            None => Some(table.get_ref()),
            Some(value) => value.get_ref().as_table(),
        };
        let mut next = inner.and_then(|t| t.iter().find(|(k, _)| k.get_ref() == name)).map(|(_, v)| v);
        if let Some(index) = index {
            next = next.and_then(|v| v.get_ref().as_array()).and_then(|a| a.get(index));
        }
        let Some(found) = next else { break };
        (at, value) = (found.span().start, Some(found));
    }
    format!("{}: ", line_and_column(text, at))
}

/// Counted from 1; columns count characters.
fn line_and_column(text: &str, byte: usize) -> String {
    let before = text.get(..byte).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |p| p + 1);
    let (line, column) = (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1);
    format!("line {line}, column {column}")
}

/// The dotted key of the innermost value or key that covers `span`.
fn key_at(table: &DeTable<'_>, span: &Range<usize>) -> String {
    let covers = |outer: Range<usize>| outer.start <= span.start && span.end <= outer.end;
    for (name, value) in table {
        if let Some(array) = value.get_ref().as_array() {
            for (i, item) in array.iter().enumerate() {
                let Some(inner) = item.get_ref().as_table() else { continue };
                let below = key_at(inner, span);
                if !below.is_empty() {
                    return format!("{}[{i}].{below}", name.get_ref());
                }
                if covers(item.span()) {
                    return format!("{}[{i}]", name.get_ref());
                }
            }
        }
        if let Some(inner) = value.get_ref().as_table() {
            let below = key_at(inner, span);
            if !below.is_empty() {
                return format!("{}.{below}", name.get_ref());
            }
        }
        if covers(name.span()) || covers(value.span()) {
            return name.get_ref().to_string();
        }
    }
    String::new()
}

/// The known name at most two edits away from `given`, the closest first.
pub fn closest<'a>(given: &str, known: &[&'a str]) -> Option<&'a str> {
    let (distance, name) = known.iter().map(|name| (edits(given, name), *name)).min()?;
    (distance <= 2 && distance < name.len()).then_some(name)
}

/// Levenshtein distance: insertions, deletions and replacements of characters.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edit_distances_of_known_pairs() {
        for (a, b, expected) in [("", "", 0), ("abc", "", 3), ("kitten", "sitting", 3), ("albdo", "albedo", 1)] {
            assert_eq!((edits(a, b), edits(b, a)), (expected, expected), "{a} {b}");
        }
    }

    #[test]
    fn a_far_away_word_is_no_guess() {
        assert_eq!(closest("colour", &["image", "color"]), Some("color"));
        assert_eq!(closest("exposure", &["image", "color"]), None);
        assert_eq!(closest("x", &["g", "fov"]), None);
    }

    #[test]
    fn columns_count_characters_and_lines_count_from_one() {
        assert_eq!(line_and_column("ab\näöü = 1", 3), "line 2, column 1");
        assert_eq!(line_and_column("ab\näöü = 1", "ab\näö".len()), "line 2, column 3");
        assert_eq!(line_and_column("ab", 99), "line 1, column 3");
    }

    #[test]
    fn a_text_longer_than_a_mebibyte_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.toml");
        std::fs::write(&path, vec![b' '; 1 << 20]).unwrap();
        assert_eq!(read(&path).unwrap().len(), 1 << 20);
        std::fs::write(&path, vec![b' '; (1 << 20) + 1]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("file size: found more, expected at most 1048576"));
    }
}
