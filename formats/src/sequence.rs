//! Frame sequences on disk: a pattern or any one file of them, the gaps, and the frames asked for.
//!
//! Patterns (in the file name, one of them): `#` is four digits, `##` two and so on; each `@` one digit; `%04d` and `%d`;
//! `$F4` and `$F`. Numbers may be longer than the padding, and negative (`plume.-0003.vdb`).
//! A file name without a pattern: the last number that is set off by `.`, `_` or `-` is the frame (else the last number
//! at all), except a version such as `_v002`. The padding is that of the name, or none where no sibling is padded.

use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use crate::frame_selection::{FrameSelection, FrameSelectionError};

/// One frame of a sequence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SequenceFrame {
    /// The number in the file's name; 0 for a single file without one.
    pub number: i32,
    /// The file.
    pub path: PathBuf,
}

/// The files of a sequence that are there, ascending by number; at least one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    frames: Vec<SequenceFrame>,
    name: NamePattern,
}

/// A run of frames that are missing between two that are there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// First missing frame.
    pub first: i32,
    /// Last missing frame.
    pub last: i32,
    /// The file names that would fill it: one, or the first and the last and the count between two names.
    pub names: String,
}

impl Sequence {
    /// Finds the files of a pattern, or of the sequence that a file belongs to; a lone file is a sequence of one.
    ///
    /// Errors: no such file, no file that fits the pattern, a pattern in the folder's name, two files of one number.
    pub fn find(pattern_or_file: &str) -> Result<Self> {
        let path = Path::new(pattern_or_file);
        let folder = path.parent().map(Path::to_owned).unwrap_or_default();
        let file_name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        let is_file = path.is_file();
        // A file that is there is meant literally, even if its name looks like a pattern.
        let pattern = if is_file { None } else { NamePattern::from_placeholder(path, &folder, file_name)? };
        if let Some(name) = pattern {
            return name.frames(path).and_then(|frames| match frames.is_empty() {
                false => Ok(Self { frames, name: name.clone() }),
                true => {
                    let expected = format!("files such as {}", name.file_name(1));
                    Err(Error::invalid(path, "sequence", "no file of this pattern", expected))
                }
            });
        }
        if !is_file {
            std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
            return Err(Error::invalid(
                path,
                "sequence",
                "a folder or a device",
                "a file, or a pattern such as plume.####.vdb",
            ));
        }
        if let Some((name, number)) = NamePattern::from_member(&folder, file_name)? {
            let frames = name.frames(path)?;
            if frames.iter().any(|f| f.number == number) {
                return Ok(Self { frames, name });
            }
        }
        let name = NamePattern { folder, prefix: file_name.to_owned(), width: 0, suffix: String::new() };
        Ok(Self { frames: vec![SequenceFrame { number: 0, path: path.to_owned() }], name })
    }

    /// The frames that are there, ascending by number.
    pub fn frames(&self) -> &[SequenceFrame] {
        &self.frames
    }

    /// The frames missing between the first and the last.
    pub fn gaps(&self) -> Vec<Gap> {
        let between = |pair: &[SequenceFrame]| {
            // Neighbours ascend, so that a gap lies strictly between two i32.
            let (first, last) = (i64::from(pair[0].number) + 1, i64::from(pair[1].number) - 1);
            (first <= last).then(|| {
                let (first_frame, last_frame) = (first as i32, last as i32);
                let (a, b) = (self.name.file_name(first_frame), self.name.file_name(last_frame));
                let names = if first == last { a } else { format!("{a} to {b} ({} frames)", last - first + 1) };
                Gap { first: first_frame, last: last_frame, names }
            })
        };
        self.frames.windows(2).filter_map(between).collect()
    }

