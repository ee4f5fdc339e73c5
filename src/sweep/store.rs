//! The folder of a sweep, and what in it lets an interrupted sweep continue.
//!
//! | in DIR | what |
//! |---|---|
//! | `sweep.csv`, `sweep.json`, `index.html` | the answer, each whole |
//! | `measured.csv` | with `--ladder`, the rows of the plan's table |
//! | `journal.jsonl` | a line for each finished measurement: the [`Key`] of what made it, and what was measured |
//! | `references/KEY.exr` | a reference: R, G, B, A, and `standard_error.R`, `.G`, `.B`, as `compare` takes it |
//! | `pictures/KEY.png`, `KEY.difference.png` | thumbnails |
//! | `packs/KEY.smoke` | packs of bake dials |
//!
//! A key is the XXH3-128 of everything that a result depends on, so what is found under it is what would be made again,
//! and a sweep with other dials in the same folder reuses what they have in common. A file is written before its line in
//! the journal, so a line says that all of it is there. A line that a kill has torn is not read.

use crate::failure::Failure;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use smoke_formats::image::{self, Channel, FloatImage};
use smoke_formats::{Error, atomic};
use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// The journal: what makes a folder ours.
const JOURNAL: &str = "journal.jsonl";
/// First line of the journal.
const HEAD: &str = "{\"smoke-bake\":\"sweep\",\"version\":1}";
/// Longest journal that is read.
const MAX_BYTES: u64 = 1 << 30;
/// Folders that a sweep fills.
const FOLDERS: [&str; 3] = ["references", "pictures", "packs"];
/// The rows of the plan's table, of a sweep of rungs.
pub const MEASURED: &str = "measured.csv";
/// Answers of a sweep.
const ANSWERS: [&str; 4] = ["sweep.csv", "sweep.json", "index.html", MEASURED];
/// Channels of a reference.
const CHANNELS: [&str; 7] = ["R", "G", "B", "A", "standard_error.R", "standard_error.G", "standard_error.B"];

/// The name of a result: 32 hexadecimal digits from everything that it depends on.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Key(String);

impl Key {
    /// The key of `parts`, in their order, and of the program's version.
    pub fn of(parts: &[&str]) -> Self {
        let mut text = env!("CARGO_PKG_VERSION").to_owned();
        for part in parts {
            // With its length, so that no two lists of parts run together to the same text.
            text += &format!("\n{}:{part}", part.len());
        }
        Self(format!("{:032x}", xxhash_rust::xxh3::xxh3_128(text.as_bytes())))
    }

