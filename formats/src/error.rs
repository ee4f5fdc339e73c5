//! The one error type of the crate: which file, which field, what was found, what was expected.

use std::path::{Path, PathBuf};

/// Result of every reader and writer in this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Why a file could not be read or written. One line each, made to be shown to a user as it is.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The bytes are damaged, or are not what they claim to be.
    #[error("{}: {what}: found {found}, expected {expected}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The field or structure that is wrong.
        what: String,
        /// What the file holds there.
        found: String,
        /// What a good file holds there.
        expected: String,
    },
    /// A legal file that uses something this program does not read.
    #[error("{}: {what}: {found} is not supported; {hint}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The field or structure.
        what: String,
        /// What the file holds there.
        found: String,
        /// What the user can do about it.
        hint: String,
    },
}

impl Error {
    /// An [`Error::Io`] for `path`.
    pub fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    /// An [`Error::Invalid`]; `found` and `expected` are shown as they are.
    pub fn invalid(path: &Path, what: impl Into<String>, found: impl ToString, expected: impl ToString) -> Self {
        let (found, expected) = (found.to_string(), expected.to_string());
        Self::Invalid { path: path.to_owned(), what: what.into(), found, expected }
    }

    /// An [`Error::Unsupported`] with a hint that says what to do.
    pub fn unsupported(path: &Path, what: impl Into<String>, found: impl ToString, hint: impl Into<String>) -> Self {
        let found = found.to_string();
        Self::Unsupported { path: path.to_owned(), what: what.into(), found, hint: hint.into() }
    }
}
