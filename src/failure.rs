//! How the program ends when it cannot do what was asked.
//!
//! One line on stderr: which file, what was found, what was expected, what to do. Exit code 1 for bad input or failed
//! work, 2 for a wrong use of the command line (those texts are clap's, with a hint of the usage).

use smoke_formats::Error;
use std::process::ExitCode;

/// Why the program ends early.
#[derive(Debug)]
pub enum Failure {
    /// Bad input, or work that failed. One line.
    Work(String),
    /// The command line does not parse; or it asked for help or the version, which is no failure.
    Usage(clap::Error),
}

impl Failure {
    /// Bad input, or work that failed.
    pub fn work(message: impl Into<String>) -> Self {
        Self::Work(message.into())
    }

    /// Tells the user, and gives the exit code.
    pub fn report(self) -> ExitCode {
        match self {
            Self::Work(message) => {
                eprintln!("smoke-bake: {}", one_line(&message));
                ExitCode::from(1)
            }
            Self::Usage(error) => {
                // If neither stdout nor stderr takes the text, there is nobody left to tell.
                let _ = error.print();
                if error.use_stderr() { ExitCode::from(2) } else { ExitCode::SUCCESS }
            }
        }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        Self::Work(error.to_string())
    }
}

impl From<smoke_baking::Error> for Failure {
    fn from(error: smoke_baking::Error) -> Self {
        Self::Work(error.to_string())
    }
}

impl From<clap::Error> for Failure {
    fn from(error: clap::Error) -> Self {
        Self::Usage(error)
    }
}

/// Line ends and other control characters, which a file may smuggle into a message, become spaces.
fn one_line(message: &str) -> String {
    message.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_from_a_file_cannot_break_the_line_or_paint_the_terminal() {
        assert_eq!(one_line("a\nb\u{1b}[31mc\r"), "a b [31mc ");
    }
}
