//! smoke-bake: bakes smoke sequences into relightable packs, and renders them.

mod answer;
mod bake;
mod cli;
mod compare;
mod compensated;
mod contact_sheet;
mod demo;
mod devices;
mod failure;
mod inspect;
mod layers;
mod marcher;
mod method;
mod pipeline;
mod plan;
mod progress;
mod reference;
mod render;
mod seconds;
mod staging;
mod sweep;
#[cfg(test)]
mod testing;
mod transfer;
mod unpack;
mod validate;
#[cfg(feature = "view")]
mod view;

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
    dispatch(Cli::from_arg_matches(&matches)?.command)
}

/// Does what was asked.
fn dispatch(command: Command) -> Result<(), Failure> {
    match command {
        Command::Bake(args) => bake::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Validate(args) => validate::run(&args),
        Command::Unpack(args) => unpack::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Sweep(args) => sweep::run(&args),
        #[cfg(feature = "view")]
        Command::View(args) => view::run(&args),
        #[cfg(not(feature = "view"))]
        Command::View(_) => {
            Err(Failure::work("view: this program was built without its window; build it with `--features view`"))
        }
        Command::Demo(args) => demo::run(&args),
        Command::Devices(args) => devices::run(&args),
    }
}
