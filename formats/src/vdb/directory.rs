//! The grids of a file: their descriptors, their heads, and the choice of one by name.
//!
//! A descriptor is name, tree type, name of the instance parent, and three i64 offsets: the grid's content, its values,
//! its end. Grids of one name are told apart by a record separator (0x1e) and a number, shown as `name[1]`. Half floats
//! are a suffix of the tree type. Source: OpenVDB 12, `io/GridDescriptor.cc`, `io/Archive.cc` (`readGrid`).

use super::header::{self, Metadata, name};
use super::values::{ValueReader, ValueSize, describe, read_flags};
use super::{GridInfo, dense, transform};
use crate::bounded::Bytes;
use crate::{Error, Result};
use glam::DAffine3;

const RECORD_SEPARATOR: char = '\u{1e}';
const HALF_SUFFIX: &str = "_HalfFloat";

/// Where a grid lies and what it is.
#[derive(Clone, Debug)]
pub(super) struct Descriptor {
    unique_name: String,
    tree: String,
    half: bool,
    instance_parent: String,
    content: u64,
    block_pos: Option<u64>,
    end_pos: Option<u64>,
}

impl Descriptor {
    fn read(bytes: &mut Bytes) -> Result<Self> {
        let unique_name = name(bytes, "grid name")?;
        let mut tree = name(bytes, "grid type")?;
        let half = tree.ends_with(HALF_SUFFIX);
        if half {
            tree.truncate(tree.len() - HALF_SUFFIX.len());
        }
        let instance_parent = name(bytes, "instance parent")?;
        Ok(Self { unique_name, tree, half, instance_parent, content: 0, block_pos: None, end_pos: None })
    }

    /// The name without the number that tells it from others of that name.
    pub fn name(&self) -> &str {
        self.unique_name.split(RECORD_SEPARATOR).next().unwrap_or_default()
    }

    /// The name as shown: `density`, or `density[1]`.
    fn shown(&self) -> String {
        match self.unique_name.split_once(RECORD_SEPARATOR) {
            Some((name, number)) => format!("{name}[{number}]"),
            None => self.unique_name.clone(),
        }
    }

    /// The value type in the tree type, such as `vec3s`; the whole tree type if its shape is not 5-4-3.
    fn value_type(&self) -> &str {
        self.tree.strip_prefix("Tree_").and_then(|t| t.strip_suffix("_5_4_3")).unwrap_or(&self.tree)
    }

    /// A cursor at the grid's content that ends where the grid ends, so that no grid reads the bytes of another.
    fn cursor<'a>(&self, bytes: &Bytes<'a>) -> Result<Bytes<'a>> {
        let mut whole = bytes.clone();
        whole.seek(0, "start of the file")?;
        let end = self.end_pos.and_then(|end| usize::try_from(end).ok()).unwrap_or(whole.remaining());
        let mut cursor = Bytes::new(bytes.path(), whole.take(end, "end offset")?);
        cursor.seek(self.content, "grid offset")?;
        Ok(cursor)
    }

    fn value_size(&self) -> Option<ValueSize> {
        ValueSize::of(self.value_type(), self.half).filter(|_| self.value_type() != self.tree)
    }
}

/// All grids of a file.
pub(super) struct Directory {
    grids: Vec<Descriptor>,
    /// Why the rest of a streamed file could not be walked; only an error if the rest is needed.
    stopped: Option<Error>,
}

/// The head of a grid's content, up to its transform.
struct Content<'a> {
    flags: u32,
    metadata: Metadata<'a>,
    map: String,
}

impl<'a> Content<'a> {
    fn read(bytes: &mut Bytes<'a>) -> Result<Self> {
        let flags = read_flags(bytes)?;
        let metadata = Metadata::read(bytes)?;
        Ok(Self { flags, metadata, map: transform::read_kind(bytes)? })
    }
}

impl Directory {
    /// Reads the head of the file and every descriptor.
    pub fn read(bytes: &mut Bytes) -> Result<Self> {
        let header = header::read(bytes)?;
        Metadata::read(bytes)?;
        let count = bytes.count(12 + 24, "grid count")?;
        let mut grids = Vec::with_capacity(count);
        for _ in 0..count {
            let mut grid = Descriptor::read(bytes)?;
            let mut offset = |what| bytes.i64(what).map(|o| u64::try_from(o).unwrap_or(u64::MAX));
            let (content, blocks, end) = (offset("grid offset")?, offset("block offset")?, offset("end offset")?);
            grid.content = bytes.position() as u64;
            if header.has_grid_offsets {
                if content != grid.content {
                    return Err(in_grid(bytes.invalid("grid offset", content, grid.content), &grid.shown()));
                }
                // An instance has no blocks of its own, and its block offset means nothing.
                grid.block_pos = Some(blocks).filter(|_| grid.instance_parent.is_empty());
                grid.end_pos = Some(end);
                // Going back would let a small file loop for ever.
                if end < content || grid.block_pos.is_some_and(|b| !(content..=end).contains(&b)) {
                    let found = format!("content {content}, blocks {blocks}, end {end}");
                    return Err(in_grid(bytes.invalid("offsets", found, "ascending offsets"), &grid.shown()));
                }
                bytes.seek(end, "end offset").map_err(|e| in_grid(e, &grid.shown()))?;
            } else if let Err(error) = skip_content(bytes, &grid) {
                let error = in_grid(error, &grid.shown());
                grids.push(grid);
                return Ok(Self { grids, stopped: Some(error) });
            } else {
                grid.end_pos = Some(bytes.position() as u64);
            }
            grids.push(grid);
        }
        Ok(Self { grids, stopped: None })
    }

