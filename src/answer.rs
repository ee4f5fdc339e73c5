//! Answers go to stdout, and nothing else does.

use crate::failure::Failure;
use serde::Serialize;
use std::io::{ErrorKind, Write};

/// Prints text. A reader that has seen enough (`| head`) is no failure.
pub fn text(text: &str) -> Result<(), Failure> {
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Failure::work(format!("stdout: {e}"))),
        _ => Ok(()),
    }
}

/// Prints one JSON document. Infinite and undefined numbers are `null`.
pub fn json(value: &impl Serialize) -> Result<(), Failure> {
    let document = serde_json::to_string_pretty(value).map_err(|e| Failure::work(format!("JSON: {e}")))?;
    text(&(document + "\n"))
}
