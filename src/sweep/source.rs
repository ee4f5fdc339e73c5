//! What a sweep is made from: a pack, whose own density is then the truth; or volumes, which are the truth themselves,
//! so that the error of a bake is seen, and which every bake dial bakes anew.

use super::options::Options;
use super::store::{Key, Store};
use crate::cli::SweepArgs;
use crate::failure::Failure;
use crate::{bake, cli::BakeArgs};
use smoke_baking::survey::{Survey, read_density, survey};
use smoke_formats::pack::Pack;
use smoke_formats::scene::Scene;
use smoke_formats::sequence::{FrameSelection, Sequence, SequenceFrame};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use std::path::{Path, PathBuf};

/// The density of the frames that are swept.
pub enum Source {
    /// Baked already.
    Pack {
        /// The pack.
        pack: Box<Pack>,
        /// Places of the swept frames in it.
        positions: Vec<usize>,
    },
    /// Volumes, the swept frames alone.
    Volumes {
        /// The sequence as it was given.
        input: PathBuf,
        /// The swept frames, each read once.
        survey: Survey,
    },
}

/// Whether `input` names a pack.
pub fn is_pack(input: &Path) -> bool {
    input.extension().is_some_and(|e| e.eq_ignore_ascii_case("smoke"))
}

impl Source {
    /// Finds the swept frames of the input; reads volumes once.
    pub fn open(args: &SweepArgs, base: &Options) -> Result<Self, Failure> {
        if is_pack(&args.input) {
            let pack = Pack::open(&args.input)?;
            let numbers: Vec<i32> = pack.frames().iter().map(|f| f.frame).collect();
            let positions = chosen(&args.input, args.frames.as_ref(), &numbers)?;
            return Ok(Self::Pack { pack: Box::new(pack), positions });
        }
        let name = args.input.to_str().ok_or_else(|| Failure::work("the input's name is not UTF-8"))?;
        let sequence = Sequence::find(name)?;
        let numbers: Vec<i32> = sequence.frames().iter().map(|f| f.number).collect();
        let positions = chosen(&args.input, args.frames.as_ref(), &numbers)?;
        let frames: Vec<SequenceFrame> = positions.iter().map(|&p| sequence.frames()[p].clone()).collect();
        let BakeArgs { grid, clamp, .. } = base.bake(&args.input, Path::new("pack"), "1", false)?;
        let survey = survey(&frames, &grid, clamp, &|| {})?;
        Ok(Self::Volumes { input: args.input.clone(), survey })
    }

    /// Numbers of the swept frames, ascending.
    pub fn frames(&self) -> Vec<i32> {
        match self {
            Self::Pack { pack, positions } => positions.iter().map(|&p| pack.frames()[p].frame).collect(),
            Self::Volumes { survey, .. } => survey.frames.iter().map(|f| f.number).collect(),
        }
    }

    /// Largest density of the swept volumes; none for a pack, which is baked already.
    pub fn density_max(&self) -> Option<f32> {
        match self {
            Self::Pack { .. } => None,
            Self::Volumes { survey, .. } => Some(survey.density_max),
        }
    }

    /// The true density of swept frame `i`.
    pub fn truth(&self, i: usize) -> Result<DensityField, Failure> {
        match self {
            Self::Pack { pack, positions } => Ok(Frame::read(pack, positions[i])?.field),
            Self::Volumes { survey, .. } => {
                let (grid, _) = read_density(&survey.frames[i].path, &survey.grid, survey.clamp)?;
                Ok(DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index))
            }
        }
    }

    /// What the true density of swept frame `i` depends on.
    pub fn identity(&self, i: usize) -> String {
        match self {
            Self::Pack { pack, positions } => format!("pack {:016x} {}", pack.checksum(), positions[i]),
            Self::Volumes { survey, .. } => {
                let hash = u128::from_le_bytes(survey.frames[i].source_hash);
                format!("volume {hash:032x} {} {}", survey.grid, survey.clamp)
            }
        }
    }

    /// The pack of the bake options `options`: the input itself, or one of the swept frames in the store, baked unless
    /// it is there already.
    pub fn pack(&self, options: &Options, store: &Store) -> Result<Pack, Failure> {
        let (input, survey) = match self {
            Self::Pack { pack, .. } => return Ok(Pack::open(pack.path())?),
            Self::Volumes { input, survey } => (input, survey),
        };
        let sources: Vec<String> = (0..survey.frames.len()).map(|i| self.identity(i)).collect();
        // The medium of transfer is in a file, which may have changed since.
        let medium = match options.bake(input, Path::new("pack"), "1", false)?.medium {
            Some(scene) => format!("{:?}", Scene::read(&scene)?.medium),
            None => String::new(),
        };
        let key = Key::of(&["pack", &sources.join(" "), &format!("{options:?}"), &medium]);
        let path = store.pack(&key);
        if path.exists() {
            return Ok(Pack::open(&path)?);
        }
        let frames: Vec<String> = survey.frames.iter().map(|f| f.number.to_string()).collect();
        bake::pack(&options.bake(input, &path, &frames.join(","), true)?)
    }

    /// Where swept frame `i` is in a pack of [`Self::pack`].
    pub fn position(&self, i: usize) -> usize {
        match self {
            Self::Pack { positions, .. } => positions[i],
            Self::Volumes { .. } => i,
        }
    }
}

/// Places of the frames asked for: those of the selection, or the middle one and the last.
fn chosen(input: &Path, selection: Option<&FrameSelection>, numbers: &[i32]) -> Result<Vec<usize>, Failure> {
    let Some(last) = numbers.len().checked_sub(1) else {
        return Err(Failure::work(format!("{}: found no frames, expected at least 1", input.display())));
    };
    match selection {
        Some(selection) => Ok(selection.positions(input, numbers)?),
        None if last == 0 => Ok(vec![0]),
        None => Ok(vec![numbers.len() / 2, last].into_iter().fold(Vec::new(), |mut all, p| {
            if all.last() != Some(&p) {
                all.push(p);
            }
            all
        })),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_usual_frames_are_the_middle_one_and_the_last_each_once() {
        let path = Path::new("a");
        let usual = |numbers: &[i32]| chosen(path, None, numbers).unwrap();
        assert_eq!((usual(&[5]), usual(&[1, 2]), usual(&[1, 2, 3, 4, 5, 6, 7, 8])), (vec![0], vec![1], vec![4, 7]));
        assert_eq!(chosen(path, Some(&"2-3".parse().unwrap()), &[1, 2, 3]).unwrap(), [1, 2]);
        assert!(chosen(path, None, &[]).is_err() && chosen(path, Some(&"9".parse().unwrap()), &[1]).is_err());
    }

    #[test]
    fn a_pack_is_known_by_its_name() {
        assert!(is_pack(Path::new("a.smoke")) && is_pack(Path::new("b.SMOKE")));
        assert!(!is_pack(Path::new("plume.####.vdb")) && !is_pack(Path::new("smoke")));
    }
}
