//! Frames decoded ahead of the playhead, on threads of their own, so that playback waits for pictures alone.
//!
//! The frame at the playhead comes first, then those after it in the order of playback, round the end; what lies farthest
//! behind in that order makes room. How many are kept follows from [`BYTES`] and the size of the sequence's box.

use rayon::ThreadPoolBuilder;
use smoke_formats::pack::Pack;
use smoke_runtime::medium::frame::Frame;
use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// Memory for decoded frames.
const BYTES: u64 = 1 << 30;
/// Fewest frames that are kept, however large: the one that is shown, and the next.
const FEWEST: usize = 2;
/// Threads that read and decode: half of the machine's, within these.
const THREADS: [usize; 2] = [2, 8];

/// A decoded frame, or why there is none.
pub type Decoded = Result<Arc<Frame>, String>;

/// See the module's head. Ends with its threads when it is dropped.
pub struct Playback {
    shared: Arc<Shared>,
    count: usize,
}

struct Shared {
    reel: Mutex<Reel>,
    wake: Condvar,
}

/// Which frames there are, and which are wanted.
struct Reel {
    count: usize,
    /// How many frames are kept.
    kept: usize,
    playhead: usize,
    decoded: HashMap<usize, Decoded>,
    busy: HashSet<usize>,
    closed: bool,
}

impl Reel {
    /// Steps from the playhead to a frame in the order of playback.
    fn ahead(&self, position: usize) -> usize {
        (position + self.count - self.playhead) % self.count.max(1)
    }

    /// The frame to decode next.
    fn next(&self) -> Option<usize> {
        let wanted = (0..self.kept.min(self.count)).map(|step| (self.playhead + step) % self.count);
        wanted.into_iter().find(|p| !self.decoded.contains_key(p) && !self.busy.contains(p))
    }

    /// Keeps a decoded frame and drops those that lie farthest ahead.
    fn keep(&mut self, position: usize, frame: Decoded) {
        self.busy.remove(&position);
        self.decoded.insert(position, frame);
        while self.decoded.len() > self.kept {
            let Some(farthest) = self.decoded.keys().copied().max_by_key(|&p| self.ahead(p)) else { break };
            self.decoded.remove(&farthest);
        }
    }
}