    /// The digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// A reference as it is kept.
#[derive(Clone, Debug, PartialEq)]
pub struct ReferenceImage {
    /// Pixels in a row.
    pub width: usize,
    /// Radiance, row by row from the top.
    pub radiance: Vec<[f32; 3]>,
    /// Standard error of each sample.
    pub standard_error: Vec<[f32; 3]>,
    /// Opacity.
    pub alpha: Vec<f32>,
}

#[derive(Serialize, Deserialize)]
struct Entry<T> {
    key: Key,
    result: T,
}

/// The folder.
pub struct Store {
    folder: PathBuf,
    journal: File,
    known: HashMap<Key, Value>,
}

impl Store {
    /// The folder at `folder`, made if it is not there. With `resume` it keeps what it holds; else a sweep that lies there
    /// is cleared away.
    ///
    /// # Errors
    /// A folder with something in it that is no sweep.
    pub fn open(folder: &Path, resume: bool) -> Result<Self, Failure> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |e| Error::io(&path, e)
        };
        let path = folder.join(JOURNAL);
        let lines = if folder.exists() { read_journal(folder, &path)? } else { None };
        let known = match lines {
            Some(lines) if resume => lines,
            Some(_) => {
                clear(folder)?;
                HashMap::new()
            }
            None => HashMap::new(),
        };
        for name in FOLDERS {
            let path = folder.join(name);
            fs::create_dir_all(&path).map_err(io(&path))?;
        }
        // Written anew, without a torn line.
        let mut text = format!("{HEAD}\n");
        for (key, result) in &known {
            text += &line(&Entry { key: key.clone(), result })?;
        }
        atomic::write_bytes(&path, text.as_bytes())?;
        let journal = OpenOptions::new().append(true).open(&path).map_err(io(&path))?;
        Ok(Self { folder: folder.to_owned(), journal, known })
    }

    /// What was measured under `key`.
    pub fn find<T: DeserializeOwned>(&self, key: &Key) -> Option<T> {
        serde_json::from_value(self.known.get(key)?.clone()).ok()
    }

    /// Keeps what was measured under `key`.
    pub fn keep<T: Serialize>(&mut self, key: &Key, result: &T) -> Result<(), Failure> {
        let text = line(&Entry { key: key.clone(), result })?;
        let path = self.folder.join(JOURNAL);
        self.journal
            .write_all(text.as_bytes())
            .and_then(|()| self.journal.sync_data())
            .map_err(|e| Error::io(&path, e))?;
        let value = serde_json::to_value(result).map_err(|e| Failure::work(format!("{}: {e}", path.display())))?;
        self.known.insert(key.clone(), value);
        Ok(())
    }

    /// The folder's file `name`.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The pack of that key.
    pub fn pack(&self, key: &Key) -> PathBuf {
        self.folder.join("packs").join(format!("{}.smoke", key.as_str()))
    }

    /// The thumbnail of that key.
    pub fn picture(&self, key: &Key) -> PathBuf {
        self.folder.join("pictures").join(format!("{}.png", key.as_str()))
    }

    /// The thumbnail of that key's signed difference from its reference.
    pub fn difference(&self, key: &Key) -> PathBuf {
        self.folder.join("pictures").join(format!("{}.difference.png", key.as_str()))
    }

    /// Keeps a reference's image, in 32 bits.
    pub fn write_reference(&self, key: &Key, image: &ReferenceImage) -> Result<(), Failure> {
        let channel = |pixels: &[[f32; 3]], c: usize| pixels.iter().map(|p| p[c]).collect::<Vec<_>>();
        let values = |i: usize| match i {
            0..3 => channel(&image.radiance, i),
            3 => image.alpha.clone(),
            _ => channel(&image.standard_error, i - 4),
        };
        let channels = CHANNELS.iter().enumerate().map(|(i, name)| Channel { name: (*name).into(), values: values(i) });
        let (width, height) = (image.width, image.radiance.len() / image.width);
        let image = FloatImage { width, height, channels: channels.collect() };
        Ok(image::write_channels(&self.reference(key), &image)?)
    }

    /// The reference's image of that key.
    pub fn read_reference(&self, key: &Key) -> Result<ReferenceImage, Failure> {
        let path = self.reference(key);
        let image = image::read(&path)?;
        let channel = |name: &str| {
            let missing = || Error::invalid(&path, "channels", format!("no {name}"), "a reference of a sweep");
            image.channel(name).ok_or_else(missing)
        };
        let three = |names: &[&str]| -> Result<Vec<[f32; 3]>, Error> {
            let [r, g, b] = [channel(names[0])?, channel(names[1])?, channel(names[2])?];
            Ok((0..r.len()).map(|i| [r[i], g[i], b[i]]).collect())
        };
        let (radiance, standard_error) = (three(&CHANNELS[..3])?, three(&CHANNELS[4..])?);
        Ok(ReferenceImage { width: image.width, radiance, standard_error, alpha: channel("A")?.to_vec() })
    }

    fn reference(&self, key: &Key) -> PathBuf {
        self.folder.join("references").join(format!("{}.exr", key.as_str()))
    }
}

fn line<T: Serialize>(entry: &Entry<T>) -> Result<String, Failure> {
    serde_json::to_string(entry).map(|text| text + "\n").map_err(|e| Failure::work(format!("{JOURNAL}: {e}")))
}

