//! Where a setting comes from: flag > environment variable > `smoke-bake.toml` > built-in default.
//!
//! Every long option `--max-error` of a subcommand also reads the variable `SMOKE_BAKE_MAX_ERROR` and the key
//! `max-error` in the table of that subcommand, in `smoke-bake.toml` in the working directory:
//!
//! ```toml
//! progress = "plain"       # options of every subcommand stand above the tables
//! [bake]
//! max-error = 0.002
//! ```
//!
//! A value from the file becomes clap's default value, so that clap itself decides which layer wins, and help shows
//! what would be used. Where two options exclude each other, one given by flag or variable switches off the other's
//! value from the file. Names of inputs and outputs are never taken from the lower layers: a forgotten variable must
//! not overwrite a file.

use crate::cli::Cli;
use crate::failure::Failure;
use clap::builder::ArgPredicate;
use clap::{Arg, ArgAction, Command, CommandFactory};
use smoke_formats::{Error, toml_text};
use std::path::Path;
use toml::{Table, Value};

/// The settings file, in the working directory.
pub const FILE_NAME: &str = "smoke-bake.toml";

/// Options that only a flag can set.
const FLAG_ONLY: [&str; 6] = ["help", "version", "output", "screenshot", "standard-error", "image-standard-error"];

/// The command line with the environment and the settings file `path`, if it exists, below it.
pub fn command(path: &Path) -> Result<Command, Failure> {
    let command = with_environment(Cli::command());
    match toml_text::read(path) {
        Ok(text) => Ok(with_file(command, path, &text)?),
        Err(Error::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => Ok(command),
        Err(e) => Err(e.into()),
    }
}

/// Gives every option its variable.
fn with_environment(command: Command) -> Command {
    let command = command.mut_args(|arg| {
        let variable = key(&arg).map(|name| format!("SMOKE_BAKE_{}", name.to_uppercase().replace('-', "_")));
        match variable {
            Some(variable) => arg.env(variable).hide_env(true),
            None => arg,
        }
    });
    command.mut_subcommands(with_environment)
}

/// Gives every option that `text` names its value as the default.
fn with_file(command: Command, path: &Path, text: &str) -> Result<Command, Error> {
    let table: Table = toml::from_str(text).map_err(|e| toml_text::error(path, text, &e))?;
    let mut command = with_table(command, path, text, "", &table)?;
    for (name, value) in &table {
        if let Value::Table(inner) = value {
            if command.find_subcommand(name).is_none() {
                let known: Vec<_> = command.get_subcommands().map(|c| c.get_name().to_owned()).collect();
                return Err(unknown(path, text, name, &known));
            }
            let subcommand = command.find_subcommand(name).cloned().unwrap_or_default();
            let filled = with_table(subcommand, path, text, name, inner)?;
            command = command.mut_subcommand(name, |_| filled);
        }
    }
    Ok(command)
}

/// The values of one table into the options of one command; `prefix` is the table's name, empty at the top.
fn with_table(mut command: Command, path: &Path, text: &str, prefix: &str, table: &Table) -> Result<Command, Error> {
    for (name, value) in table {
        let full = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        if prefix.is_empty() && value.is_table() {
            continue;
        }
        let Some(arg) = command.get_arguments().find(|a| key(a) == Some(name)).cloned() else {
            let known: Vec<_> = command.get_arguments().filter_map(key).map(str::to_owned).collect();
            return Err(unknown(path, text, &full, &known));
        };
        let rivals: Vec<String> =
            command.get_arg_conflicts_with(&arg).iter().filter_map(|a| key(a)).map(str::to_owned).collect();
        let invalid = |found: String, expected: String| {
            Err(Error::invalid(path, format!("{}{full}", toml_text::position(text, &full)), found, expected))
        };
        if let Some(rival) = rivals.iter().find(|r| table.contains_key(*r)) {
            return invalid(format!("also {rival}"), "one of the two".into());
        }
        let written = match value {
            Value::String(s) => s.clone(),
            Value::Integer(_) | Value::Float(_) | Value::Boolean(_) => value.to_string(),
            other => {
                return invalid(format!("a value of type {}", other.type_str()), "text, a number or true/false".into());
            }
        };
        if let Err(reason) = parses(&arg, &written) {
            return invalid(written, reason);
        }
        let ids: Vec<clap::Id> = command.get_arg_conflicts_with(&arg).iter().map(|a| a.get_id().clone()).collect();
        command = command.mut_arg(arg.get_id().clone(), |arg| {
            let off = ids.into_iter().map(|id| (id, ArgPredicate::IsPresent, None::<&str>));
            arg.default_value_ifs(off).default_value(written).required(false)
        });
    }
    Ok(command)
}

/// The name of an option in the lower layers: its long name, if it may be set there.
fn key(arg: &Arg) -> Option<&str> {
    arg.get_long().filter(|long| !FLAG_ONLY.contains(long))
}

/// Whether `value` is one that `arg` accepts; else what it wants. Tried on a command of its own, because a default
/// value that does not parse would be blamed on the command line.
fn parses(arg: &Arg, value: &str) -> Result<(), String> {
    if matches!(arg.get_action(), ArgAction::SetTrue) {
        return value.parse::<bool>().map(|_| ()).map_err(|_| "true or false".into());
    }
    let lone = Arg::new("value").long("value").value_parser(arg.get_value_parser().clone());
    let given = format!("--value={value}");
    let result = Command::new("value").no_binary_name(true).arg(lone).try_get_matches_from([given]);
    result.map(|_| ()).map_err(|e| {
        let choices: Vec<_> = arg.get_possible_values().iter().map(|v| v.get_name().to_owned()).collect();
        if !choices.is_empty() {
            return format!("one of {}", choices.join(", "));
        }
        // clap's first line ends in the reason: error: invalid value 'x' for '--value <value>': REASON
        let text = e.to_string();
        text.lines().next().and_then(|l| l.rsplit_once("': ")).map_or("a valid value", |(_, reason)| reason).to_owned()
    })
}

fn unknown(path: &Path, text: &str, full: &str, known: &[String]) -> Error {
    let name = full.rsplit('.').next().unwrap_or(full);
    let names: Vec<&str> = known.iter().map(String::as_str).collect();
    let guess = toml_text::closest(name, &names).map_or(String::new(), |n| format!("; did you mean `{n}`?"));
    let what = format!("{}{full}", toml_text::position(text, full));
    Error::invalid(path, what, "an unknown key", format!("one of {}{guess}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Args;

    /// Options of every kind: a number with a default, a choice, a flag, two that exclude each other, an output.
    #[derive(Args, Debug, PartialEq)]
    struct Toy {
        #[arg(long, default_value_t = 1)]
        threads: u32,
        #[arg(long, conflicts_with = "psnr")]
        max_error: Option<f64>,
        #[arg(long)]
        psnr: Option<f64>,
        #[arg(long)]
        dry_run: bool,
        #[arg(short, long)]
        output: Option<String>,
    }

    fn toy() -> Command {
        let speed = Arg::new("speed").long("speed").global(true).value_parser(["slow", "fast"]).default_value("slow");
        Command::new("toy").arg(speed).subcommand(Toy::augment_args(Command::new("work")))
    }

    fn parse(file: &str, line: &[&str]) -> Result<(Toy, String), String> {
        let command = with_file(toy(), Path::new("smoke-bake.toml"), file).map_err(|e| e.to_string())?;
        let line = ["toy", "work"].iter().chain(line);
        let matches = command.try_get_matches_from(line).map_err(|e| e.to_string())?;
        let (_, work) = matches.subcommand().unwrap();
        let speed = work.get_one::<String>("speed").unwrap().clone();
        Ok((clap::FromArgMatches::from_arg_matches(work).unwrap(), speed))
    }

    #[test]
    fn without_a_file_the_built_in_defaults_hold() {
        let expected = Toy { threads: 1, max_error: None, psnr: None, dry_run: false, output: None };
        assert_eq!(parse("", &[]).unwrap(), (expected, "slow".into()));
    }

    #[test]
    fn the_file_beats_the_default_and_the_flag_beats_the_file() {
        let file = "speed = \"fast\"\n[work]\nthreads = 4\nmax-error = 0.002\ndry-run = true\n";
        let (toy, speed) = parse(file, &[]).unwrap();
        assert_eq!((toy.threads, toy.max_error, toy.dry_run, speed.as_str()), (4, Some(0.002), true, "fast"));
        let (toy, speed) = parse(file, &["--threads", "7", "--max-error", "0.5", "--speed", "slow"]).unwrap();
        assert_eq!((toy.threads, toy.max_error, speed.as_str()), (7, Some(0.5), "slow"));
    }

    #[test]
    fn a_flag_switches_off_the_files_value_of_the_option_it_excludes() {
        let file = "[work]\nmax-error = 0.002\n";
        let (toy, _) = parse(file, &["--psnr", "47"]).unwrap();
        assert_eq!((toy.max_error, toy.psnr), (None, Some(47.0)));
        let message = parse("[work]\nmax-error = 0.002\npsnr = 3\n", &[]).unwrap_err();
        assert_eq!(
            message,
            "smoke-bake.toml: line 2, column 13: work.max-error: found also psnr, expected one of the two"
        );
    }

    #[test]
    fn unknown_keys_and_bad_values_name_the_file_the_line_and_the_key() {
        let cases = [
            ("[work]\nthraeds = 4", "line 2, column 11: work.thraeds: found an unknown key"),
            ("[work]\nthraeds = 4", "did you mean `threads`?"),
            ("[wrok]\n", "wrok: found an unknown key, expected one of work; did you mean `work`?"),
            ("colour = 3", "colour: found an unknown key, expected one of speed"),
            ("speed = \"medium\"", "line 1, column 9: speed: found medium, expected one of slow, fast"),
            ("[work]\nthreads = \"many\"", "line 2, column 11: work.threads: found many, expected invalid digit"),
            ("[work]\nthreads = -1", "work.threads: found -1"),
            ("[work]\nthreads = [1]", "found a value of type array"),
            ("[work]\ndry-run = 1", "work.dry-run: found 1, expected true or false"),
            ("[work]\noutput = \"a\"", "work.output: found an unknown key"),
            ("[work\n", "line 1"),
        ];
        for (file, expected) in cases {
            let message = parse(file, &[]).expect_err(file);
            assert!(message.starts_with("smoke-bake.toml: "), "{message}");
            assert!(message.contains(expected), "{message}\nshould contain\n{expected}");
        }
    }

    #[test]
    fn every_option_but_outputs_has_its_variable() {
        let command = with_environment(toy());
        let work = command.find_subcommand("work").unwrap();
        let variable = |id: &str| {
            let arg = work.get_arguments().find(|a| a.get_id() == id).unwrap();
            arg.get_env().map(|v| v.to_str().unwrap().to_owned())
        };
        assert_eq!(variable("max_error").as_deref(), Some("SMOKE_BAKE_MAX_ERROR"));
        assert_eq!(variable("output"), None);
    }
}
