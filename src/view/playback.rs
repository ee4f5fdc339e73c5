//! Frames decoded and uploaded ahead of the playhead, on threads of their own, so that playback waits for pictures alone.
//!
//! The frame at the playhead comes first, then those after it in the order of playback, round the end; what lies farthest
//! behind in that order makes room. How many are kept in memory follows from [`BYTES`] and the size of the sequence's box.
//! The nearest of them are on the graphics device too, where there is one: as many as [`DEVICE_BYTES`] hold of the largest
//! so far, so that a loop of a sequence that fits uploads nothing twice. What the renderers draw with comes on top.

use crate::devices::{Device, DeviceFrame};
use rayon::ThreadPoolBuilder;
use smoke_formats::pack::Pack;
use smoke_runtime::medium::frame::Frame;
use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// Memory for decoded frames.
const BYTES: u64 = 1 << 30;
/// A graphics device's memory for frames that wait there for their turn.
const DEVICE_BYTES: u64 = 256 << 20;
/// Fewest frames that are kept, however large: the one that is shown, and the next.
const FEWEST: usize = 2;
/// Threads that read, decode and upload: half of the machine's, within these.
const THREADS: [usize; 2] = [2, 8];

/// A decoded frame, or why there is none.
type Decoded = Result<Arc<Frame>, String>;
/// A frame where it is drawn from, or why there is none.
pub type Ready = Result<DeviceFrame, String>;

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
    /// The nearest of them, with the device.
    ready: HashMap<usize, Ready>,
    /// Bytes for those, and of the largest so far.
    device_bytes: u64,
    largest: u64,
    busy: HashSet<usize>,
    closed: bool,
}

impl Reel {
    /// None yet of the `count` frames of a box of `dims` voxels, from `playhead` on.
    fn new(count: usize, dims: [u32; 3], device_bytes: u64, playhead: usize) -> Self {
        let (decoded, ready, busy) = (HashMap::new(), HashMap::new(), HashSet::new());
        let (kept, largest) = (kept(dims, count), frame_bytes(dims));
        Self { count, kept, playhead, decoded, ready, device_bytes, largest, busy, closed: false }
    }

    /// Steps from the playhead to a frame in the order of playback.
    fn ahead(&self, position: usize) -> usize {
        (position + self.count - self.playhead) % self.count.max(1)
    }

    /// True for frames that belong on the device.
    fn is_near(&self, position: usize) -> bool {
        self.ahead(position) < fitting(self.device_bytes, self.largest, self.kept)
    }

    /// The frame to decode or upload next.
    fn next(&self) -> Option<usize> {
        let mut wanted = (0..self.kept.min(self.count)).map(|step| (self.playhead + step) % self.count);
        let is_done = |p: usize| self.decoded.contains_key(&p) && (self.ready.contains_key(&p) || !self.is_near(p));
        wanted.find(|&p| !is_done(p) && !self.busy.contains(&p))
    }

    /// Keeps a decoded frame, and what the device made of it, if it was asked; drops those that lie farthest ahead.
    fn keep(&mut self, position: usize, frame: Decoded, ready: Option<Ready>) {
        self.busy.remove(&position);
        self.decoded.insert(position, frame);
        while self.decoded.len() > self.kept {
            let Some(farthest) = self.decoded.keys().copied().max_by_key(|&p| self.ahead(p)) else { break };
            self.decoded.remove(&farthest);
        }
        if let Some(ready) = ready {
            let bytes = ready.as_ref().map_or(0, DeviceFrame::device_bytes);
            self.largest = self.largest.max(bytes);
            self.ready.insert(position, ready);
        }
        self.drop_far();
    }

    /// Frees the device of frames that are not near any more.
    fn drop_far(&mut self) {
        let mut ready = std::mem::take(&mut self.ready);
        ready.retain(|&position, _| self.is_near(position));
        self.ready = ready;
    }
}