    /// The frames of a selection, ascending, each once. A frame asked for that is missing is an error naming it.
    pub fn select(&self, selection: &FrameSelection) -> Result<Vec<SequenceFrame>> {
        let mut chosen = BTreeMap::new();
        for range in selection.ranges() {
            for number in range.numbers() {
                // The first missing frame ends it, so that a huge range costs no more than the frames that are there.
                let Ok(at) = self.frames.binary_search_by_key(&number, |f| f.number) else {
                    let there = format!("{} to {}", self.frames[0].number, self.frames[self.frames.len() - 1].number);
                    let path = self.name.folder.join(self.name.file_name(number));
                    let expected = format!("that file, or a selection of what is there ({there})");
                    return Err(Error::invalid(&path, format!("frame {number}"), "no such file", expected));
                };
                chosen.insert(number, self.frames[at].clone());
            }
        }
        Ok(chosen.into_values().collect())
    }
}

/// The file of each frame of a sequence that is to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputNames(NamePattern);

impl OutputNames {
    /// The names that `pattern` gives `frames` files; one file may have a name without a pattern.
    ///
    /// Errors: several frames and no pattern, two patterns, no file name.
    pub fn new(pattern: &Path, frames: usize) -> Result<Self> {
        let folder = pattern.parent().map(Path::to_owned).unwrap_or_default();
        let name = pattern.file_name().and_then(|n| n.to_str());
        let expected = "a UTF-8 file name with a pattern, such as out.####.exr";
        let name = name.ok_or_else(|| Error::invalid(pattern, "output", "no UTF-8 file name", expected))?;
        match NamePattern::from_placeholder(pattern, &folder, name)? {
            Some(names) => Ok(Self(names)),
            None if frames <= 1 => {
                Ok(Self(NamePattern { folder, prefix: name.to_owned(), width: 0, suffix: String::new() }))
            }
            None => Err(Error::invalid(pattern, "output", format!("one name for {frames} frames"), expected)),
        }
    }

    /// The file of frame `number`.
    pub fn path(&self, number: i32) -> PathBuf {
        self.0.folder.join(self.0.file_name(number))
    }
}

/// A file name around a frame number.
#[derive(Clone, Debug, PartialEq, Eq)]
struct NamePattern {
    folder: PathBuf,
    prefix: String,
    /// Least number of digits; 0 for a single file without a number.
    width: usize,
    suffix: String,
}

impl NamePattern {
    /// The pattern in a file name, if it has one.
    fn from_placeholder(path: &Path, folder: &Path, name: &str) -> Result<Option<Self>> {
        let found = placeholders(name);
        if found.is_empty() {
            let in_folder = folder.to_str().is_some_and(|f| !placeholders(f).is_empty());
            if in_folder && !path.exists() {
                let hint = "put the frame number in the file's name";
                return Err(Error::unsupported(path, "sequence", "a pattern in the folder's name", hint));
            }
            return Ok(None);
        }
        let &[(start, end, width)] = found.as_slice() else {
            return Err(Error::invalid(
                path,
                "sequence",
                format!("{} patterns", found.len()),
                "one, such as plume.####.vdb",
            ));
        };
        let (prefix, suffix) = (name[..start].to_owned(), name[end..].to_owned());
        Ok(Some(Self { folder: folder.to_owned(), prefix, width, suffix }))
    }

    /// The pattern of a file that is there, and its number; none if its name has no frame number.
    fn from_member(folder: &Path, name: &str) -> Result<Option<(Self, i32)>> {
        let Some((start, end)) = frame_digits(name) else { return Ok(None) };
        let bytes = name.as_bytes();
        // `plume.-003.vdb` is a negative frame, `shot-003.vdb` has a dash in its name.
        let minus = start > 1 && bytes[start - 1] == b'-' && matches!(bytes[start - 2], b'.' | b'_');
        let (prefix, digits) = (&name[..start - usize::from(minus)], &name[start..end]);
        let (folder, suffix) = (folder.to_owned(), name[end..].to_owned());
        let mut pattern = Self { folder, prefix: prefix.to_owned(), width: 1, suffix };
        let padded = |d: &str| d.len() > 1 && d.starts_with('0');
        let siblings = pattern.names()?;
        let any_padded =
            siblings.iter().filter_map(|n| pattern.digits(n)).any(|d| d.len() == digits.len() && padded(d));
        if padded(digits) || any_padded {
            pattern.width = digits.len();
        }
        Ok(pattern.number(name).map(|number| (pattern, number)))
    }