impl Shared {
    fn reel(&self) -> MutexGuard<'_, Reel> {
        self.reel.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Playback {
    /// Begins to decode `pack` from `playhead` on, with the frames' transfer if `with_transfer`. `decoded` is called when
    /// a frame is ready.
    pub fn start(
        pack: Arc<Pack>,
        with_transfer: bool,
        playhead: usize,
        decoded: impl Fn() + Send + Sync + 'static,
    ) -> Self {
        let count = pack.frames().len();
        let kept = kept(pack.sequence().dims, count);
        let (decoded_frames, busy) = (HashMap::new(), HashSet::new());
        let reel = Reel { count, kept, playhead, decoded: decoded_frames, busy, closed: false };
        let shared = Arc::new(Shared { reel: Mutex::new(reel), wake: Condvar::new() });
        let ready = Arc::new(decoded);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        for _ in 0..(cores / 2).clamp(THREADS[0], THREADS[1]) {
            let (shared, pack, ready) = (shared.clone(), pack.clone(), ready.clone());
            std::thread::spawn(move || {
                // A pool of its own: among the renderer's work a frame would wait for a whole picture.
                let pool = ThreadPoolBuilder::new().num_threads(1).build();
                while let Some(position) = next(&shared) {
                    let read = || match with_transfer {
                        true => Frame::read_with_transfer(&pack, position),
                        false => Frame::read(&pack, position),
                    };
                    let frame = match &pool {
                        Ok(pool) => pool.install(read),
                        Err(_) => read(),
                    };
                    shared.reel().keep(position, frame.map(Arc::new).map_err(|e| e.to_string()));
                    ready();
                }
            });
        }
        Self { shared, count }
    }

    /// Frames of the pack.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Moves the playhead, and gives the frame there if it is decoded.
    pub fn at(&self, position: usize) -> Option<Decoded> {
        let mut reel = self.shared.reel();
        if reel.playhead != position {
            reel.playhead = position;
            self.shared.wake.notify_all();
        }
        reel.decoded.get(&position).cloned()
    }

    /// Frames that are decoded, and how many of them are kept at most.
    pub fn fill(&self) -> (usize, usize) {
        let reel = self.shared.reel();
        (reel.decoded.len(), reel.kept.min(reel.count))
    }
}

impl Drop for Playback {
    fn drop(&mut self) {
        self.shared.reel().closed = true;
        self.shared.wake.notify_all();
    }
}

/// Waits for a frame that is wanted, and takes it on; none when all is over.
fn next(shared: &Shared) -> Option<usize> {
    let mut reel = shared.reel();
    loop {
        if reel.closed {
            return None;
        }
        if let Some(position) = reel.next() {
            reel.busy.insert(position);
            return Some(position);
        }
        reel = shared.wake.wait(reel).unwrap_or_else(PoisonError::into_inner);
    }
}

/// How many frames of `dims` voxels fit into [`BYTES`]: four bytes a voxel.
fn kept(dims: [u32; 3], count: usize) -> usize {
    let frame = dims.iter().map(|&d| u64::from(d) + 2).product::<u64>().saturating_mul(4).max(1);
    ((BYTES / frame) as usize).clamp(FEWEST, count.max(FEWEST))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_pack;
    use std::time::{Duration, Instant};

    fn reel(count: usize, kept: usize, playhead: usize) -> Reel {
        Reel { count, kept, playhead, decoded: HashMap::new(), busy: HashSet::new(), closed: false }
    }

    #[test]
    fn the_frame_at_the_playhead_comes_first_then_those_after_it_round_the_end() {
        let mut reel = reel(5, 4, 3);
        let mut order = Vec::new();
        while let Some(position) = reel.next() {
            reel.busy.insert(position);
            order.push(position);
        }
        assert_eq!(order, [3, 4, 0, 1]);
        reel.playhead = 1;
        assert_eq!(reel.next(), Some(2), "what is being decoded is not begun again");
        assert_eq!(self::reel(0, 2, 0).next(), None);
    }

    #[test]
    fn what_was_just_played_makes_room_for_what_comes() {
        let mut reel = reel(6, 3, 0);
        for position in [0, 1, 2] {
            reel.keep(position, Err(String::new()));
        }
        reel.playhead = 1;
        reel.keep(3, Err(String::new()));
        let mut kept: Vec<_> = reel.decoded.keys().copied().collect();
        kept.sort_unstable();
        assert_eq!(kept, [1, 2, 3]);
    }

    #[test]
    fn huge_frames_leave_two_and_small_ones_all() {
        assert_eq!((kept([1 << 16; 3], 50), kept([4, 3, 2], 50), kept([98, 98, 128], 64)), (FEWEST, 50, 64));
        assert_eq!(kept([98, 98, 128], 1000), (BYTES / (100 * 100 * 130 * 4)) as usize);
    }

    #[test]
    fn all_frames_of_a_pack_come_and_a_damaged_one_says_why() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.smoke");
        small_pack(&path, &[1, 2, 3], 0.01);
        let whole = std::fs::read(&path).unwrap();
        for damage in [false, true] {
            let mut bytes = whole.clone();
            if damage {
                let section = Pack::open(&path).unwrap().sections().iter().find(|s| s.frames > 0).unwrap().offset;
                bytes[section as usize] ^= 1;
            }
            let pack = Arc::new(Pack::from_bytes(&path, bytes).unwrap());
            let playback = Playback::start(pack.clone(), false, 0, || {});
            let start = Instant::now();
            let mut failed = 0;
            for position in [2, 0, 1] {
                let frame = loop {
                    if let Some(frame) = playback.at(position) {
                        break frame;
                    }
                    assert!(start.elapsed() < Duration::from_secs(20));
                    std::thread::yield_now();
                };
                match frame {
                    Ok(frame) => assert_eq!(frame.field.values, Frame::read(&pack, position).unwrap().field.values),
                    Err(message) => {
                        assert!(message.contains("a.smoke"), "{message}");
                        failed += 1;
                    }
                }
            }
            assert_eq!(failed > 0, damage);
        }
    }
}