impl Shared {
    fn reel(&self) -> MutexGuard<'_, Reel> {
        self.reel.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Playback {
    /// Begins to decode `pack` from `playhead` on, with the frames' transfer if `with_transfer`, and to take frames to
    /// `device`. `told` is called when a frame is ready.
    pub fn start(
        pack: Arc<Pack>,
        with_transfer: bool,
        device: Device,
        playhead: usize,
        told: impl Fn() + Send + Sync + 'static,
    ) -> Self {
        let count = pack.frames().len();
        // What the processor draws from is there once it is decoded.
        let device_bytes = if device.is_graphics() { DEVICE_BYTES } else { u64::MAX };
        let reel = Reel::new(count, pack.sequence().dims, device_bytes, playhead);
        let shared = Arc::new(Shared { reel: Mutex::new(reel), wake: Condvar::new() });
        let told = Arc::new(told);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        for _ in 0..(cores / 2).clamp(THREADS[0], THREADS[1]) {
            let (shared, pack, device, told) = (shared.clone(), pack.clone(), device.clone(), told.clone());
            std::thread::spawn(move || {
                // A pool of its own: among the renderer's work a frame would wait for a whole picture.
                let pool = ThreadPoolBuilder::new().num_threads(1).build();
                while let Some((position, decoded)) = next(&shared) {
                    let work = || {
                        let read = || match with_transfer {
                            true => Frame::read_with_transfer(&pack, position),
                            false => Frame::read(&pack, position),
                        };
                        let frame = decoded.unwrap_or_else(|| read().map(Arc::new).map_err(|e| e.to_string()));
                        let is_near = shared.reel().is_near(position);
                        let ready = is_near.then(|| frame.clone().and_then(|frame| device.take(frame)));
                        (frame, ready)
                    };
                    let (frame, ready) = match &pool {
                        Ok(pool) => pool.install(work),
                        Err(_) => work(),
                    };
                    shared.reel().keep(position, frame, ready);
                    told();
                }
            });
        }
        Self { shared, count }
    }

    /// Frames of the pack.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Moves the playhead, and gives the frame there if it is where it is drawn from.
    pub fn at(&self, position: usize) -> Option<Ready> {
        let mut reel = self.shared.reel();
        if reel.playhead != position {
            reel.playhead = position;
            reel.drop_far();
            self.shared.wake.notify_all();
        }
        reel.ready.get(&position).cloned()
    }

    /// True if the frame at `position` is where it is drawn from; the playhead stays.
    pub fn has(&self, position: usize) -> bool {
        self.shared.reel().ready.contains_key(&position)
    }

    /// Frames that are decoded, and how many of them are kept at most.
    pub fn fill(&self) -> (usize, usize) {
        let reel = self.shared.reel();
        (reel.decoded.len(), reel.kept.min(reel.count))
    }

    /// Frames that are where they are drawn from.
    pub fn ready(&self) -> usize {
        self.shared.reel().ready.len()
    }
}

impl Drop for Playback {
    fn drop(&mut self) {
        self.shared.reel().closed = true;
        self.shared.wake.notify_all();
    }
}

/// Waits for a frame that is wanted, and takes it on, with what is decoded of it; none when all is over.
fn next(shared: &Shared) -> Option<(usize, Option<Decoded>)> {
    let mut reel = shared.reel();
    loop {
        if reel.closed {
            return None;
        }
        if let Some(position) = reel.next() {
            reel.busy.insert(position);
            return Some((position, reel.decoded.get(&position).cloned()));
        }
        reel = shared.wake.wait(reel).unwrap_or_else(PoisonError::into_inner);
    }
}

/// Bytes of the density of a frame of `dims` voxels: four a node.
fn frame_bytes(dims: [u32; 3]) -> u64 {
    dims.iter().map(|&d| u64::from(d) + 2).product::<u64>().saturating_mul(4).max(1)
}

/// How many frames of `each` bytes fit into `bytes`, of `most` that are wanted.
fn fitting(bytes: u64, each: u64, most: usize) -> usize {
    ((bytes / each.max(1)) as usize).clamp(FEWEST, most.max(FEWEST))
}

/// How many of `count` frames of `dims` voxels are kept in [`BYTES`].
fn kept(dims: [u32; 3], count: usize) -> usize {
    fitting(BYTES, frame_bytes(dims), count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{devices, small_pack};
    use std::path::Path;
    use std::time::{Duration, Instant};

    const DIMS: [u32; 3] = [4, 3, 2];

    fn reel(count: usize, kept: usize, playhead: usize) -> Reel {
        Reel { kept, ..Reel::new(count, DIMS, u64::MAX, playhead) }
    }

    fn sorted<T>(frames: &HashMap<usize, T>) -> Vec<usize> {
        let mut positions: Vec<_> = frames.keys().copied().collect();
        positions.sort_unstable();
        positions
    }

    /// Does all that is wanted, with messages in place of frames; gives the frames in the order of the work.
    fn fill(reel: &mut Reel) -> Vec<usize> {
        let mut order = Vec::new();
        while let Some(position) = reel.next() {
            order.push(position);
            let ready = reel.is_near(position).then(|| Err(String::new()));
            reel.keep(position, Err(String::new()), ready);
        }
        order
    }

    fn playback(folder: &Path, frames: i32, device: Device) -> (Arc<Pack>, Playback) {
        let path = folder.join("a.smoke");
        small_pack(&path, &(1..=frames).collect::<Vec<_>>(), 0.01);
        let pack = Arc::new(Pack::open(&path).unwrap());
        (pack.clone(), Playback::start(pack, false, device, 0, || {}))
    }

    fn until(what: &str, done: impl Fn() -> bool) {
        let start = Instant::now();
        while !done() {
            assert!(start.elapsed() < Duration::from_secs(20), "{what} does not come");
            std::thread::yield_now();
        }
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
            reel.keep(position, Err(String::new()), None);
        }
        reel.playhead = 1;
        reel.keep(3, Err(String::new()), None);
        assert_eq!(sorted(&reel.decoded), [1, 2, 3]);
    }

    #[test]
    fn the_device_holds_the_nearest_frames_and_no_more_than_there_is_room_for() {
        let mut reel = Reel::new(6, DIMS, 3 * frame_bytes(DIMS) + 1, 4);
        assert_eq!(fill(&mut reel), [4, 5, 0, 1, 2, 3]);
        assert_eq!((sorted(&reel.ready), reel.decoded.len()), (vec![0, 4, 5], 6));
        reel.playhead = 5;
        reel.drop_far();
        assert_eq!(sorted(&reel.ready), [0, 5], "what was played makes room");
        assert_eq!(fill(&mut reel), [1], "and is filled up by what is decoded already");
        assert_eq!(sorted(&reel.ready), [0, 1, 5]);
        // Frames that are larger than they seemed.
        reel.largest = reel.device_bytes;
        reel.drop_far();
        assert_eq!((sorted(&reel.ready), fill(&mut reel)), (vec![0, 5], vec![]), "the one that is shown, and the next");
    }

    #[test]
    fn while_a_frame_is_drawn_all_that_there_is_room_for_come_and_a_loop_uploads_nothing_twice() {
        for device in devices() {
            let folder = tempfile::tempdir().unwrap();
            let (pack, playback) = playback(folder.path(), 5, device.clone());
            until("the first frame", || playback.at(0).is_some());
            // Somebody draws it all the while.
            let held = playback.at(0).unwrap().unwrap();
            until("the others", || playback.ready() == 5);
            let mut before: Vec<DeviceFrame> = Vec::new();
            for step in 0..10 {
                assert!(playback.has(step % 5));
                let frame = playback.at(step % 5).expect("it is there when it is asked for").unwrap();
                let expected = Frame::read(&pack, step % 5).unwrap();
                assert_eq!(frame.frame().field.values, expected.field.values);
                assert_eq!(frame.device_bytes() > 0, device.is_graphics());
                let same = |a: &DeviceFrame, b: &DeviceFrame| match (a, b) {
                    (DeviceFrame::Cpu(a), DeviceFrame::Cpu(b)) => Arc::ptr_eq(a, b),
                    (DeviceFrame::Gpu(a), DeviceFrame::Gpu(b)) => Arc::ptr_eq(a, b),
                    _ => false,
                };
                assert!(before.get(step % 5).is_none_or(|before| same(before, &frame)));
                before.push(frame);
            }
            drop(held);
        }
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
            let playback = Playback::start(pack.clone(), false, Device::Cpu, 0, || {});
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
                    Ok(frame) => {
                        assert_eq!(frame.frame().field.values, Frame::read(&pack, position).unwrap().field.values)
                    }
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