    /// The digits of a name of this pattern, without the sign.
    fn digits<'n>(&self, name: &'n str) -> Option<&'n str> {
        let number = name.strip_prefix(&self.prefix)?.strip_suffix(&self.suffix)?;
        let digits = number.strip_prefix('-').unwrap_or(number);
        (!digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit())).then_some(digits)
    }

    /// The number of a name of this pattern with its padding.
    fn number(&self, name: &str) -> Option<i32> {
        let digits = self.digits(name)?;
        let negative = name.as_bytes()[self.prefix.len()] == b'-';
        // C counts the sign as a digit of the padding (%04d gives -001), Houdini does not.
        let short_by_sign = negative && digits.len() + 1 == self.width;
        let longer = digits.len() > self.width && !digits.starts_with('0');
        if !(digits.len() == self.width || longer || short_by_sign) {
            return None;
        }
        let number: i64 = digits.parse().ok()?;
        i32::try_from(if negative { -number } else { number }).ok()
    }

    fn file_name(&self, number: i32) -> String {
        if self.width == 0 {
            return self.prefix.clone();
        }
        let sign = if number < 0 { "-" } else { "" };
        format!("{}{sign}{:0width$}{}", self.prefix, number.unsigned_abs(), self.suffix, width = self.width)
    }

    /// All file names in the folder.
    fn names(&self) -> Result<Vec<String>> {
        let folder = if self.folder.as_os_str().is_empty() { Path::new(".") } else { &self.folder };
        let entries = std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
        let mut names = Vec::new();
        for entry in entries {
            // A name that is not UTF-8 fits no pattern.
            names.extend(entry.map_err(|e| Error::io(folder, e))?.file_name().into_string().ok());
        }
        Ok(names)
    }

    fn frames(&self, asked: &Path) -> Result<Vec<SequenceFrame>> {
        let mut frames: Vec<SequenceFrame> = Vec::new();
        for name in self.names()? {
            let path = self.folder.join(&name);
            if let Some(number) = self.number(&name).filter(|_| path.is_file()) {
                frames.push(SequenceFrame { number, path });
            }
        }
        frames.sort_by(|a, b| (a.number, &a.path).cmp(&(b.number, &b.path)));
        if let Some(pair) = frames.windows(2).find(|pair| pair[0].number == pair[1].number) {
            let found = format!("{} and {}", pair[0].path.display(), pair[1].path.display());
            return Err(Error::invalid(asked, format!("frame {}", pair[0].number), found, "one file a frame"));
        }
        Ok(frames)
    }
}

/// The patterns in a name: start, end, least number of digits.
fn placeholders(name: &str) -> Vec<(usize, usize, usize)> {
    let bytes = name.as_bytes();
    let run = |from: usize, of: fn(u8) -> bool| bytes[from..].iter().take_while(|&&b| of(b)).count();
    let number = |from: usize, to: usize| name[from..to].parse::<usize>().unwrap_or(1).clamp(1, 10);
    let (mut found, mut at) = (Vec::new(), 0);
    while at < bytes.len() {
        let (length, width) = match bytes[at] {
            b'#' => match run(at, |b| b == b'#') {
                1 => (1, 4),
                n => (n, n),
            },
            b'@' => {
                let n = run(at, |b| b == b'@');
                (n, n)
            }
            b'%' => {
                let digits = run(at + 1, |b| b.is_ascii_digit());
                let end = at + 1 + digits;
                // `%4d` would pad with spaces: not a frame pattern.
                let zero = digits == 0 || bytes[at + 1] == b'0';
                if zero && bytes.get(end) == Some(&b'd') { (digits + 2, number(at + 1, end)) } else { (0, 0) }
            }
            b'$' if bytes.get(at + 1) == Some(&b'F') => {
                let digits = run(at + 2, |b| b.is_ascii_digit());
                (digits + 2, number(at + 2, at + 2 + digits))
            }
            _ => (0, 0),
        };
        if length > 0 {
            found.push((at, at + length, width));
        }
        at += length.max(1);
    }
    found
}

