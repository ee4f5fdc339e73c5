//! Which frames of a sequence to take, as text.
//!
//! Commas between items; an item is a frame, `first-last`, or `first-lastxstep`. Frames may be negative: `-3--1` and
//! `-3-5` are ranges. `:` is refused, since it means a step in some programs and a range in others.

use crate::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::str::FromStr;

/// Which frames to take, such as `1001-1064`, `1001-1064x2`, `-3-5,10,20`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameSelection {
    ranges: Vec<FrameRange>,
}

impl FrameSelection {
    /// The ranges in the order they were given; they may overlap.
    pub(crate) fn ranges(&self) -> &[FrameRange] {
        &self.ranges
    }

    /// The places of the selected frames in `numbers`, ascending, each once. A frame asked for that is not there is an
    /// error naming it and `path`.
    pub fn positions(&self, path: &Path, numbers: &[i32]) -> Result<Vec<usize>> {
        let places: BTreeMap<i32, usize> = numbers.iter().zip(0..).map(|(&n, i)| (n, i)).collect();
        let mut chosen = BTreeSet::new();
        for number in self.ranges.iter().flat_map(FrameRange::numbers) {
            // The first missing frame ends it, so that a huge range costs no more than the frames that are there.
            let Some(&place) = places.get(&number) else {
                let (first, last) = (places.first_key_value(), places.last_key_value());
                let expected = match (first, last) {
                    (Some(first), Some(last)) => format!("one of the {} from {} to {}", places.len(), first.0, last.0),
                    _ => "none, for there are no frames".to_owned(),
                };
                return Err(Error::invalid(path, format!("frame {number}"), "no such frame", expected));
            };
            chosen.insert(place);
        }
        Ok(chosen.into_iter().collect())
    }
}

/// Every `step`th frame from `first` up to `last`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameRange {
    first: i32,
    last: i32,
    step: u32,
}

impl FrameRange {
    /// The frame numbers, ascending.
    pub fn numbers(&self) -> impl Iterator<Item = i32> {
        (self.first..=self.last).step_by(self.step as usize)
    }
}

/// Why a text is no frame selection.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("frames '{text}': {reason}")]
pub struct FrameSelectionError {
    text: String,
    reason: String,
}

impl FromStr for FrameSelection {
    type Err = FrameSelectionError;

    fn from_str(text: &str) -> std::result::Result<Self, FrameSelectionError> {
        let ranges = text.split(',').map(|item| range(item.trim()));
        let ranges = ranges.collect::<std::result::Result<_, String>>();
        let ranges = ranges.map_err(|reason| FrameSelectionError { text: text.escape_debug().to_string(), reason })?;
        Ok(Self { ranges })
    }
}

fn range(item: &str) -> std::result::Result<FrameRange, String> {
    if item.contains(':') {
        let hint = item.replacen(':', "x", 1);
        return Err(format!("the step is written with x, such as {}", hint.escape_debug()));
    }
    let whole = |digits: &str, what: &str| {
        let is_number = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
        let number = is_number.then(|| digits.parse::<i64>().ok().filter(|&n| n <= i64::from(i32::MAX))).flatten();
        number.ok_or_else(|| format!("'{}' where {what} was expected, such as in 1001-1064x2", digits.escape_debug()))
    };
    // A sign belongs to the number that follows it.
    let signed = |text: &str| match text.strip_prefix('-') {
        Some(digits) => whole(digits, "a frame").map(|n| -n as i32),
        None => whole(text, "a frame").map(|n| n as i32),
    };
    let (frames, step) = match item.split_once('x') {
        Some((frames, step)) => (frames, whole(step, "a step")? as u32),
        None => (item, 1),
    };
    if step == 0 {
        return Err("a step of 0 never ends; use 1 or more".to_owned());
    }
    let dash = frames.char_indices().skip(1).find(|&(_, c)| c == '-');
    let (first, last) = match dash {
        Some((at, _)) => (signed(&frames[..at])?, signed(&frames[at + 1..])?),
        None if step == 1 => (signed(frames)?, signed(frames)?),
        None => return Err("a step needs a first and a last frame, such as 1001-1064x2".to_owned()),
    };
    if last < first {
        return Err(format!("{first}-{last} goes down; write {last}-{first}"));
    }
    Ok(FrameRange { first, last, step })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selected_frames_are_found_by_number_and_a_missing_one_is_named() {
        let positions = |text: &str, numbers: &[i32]| {
            text.parse::<FrameSelection>().unwrap().positions(Path::new("a.smoke"), numbers)
        };
        assert_eq!(positions("5,1-3,2", &[1, 2, 3, 5]).unwrap(), [0, 1, 2, 3]);
        assert_eq!(positions("1-5x2", &[5, 3, 1]).unwrap(), [0, 1, 2]);
        let message = positions("1-2000000000", &[1, 2, 3]).unwrap_err().to_string();
        assert_eq!(message, "a.smoke: frame 4: found no such frame, expected one of the 3 from 1 to 3");
        assert!(positions("1", &[]).unwrap_err().to_string().contains("no frames"));
    }

    #[test]
    fn every_form_gives_its_frames() {
        let frames = |text: &str| {
            let selection: FrameSelection = text.parse().unwrap();
            selection.ranges().iter().flat_map(FrameRange::numbers).collect::<Vec<_>>()
        };
        assert_eq!(frames("7"), [7]);
        assert_eq!(frames("1001-1004"), [1001, 1002, 1003, 1004]);
        assert_eq!(frames("1001-1006x2, 0"), [1001, 1003, 1005, 0]);
        assert_eq!(frames("-3--1,-1-1"), [-3, -2, -1, -1, 0, 1]);
        assert_eq!(frames("2147483646-2147483647"), [i32::MAX - 1, i32::MAX]);
        assert_eq!(frames("1-2x2147483647"), [1]);
    }

    #[test]
    fn texts_that_are_no_selection_say_why() {
        for (text, why) in [
            ("1001-1064:2", "such as 1001-1064x2"),
            ("", "'' where a frame"),
            ("1,,2", "'' where a frame"),
            ("5-1", "write 1-5"),
            ("1-5x0", "step of 0"),
            ("5x2", "a first and a last"),
            ("1-5x", "'' where a step"),
            ("1-+5", "'+5'"),
            ("all", "'all'"),
            ("99999999999", "99999999999"),
            ("1\u{e9}-5", "where a frame"),
        ] {
            let message = text.parse::<FrameSelection>().unwrap_err().to_string();
            assert!(message.contains(why), "{text}: {message}");
        }
    }
}
