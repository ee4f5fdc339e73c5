//! Progress of long work, on stderr: a bar for a person, lines for a log, `openjd_` lines for a farm.
//!
//! Open Job Description reads `openjd_progress: 12.5` (per cent) and `openjd_status: text` from stdout and stderr
//! alike; they go to stderr, so that stdout holds the answer alone.

use crate::cli::ProgressMode;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Least time between two lines.
const PAUSE: Duration = Duration::from_secs(3);

/// Progress of one piece of work. May be advanced from several threads.
pub struct Progress {
    shown: Shown,
}

enum Shown {
    Bar(ProgressBar),
    Lines(Instant, Mutex<Lines>),
    Nothing,
}

/// Progress as lines in a log.
struct Lines {
    out: Box<dyn Write + Send>,
    openjd: bool,
    what: String,
    done: u64,
    total: u64,
    last: Option<Duration>,
}

impl Progress {
    /// Starts `what` (a verb and a noun: `fitting frames`) of `total` steps, on stderr.
    pub fn start(mode: ProgressMode, what: &str, total: u64) -> Self {
        let bar = match mode {
            ProgressMode::None => return Self { shown: Shown::Nothing },
            ProgressMode::Auto => std::io::stderr().is_terminal(),
            ProgressMode::Bar => true,
            ProgressMode::Plain | ProgressMode::Openjd => false,
        };
        if bar {
            let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr());
            let style = "{msg} {wide_bar} {pos}/{len} {per_sec} {eta} left";
            // The template is a constant that parses; the plain bar is what there is if it ever does not.
            bar.set_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_message(what.to_owned());
            return Self { shown: Shown::Bar(bar) };
        }
        let mut lines = Lines::new(Box::new(std::io::stderr()), mode == ProgressMode::Openjd, what, total);
        lines.status();
        Self { shown: Shown::Lines(Instant::now(), Mutex::new(lines)) }
    }

    /// `steps` more are done.
    pub fn advance(&self, steps: u64) {
        match &self.shown {
            Shown::Bar(bar) => bar.inc(steps),
            Shown::Lines(start, lines) => {
                // A panic in another thread ends the program anyway; the count is still good to show.
                lines.lock().unwrap_or_else(|e| e.into_inner()).advance(steps, start.elapsed());
            }
            Shown::Nothing => {}
        }
    }

    /// What is being done now, within a step.
    pub fn describe(&self, what: String) {
        match &self.shown {
            Shown::Bar(bar) => bar.set_message(what),
            Shown::Lines(start, lines) => {
                let mut lines = lines.lock().unwrap_or_else(|e| e.into_inner());
                lines.what = what;
                lines.advance(0, start.elapsed());
            }
            Shown::Nothing => {}
        }
    }

    /// Ends the bar and leaves its line.
    pub fn finish(self) {
        if let Shown::Bar(bar) = self.shown {
            bar.finish();
        }
    }
}

impl Lines {
    fn new(out: Box<dyn Write + Send>, openjd: bool, what: &str, total: u64) -> Self {
        Self { out, openjd, what: what.to_owned(), done: 0, total, last: None }
    }

    fn status(&mut self) {
        if self.openjd {
            let what = self.what.clone();
            self.line(&format!("openjd_status: {what}"));
        }
    }

    /// A line if it is time for one, and always one for the last step.
    fn advance(&mut self, steps: u64, elapsed: Duration) {
        self.done += steps;
        let due = self.last.is_none_or(|last| elapsed >= last + PAUSE);
        if !due && self.done < self.total {
            return;
        }
        self.last = Some(elapsed);
        let percent = if self.total == 0 { 100.0 } else { 100.0 * self.done as f64 / self.total as f64 };
        let line = if self.openjd {
            format!("openjd_progress: {:.1}", percent.min(100.0))
        } else {
            let rate = self.done as f64 / elapsed.as_secs_f64().max(1e-3);
            let counts = format!("{}/{} ({percent:.1} %)", self.done, self.total);
            if self.done == 0 {
                // No rate yet, so nothing is known of the time left.
                format!("{}: {counts}", self.what)
            } else {
                let left = self.total.saturating_sub(self.done) as f64 / rate;
                format!("{}: {counts}, {rate:.2}/s, {left:.0} s left", self.what)
            }
        };
        self.line(&line);
    }

    fn line(&mut self, line: &str) {
        // Progress that nobody can read is no reason to stop the work.
        let _ = writeln!(self.out, "{line}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    /// A sink that the test can read afterwards.
    #[derive(Clone, Default)]
    struct Sink(Arc<Mutex<Vec<u8>>>);

    impl Write for Sink {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn lines_of(openjd: bool, steps: &[(u64, u64)]) -> Vec<String> {
        let sink = Sink::default();
        let mut lines = Lines::new(Box::new(sink.clone()), openjd, "fitting frames", 8);
        lines.status();
        steps.iter().for_each(|&(steps, millis)| lines.advance(steps, Duration::from_millis(millis)));
        let bytes = sink.0.lock().unwrap().clone();
        String::from_utf8(bytes).unwrap().lines().map(str::to_owned).collect()
    }

    #[test]
    fn lines_come_at_most_every_few_seconds_and_the_last_step_always_has_one() {
        let lines = lines_of(false, &[(1, 2000), (1, 2500), (1, 4999), (1, 5000), (3, 5001), (1, 5002)]);
        let expected = [
            "fitting frames: 1/8 (12.5 %), 0.50/s, 14 s left",
            "fitting frames: 4/8 (50.0 %), 0.80/s, 5 s left",
            "fitting frames: 8/8 (100.0 %), 1.60/s, 0 s left",
        ];
        assert_eq!(lines, expected);
    }

    #[test]
    fn open_job_description_reads_its_own_lines() {
        let lines = lines_of(true, &[(1, 0), (7, 1)]);
        assert_eq!(lines, ["openjd_status: fitting frames", "openjd_progress: 12.5", "openjd_progress: 100.0"]);
    }

    #[test]
    fn every_mode_counts_to_the_end_from_several_threads() {
        for mode in
            [ProgressMode::None, ProgressMode::Auto, ProgressMode::Bar, ProgressMode::Plain, ProgressMode::Openjd]
        {
            let progress = Progress::start(mode, "testing", 4);
            std::thread::scope(|scope| (0..4).for_each(|_| drop(scope.spawn(|| progress.advance(1)))));
            if let Shown::Lines(_, lines) = &progress.shown {
                assert_eq!(lines.lock().unwrap().done, 4);
            }
            progress.finish();
        }
    }
}