/// The lines of the journal in `folder`; none if the folder is empty.
fn read_journal(folder: &Path, path: &Path) -> Result<Option<HashMap<Key, Value>>, Failure> {
    let mut text = String::new();
    match File::open(path) {
        Ok(file) => {
            file.take(MAX_BYTES).read_to_string(&mut text).map_err(|e| Error::io(path, e))?;
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(e) => return Err(Error::io(path, e).into()),
    }
    let Some(body) = text.strip_prefix(HEAD) else {
        let mut entries = fs::read_dir(folder).map_err(|e| Error::io(folder, e))?;
        return match entries.next() {
            None => Ok(None),
            Some(_) => {
                let expected = "an empty folder, a new name, or a folder that a sweep has filled";
                Err(Error::invalid(folder, "--output", "a folder with other files", expected).into())
            }
        };
    };
    let entries = body.lines().filter_map(|line| serde_json::from_str::<Entry<Value>>(line).ok());
    Ok(Some(entries.map(|entry| (entry.key, entry.result)).collect()))
}

/// Removes what an earlier sweep has left, and nothing else. The journal goes last, so that the folder stays ours.
fn clear(folder: &Path) -> Result<(), Failure> {
    let gone = |path: &Path, result: std::io::Result<()>| match result {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path, e)),
        _ => Ok(()),
    };
    for name in FOLDERS {
        let path = folder.join(name);
        gone(&path, fs::remove_dir_all(&path))?;
    }
    for name in ANSWERS.iter().chain([&JOURNAL]) {
        let path = folder.join(name);
        gone(&path, fs::remove_file(&path))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_tell_apart_what_differs_and_how_it_is_cut_into_parts() {
        let all =
            [Key::of(&["a", "b"]), Key::of(&["ab"]), Key::of(&["a", "b", ""]), Key::of(&["b", "a"]), Key::of(&[])];
        for (i, a) in all.iter().enumerate() {
            assert_eq!(a.as_str().len(), 32);
            assert!(all[..i].iter().all(|b| a != b));
        }
        assert_eq!(Key::of(&["a", "b"]), all[0]);
    }

    #[test]
    fn what_was_kept_is_found_after_a_kill_but_for_the_torn_line() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (Key::of(&["a"]), Key::of(&["b"]));
        let mut store = Store::open(folder.path(), false).unwrap();
        store.keep(&a, &1.5).unwrap();
        store.keep(&b, &2.5).unwrap();
        let path = folder.path().join(JOURNAL);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, &text[..text.len() - 5]).unwrap();
        let mut store = Store::open(folder.path(), true).unwrap();
        assert_eq!((store.find::<f64>(&a), store.find::<f64>(&b)), (Some(1.5), None));
        store.keep(&b, &3.5).unwrap();
        let store = Store::open(folder.path(), true).unwrap();
        assert_eq!((store.find::<f64>(&a), store.find::<f64>(&b)), (Some(1.5), Some(3.5)));
    }

    #[test]
    fn without_resume_an_earlier_sweep_is_cleared_and_a_strangers_folder_is_refused_untouched() {
        let folder = tempfile::tempdir().unwrap();
        let mine = folder.path().join("mine");
        let mut store = Store::open(&mine, false).unwrap();
        store.keep(&Key::of(&["a"]), &1.5).unwrap();
        fs::write(store.path("index.html"), "old").unwrap();
        fs::write(mine.join("notes.txt"), "the user's").unwrap();
        let store = Store::open(&mine, false).unwrap();
        assert!(store.find::<f64>(&Key::of(&["a"])).is_none() && !mine.join("index.html").exists());
        assert!(mine.join("notes.txt").exists());

        let strange = folder.path().join("strange");
        fs::create_dir(&strange).unwrap();
        fs::write(strange.join("index.html"), "the user's").unwrap();
        for resume in [false, true] {
            match Store::open(&strange, resume) {
                Err(Failure::Work(line)) => assert!(line.contains("other files"), "{line}"),
                _ => panic!("a stranger's folder must be refused"),
            }
            assert_eq!(fs::read_dir(&strange).unwrap().count(), 1);
        }
        fs::write(strange.join(JOURNAL), "something else").unwrap();
        assert!(Store::open(&strange, true).is_err());
    }

    #[test]
    fn a_reference_comes_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path(), false).unwrap();
        let value = |i: usize| [0.1 * i as f32, 1e-20, 3e8 + i as f32];
        let image = ReferenceImage {
            width: 3,
            radiance: (0..6).map(value).collect(),
            standard_error: (6..12).map(value).collect(),
            alpha: (0..6).map(|i| i as f32 / 7.0).collect(),
        };
        let key = Key::of(&["r"]);
        store.write_reference(&key, &image).unwrap();
        assert_eq!(store.read_reference(&key).unwrap(), image);
        assert!(store.read_reference(&Key::of(&["s"])).is_err());
    }
}