/// Start and end of the digits that number a file's frame.
fn frame_digits(name: &str) -> Option<(usize, usize)> {
    let stem =
        name.rfind('.').filter(|&dot| name[dot + 1..].bytes().any(|b| !b.is_ascii_digit())).unwrap_or(name.len());
    let bytes = &name.as_bytes()[..stem];
    let mut runs = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        let length = bytes[at..].iter().take_while(|b| b.is_ascii_digit()).count();
        if length > 0 {
            runs.push((at, at + length));
        }
        at += length.max(1);
    }
    let set_off = |at: usize| at == 0 || matches!(bytes[at - 1], b'.' | b'_' | b'-');
    runs.retain(|&(start, _)| !(start > 0 && matches!(bytes[start - 1], b'v' | b'V') && set_off(start - 1)));
    runs.iter().rfind(|r| set_off(r.0)).or(runs.last()).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        names.iter().for_each(|name| std::fs::write(folder.path().join(name), "").unwrap());
        folder
    }

    fn numbers(folder: &tempfile::TempDir, name: &str) -> Vec<i32> {
        let found = Sequence::find(folder.path().join(name).to_str().unwrap()).unwrap();
        found.frames().iter().map(|f| f.number).collect()
    }

    #[test]
    fn files_to_write_are_named_by_every_pattern_and_a_plain_name_serves_one_frame() {
        let named = |pattern: &str, number| OutputNames::new(Path::new(pattern), 3).map(|n| n.path(number));
        for pattern in ["a/out.####.exr", "a/out.#.exr", "a/out.@@@@.exr", "a/out.%04d.exr", "a/out.$F4.exr"] {
            assert_eq!(named(pattern, 7).unwrap(), Path::new("a/out.0007.exr"), "{pattern}");
            assert_eq!(named(pattern, -7).unwrap(), Path::new("a/out.-0007.exr"), "{pattern}");
            assert_eq!(named(pattern, 123_456).unwrap(), Path::new("a/out.123456.exr"), "{pattern}");
        }
        assert_eq!(OutputNames::new(Path::new("one.exr"), 1).unwrap().path(7), Path::new("one.exr"));
        for (pattern, found) in [("one.exr", "one name for 3 frames"), ("##_##.exr", "2 patterns"), ("..", "no UTF-8")]
        {
            let message = named(pattern, 7).unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
        }
    }

    #[test]
    fn every_pattern_and_every_member_finds_the_same_frames() {
        let dir = folder(&[
            "plume.0999.vdb",
            "plume.1000.vdb",
            "plume.1002.vdb",
            "plume.10000.vdb",
            "plume.-0001.vdb",
            "plume.7.vdb",
            "plume.01000.vdb",
            "plume.vdb",
            "plume.1000.vdb.bak",
            "other.1001.vdb",
        ]);
        std::fs::create_dir(dir.path().join("plume.1001.vdb")).unwrap();
        for name in [
            "plume.####.vdb",
            "plume.#.vdb",
            "plume.@@@@.vdb",
            "plume.%04d.vdb",
            "plume.$F4.vdb",
            "plume.1002.vdb",
            "plume.0999.vdb",
            "plume.-0001.vdb",
        ] {
            assert_eq!(numbers(&dir, name), [-1, 999, 1000, 1002, 10000], "{name}");
        }
        assert_eq!(numbers(&dir, "plume.%d.vdb"), [7, 1000, 1002, 10000]);
        assert_eq!(numbers(&dir, "plume.vdb"), [0]);
        assert_eq!(numbers(&dir, "other.$F.vdb"), [1001]);
    }

    #[test]
    fn the_frame_number_is_found_among_other_numbers() {
        for (name, number) in [
            ("plume.1001.vdb", Some("1001")),
            ("shot10_v002_fx.0045.vdb", Some("0045")),
            ("smoke_v002.vdb", None),
            ("smoke12.vdb", Some("12")),
            ("s3_smoke_12_low2.vdb", Some("12")),
            ("2019.vdb", Some("2019")),
            ("smoke.12", Some("12")),
            ("smoke.vdb", None),
            ("cloud.mp4", None),
        ] {
            assert_eq!(frame_digits(name).map(|(start, end)| &name[start..end]), number, "{name}");
        }
    }

    #[test]
    fn unpadded_numbers_of_any_length_are_one_sequence_and_a_dash_in_a_name_is_no_sign() {
        let dir = folder(&["a.8.vdb", "a.10.vdb", "a.999.vdb", "b-001.vdb", "b-002.vdb", "c_v1.vdb", "c_v2.vdb"]);
        assert_eq!(numbers(&dir, "a.10.vdb"), [8, 10, 999]);
        assert_eq!(numbers(&dir, "b-001.vdb"), [1, 2]);
        assert_eq!(numbers(&dir, "c_v1.vdb"), [0]);
    }

    #[test]
    fn gaps_are_reported_by_name() {
        let dir = folder(&["p.0001.vdb", "p.0002.vdb", "p.0004.vdb", "p.0009.vdb"]);
        let found = Sequence::find(dir.path().join("p.####.vdb").to_str().unwrap()).unwrap();
        let names: Vec<String> = found.gaps().into_iter().map(|g| g.names).collect();
        assert_eq!(names, ["p.0003.vdb", "p.0005.vdb to p.0008.vdb (4 frames)"]);
        let ends = folder(&["p.-2147483648.vdb", "p.2147483647.vdb"]);
        let found = Sequence::find(ends.path().join("p.%d.vdb").to_str().unwrap()).unwrap();
        assert_eq!((found.gaps()[0].first, found.gaps()[0].last), (i32::MIN + 1, i32::MAX - 1));
    }

    #[test]
    fn a_selection_takes_what_is_there_and_names_what_is_missing() {
        let dir = folder(&["p.-0002.vdb", "p.-0001.vdb", "p.0000.vdb", "p.0001.vdb", "p.0002.vdb", "p.0004.vdb"]);
        let found = Sequence::find(dir.path().join("p.####.vdb").to_str().unwrap()).unwrap();
        let select = |text: &str| {
            let selection = text.parse().unwrap();
            found.select(&selection).map(|frames| frames.iter().map(|f| f.number).collect::<Vec<_>>())
        };
        assert_eq!(select("-2--1").unwrap(), [-2, -1]);
        assert_eq!(select("4, -2-2x2, 0").unwrap(), [-2, 0, 2, 4]);
        for text in ["1-4", "3", "0-2147483647", "-2147483647-2147483647"] {
            let message = select(text).unwrap_err().to_string();
            assert!(message.contains("no such file") && message.contains("p."), "{message}");
        }
        assert!(select("1-4").unwrap_err().to_string().contains("p.0003.vdb: frame 3"));
    }

    #[test]
    fn what_is_not_there_or_not_clear_is_an_error() {
        let dir = folder(&["p.-001.vdb", "p.-0001.vdb"]);
        let error = |name: &str| Sequence::find(dir.path().join(name).to_str().unwrap()).unwrap_err().to_string();
        assert!(error("q.####.vdb").contains("such as q.0001.vdb"));
        assert!(error("q.0001.vdb").contains("q.0001.vdb: "));
        assert!(error("p.##.$F.vdb").contains("2 patterns"));
        assert!(error("####/p.0001.vdb").contains("folder's name"));
        assert!(error("p.####.vdb").contains("one file a frame"));
        assert!(error("").contains("folder"));
    }
}
