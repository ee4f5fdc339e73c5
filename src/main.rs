//! smoke-bake: bakes smoke sequences into relightable packs, and renders them.

mod answer;
mod cli;
mod compare;
#[cfg_attr(not(test), expect(dead_code, reason = "`demo` shows its frames with it"))]
mod contact_sheet;
mod failure;
mod inspect;
mod layers;
mod progress;
mod render;
#[cfg_attr(not(test), expect(dead_code, reason = "`bake` writes through it"))]
mod seconds;
#[cfg(test)]
mod testing;
mod unpack;
mod validate;

use clap::FromArgMatches;
use cli::{Cli, Command};
use failure::Failure;
use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}

/// Settings file, environment and flags into one command; then the command.
fn run() -> Result<(), Failure> {
    let command = layers::command(Path::new(layers::FILE_NAME))?;
    let matches = command.try_get_matches()?;
    match Cli::from_arg_matches(&matches)?.command {
        Command::Compare(args) => compare::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Validate(args) => validate::run(&args),
        Command::Unpack(args) => unpack::run(&args),
        Command::Render(args) => render::run(&args),
    }
}