    /// The grid called `name`: as shown (`density[1]`), or else the first of that name.
    pub fn find(&self, bytes: &Bytes, name: &str) -> Result<&Descriptor> {
        let shown = self.grids.iter().find(|g| g.shown() == name);
        match (shown.or_else(|| self.grids.iter().find(|g| g.name() == name)), &self.stopped) {
            (Some(grid), _) => Ok(grid),
            (None, Some(stopped)) => {
                Err(bytes.invalid("grid", format!("no '{name}' before: {stopped}"), format!("a grid named '{name}'")))
            }
            (None, None) => {
                let there: Vec<String> = self
                    .grids
                    .iter()
                    .map(|g| format!("{} ({})", g.shown().escape_debug(), g.value_type().escape_debug()))
                    .collect();
                let found = if there.is_empty() { "no grids".to_owned() } else { there.join(", ") };
                Err(bytes.invalid("grid", found, format!("a grid named '{name}'")))
            }
        }
    }

    /// Reads the transform and the voxels of a grid of `self`.
    pub fn read_grid(&self, bytes: &Bytes, grid: &Descriptor) -> Result<(DAffine3, dense::Dense)> {
        self.grid(bytes, grid).map_err(|error| in_grid(error, &grid.shown()))
    }

    fn grid(&self, file: &Bytes, grid: &Descriptor) -> Result<(DAffine3, dense::Dense)> {
        let float = ValueSize::of("float", grid.half);
        let Some(size) = grid.value_size().filter(|s| Some(*s) == float && grid.value_type() == "float") else {
            let hint = "density must be a float grid of the usual 5-4-3 tree (Tree_float_5_4_3)";
            return Err(Error::unsupported(file.path(), "grid type", grid.tree.escape_debug(), hint));
        };
        let mut bytes = grid.cursor(file)?;
        let content = Content::read(&mut bytes)?;
        let world_from_index = transform::read(&mut bytes, &content.map)?;
        if grid.instance_parent.is_empty() {
            let mut reader = ValueReader::new(content.flags, size);
            let voxels = dense::read(&mut bytes, &mut reader, grid.block_pos, grid.end_pos)?;
            return Ok((world_from_index, voxels));
        }
        let parent = self.grids.iter().find(|g| g.unique_name == grid.instance_parent);
        let Some(parent) = parent.filter(|p| p.instance_parent.is_empty()) else {
            let expected = "a grid of this file that is no instance itself";
            return Err(bytes.invalid("instance parent", grid.instance_parent.escape_debug(), expected));
        };
        let (_, voxels) = self.read_grid(file, parent)?;
        Ok((world_from_index, voxels))
    }

    /// What the file says about each of its grids.
    pub fn list(self, bytes: &Bytes) -> Result<Vec<GridInfo>> {
        if let Some(stopped) = self.stopped {
            return Err(stopped);
        }
        let info = |grid: &Descriptor| {
            let content = Content::read(&mut grid.cursor(bytes)?)?;
            Ok(GridInfo {
                name: grid.shown(),
                value_type: grid.value_type().to_owned(),
                class: content.metadata.string("class"),
                active_voxels: content.metadata.int64("file_voxel_count").and_then(|n| u64::try_from(n).ok()),
                half: grid.half,
                compression: describe(content.flags),
                map: content.map,
            })
        };
        self.grids.iter().map(|grid| info(grid).map_err(|error| in_grid(error, &grid.shown()))).collect()
    }
}

/// Steps over a grid of a file without offsets.
fn skip_content(bytes: &mut Bytes, grid: &Descriptor) -> Result<()> {
    let content = Content::read(bytes)?;
    transform::read(bytes, &content.map)?;
    if !grid.instance_parent.is_empty() {
        return Ok(());
    }
    let Some(size) = grid.value_size() else {
        let hint = "a file without grid offsets cannot be read past it; save the file again with offsets";
        return Err(Error::unsupported(bytes.path(), "grid type", grid.tree.escape_debug(), hint));
    };
    dense::skip(bytes, &mut ValueReader::new(content.flags, size))
}

/// The same error, naming the grid.
fn in_grid(error: Error, grid: &str) -> Error {
    let named = |what: String| {
        if what.starts_with("grid '") { what } else { format!("grid '{}': {what}", grid.escape_debug()) }
    };
    match error {
        Error::Invalid { path, what, found, expected } => Error::Invalid { path, what: named(what), found, expected },
        Error::Unsupported { path, what, found, hint } => Error::Unsupported { path, what: named(what), found, hint },
        other => other,
    }
}
