//! Items made one after the other: while one is made, the next is prepared and the one before is finished.
//!
//! Only the making is in turn, so a graphics device that makes waits neither for what comes nor for what was. One item is
//! prepared ahead and no more, whatever is quicker: that bounds the memory.

/// Prepares, makes and finishes the items from 0 to `count`, on the current pool of threads; gives them in their order, or
/// the error that comes first in it.
pub fn run<A: Send, B: Send, C: Send, E: Send>(
    count: usize,
    prepare: impl Fn(usize) -> Result<A, E> + Sync,
    mut make: impl FnMut(usize, A) -> Result<B, E> + Send,
    finish: impl Fn(usize, B) -> Result<C, E> + Sync,
) -> Result<Vec<C>, E> {
    let mut finished = Vec::with_capacity(count);
    let mut prepared = (count > 0).then(|| prepare(0));
    let mut before: Option<B> = None;
    for item in 0..count {
        let ready = prepared.take();
        let (made, (next, last)) = rayon::join(
            || ready.map(|ready| make(item, ready?)).transpose(),
            || {
                let next = || (item + 1 < count).then(|| prepare(item + 1));
                rayon::join(next, || before.take().map(|made| finish(item - 1, made)))
            },
        );
        finished.extend(last.transpose()?);
        before = made?;
        prepared = next;
    }
    finished.extend(before.map(|made| finish(count - 1, made)).transpose()?);
    Ok(finished)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::mpsc::channel;
    use std::sync::{Mutex, PoisonError};
    use std::time::Duration;

    /// Until when a test that hangs has failed.
    const LONG: Duration = Duration::from_secs(60);

    fn pool(threads: usize) -> rayon::ThreadPool {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap()
    }

    #[test]
    fn while_one_is_made_the_next_is_prepared_and_none_after_it() {
        let (count, started, made) = (5, AtomicUsize::new(0), AtomicUsize::new(0));
        let (sender, ready) = channel();
        let sender = Mutex::new(sender);
        let prepare = |item: usize| {
            started.fetch_add(1, Ordering::SeqCst);
            assert!(item <= made.load(Ordering::SeqCst) + 1, "two ahead");
            sender.lock().unwrap_or_else(PoisonError::into_inner).send(item).unwrap();
            Ok(item)
        };
        let finished = &made;
        // Held until the next is ready: a stage that made first and prepared then would never end.
        let make = move |item: usize, prepared: usize| {
            assert_eq!(item, prepared);
            while item + 1 < count && ready.recv_timeout(LONG).map_err(|_| "the next does not come")? <= item {}
            finished.fetch_add(1, Ordering::SeqCst);
            Ok(10 * item)
        };
        let done = pool(2).install(|| run(count, prepare, make, |item, made| Ok::<_, &str>((item, made))));
        assert_eq!(done, Ok((0..count).map(|item| (item, 10 * item)).collect()));
        assert_eq!(started.into_inner(), count);
    }

    #[test]
    fn on_one_thread_too_all_come_in_order_and_the_first_error_ends_it() {
        let go = |count, bad: [usize; 3]| {
            let refuse = |item: usize, stage: usize| if item == bad[stage] { Err((stage, item)) } else { Ok(item) };
            pool(1).install(|| run(count, |i| refuse(i, 0), |i, _| refuse(i, 1), |i, _| refuse(i, 2)))
        };
        assert_eq!(go(0, [9; 3]), Ok(vec![]));
        assert_eq!(go(1, [9; 3]), Ok(vec![0]));
        assert_eq!(go(4, [9; 3]), Ok(vec![0, 1, 2, 3]));
        assert_eq!(go(4, [3, 9, 9]), Err((0, 3)));
        assert_eq!(go(4, [2, 1, 9]), Err((1, 1)));
        assert_eq!(go(4, [9, 2, 1]), Err((2, 1)), "the item before comes first");
    }
}
