//! Options of `render` and `bake` by their long names: which of the two has one, and a value for each turned into the
//! same arguments that the command line gives, by the same parser.
//!
//! Nothing here knows an option by name but for those that are no dials, so that a dial added to `render` or `bake` can
//! be swept as it is.

use crate::cli::{BakeArgs, RenderArgs};
use crate::failure::Failure;
use clap::error::ErrorKind;
use clap::{Args, Command, FromArgMatches};
use smoke_formats::toml_text;
use std::ffi::OsString;
use std::path::Path;

/// Options of `render` that a sweep sets itself, or that change nothing in the picture.
const NO_RENDER_DIALS: [&str; 12] =
    ["scene", "output", "frames", "width", "height", "sigma-t", "albedo", "g", "float", "device", "progress", "json"];

/// Options of `bake` that a sweep sets itself, or that change nothing in the pack. Its threads are those of `render`.
const NO_BAKE_DIALS: [&str; 7] = ["output", "frames", "resume", "dry-run", "threads", "progress", "json"];

/// Options of `render` that change the scene, and with it the reference.
pub const AXES: [&str; 4] = ["sigma-t", "albedo", "g", "order"];

/// Whose option it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// Of `render`: another picture of the same pack.
    Render,
    /// Of `bake`: another pack.
    Bake,
}

/// Values of options by their long names, in the order in which they were first set.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Options(Vec<(String, String)>);

impl Options {
    /// These options and one more, or the same one with another value.
    pub fn with(&self, name: &str, value: &str) -> Self {
        let mut options = self.clone();
        match options.0.iter_mut().find(|(known, _)| known == name) {
            Some((_, old)) => value.clone_into(old),
            None => options.0.push((name.to_owned(), value.to_owned())),
        }
        options
    }

    /// Whether an option is set.
    pub fn has(&self, name: &str) -> bool {
        self.0.iter().any(|(known, _)| known == name)
    }

    /// Name and value of each.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value.as_str()))
    }

    /// Those that are options of `owner`.
    pub fn of(&self, owner: Owner) -> Self {
        Self(self.0.iter().filter(|(name, _)| self::owner(name) == Some(owner)).cloned().collect())
    }

    /// The arguments of `render`. Pack, scene and output are placeholders.
    pub fn render(&self) -> Result<RenderArgs, Failure> {
        let placeholders = ["pack".into(), "--scene=scene".into(), "--output=frame.exr".into()];
        parse(placeholders.to_vec(), self.iter().filter(|(name, _)| owner(name) != Some(Owner::Bake)))
    }

    /// The arguments of `bake` for the frames of `input` named in `frames`, without a word on stderr.
    pub fn bake(&self, input: &Path, output: &Path, frames: &str, resume: bool) -> Result<BakeArgs, Failure> {
        let option = |name: &str, value: &dyn AsRef<std::ffi::OsStr>| {
            let mut argument = OsString::from(name);
            argument.push(value);
            argument
        };
        let mut words = vec![input.into(), option("--output=", &output), option("--frames=", &frames)];
        words.push("--progress=none".into());
        words.extend(resume.then(|| "--resume".into()));
        parse(words, self.iter().filter(|(name, _)| owner(name) == Some(Owner::Bake)))
    }
}

/// Whose dial `name` is; none if it is no dial.
pub fn owner(name: &str) -> Option<Owner> {
    let has = |command: &Command| command.get_arguments().any(|a| a.get_long() == Some(name));
    if !NO_RENDER_DIALS.contains(&name) && has(&command::<RenderArgs>()) {
        Some(Owner::Render)
    } else if !NO_BAKE_DIALS.contains(&name) && has(&command::<BakeArgs>()) {
        Some(Owner::Bake)
    } else {
        None
    }
}

/// The values that an option of `render` can have, if they are a list of names.
pub fn possible_values(name: &str) -> Vec<String> {
    let command = command::<RenderArgs>();
    let argument = command.get_arguments().find(|a| a.get_long() == Some(name));
    let values = argument.map(|a| a.get_possible_values()).unwrap_or_default();
    values.iter().map(|v| v.get_name().to_owned()).collect()
}

/// Wrong usage: `name`, given to `option`, is none of its names.
pub fn unknown(option: &str, name: &str, known: &[&str]) -> Failure {
    let guess = toml_text::closest(name, known).map_or(String::new(), |n| format!("; did you mean {n}?"));
    let text = format!("{option} {name}: expected one of {}{guess}\n", known.join(", "));
    clap::Error::raw(ErrorKind::InvalidValue, text).into()
}

/// All dials: those of `render`, then those of `bake`.
pub fn dials() -> Vec<String> {
    let names = |command: &Command| -> Vec<String> {
        command.get_arguments().filter_map(|a| a.get_long()).map(str::to_owned).collect()
    };
    let mut all = names(&command::<RenderArgs>());
    let bake = names(&command::<BakeArgs>()).into_iter().filter(|n| !all.contains(n)).collect::<Vec<_>>();
    all.extend(bake);
    all.retain(|name| owner(name).is_some());
    all
}

fn command<A: Args>() -> Command {
    A::augment_args(Command::new("smoke-bake sweep").no_binary_name(true))
}

/// The words and the options as the command line would give them. A flag is there (`true`) or not (`false`).
fn parse<'a, A: Args + FromArgMatches>(
    mut words: Vec<OsString>,
    options: impl Iterator<Item = (&'a str, &'a str)>,
) -> Result<A, Failure> {
    let command = command::<A>();
    for (name, value) in options {
        let argument = command.get_arguments().find(|a| a.get_long() == Some(name));
        let flag = argument.is_some_and(|a| !a.get_action().takes_values());
        match (flag, value) {
            (false, _) => words.push(format!("--{name}={value}").into()),
            (true, "true") => words.push(format!("--{name}").into()),
            (true, "false") => {}
            (true, _) => return Err(unknown(&format!("--{name}"), value, &["true", "false"])),
        }
    }
    Ok(A::from_arg_matches(&command.try_get_matches_from(words)?)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::Method;
    use crate::testing::stage;

    fn message(failure: Failure) -> String {
        match failure {
            Failure::Usage(e) => e.to_string(),
            Failure::Work(text) => text,
        }
    }

    #[test]
    fn options_become_the_arguments_that_the_command_line_would_give() {
        let options = Options::default().with("sh-order", "2").with("gaussians", "50").with("sh-order", "3");
        let render = options.render().unwrap();
        assert_eq!((render.sh_order, options.iter().count(), options.has("gaussians")), (Some(3), 2, true));
        let bake = options.bake(Path::new("in.####.vdb"), Path::new("out.smoke"), "-3,5", true).unwrap();
        assert_eq!((bake.gaussians, bake.resume, bake.output.to_str()), (50, true, Some("out.smoke")));
        assert!(bake.frames.is_some());
        let clamp = |value| Options::default().with("clamp", value).bake(Path::new("a"), Path::new("b"), "1", false);
        assert!(clamp("true").unwrap().clamp && !clamp("false").unwrap().clamp);
        assert!(message(clamp("yes").unwrap_err()).contains("true, false"));
    }

    #[test]
    fn ranges_and_conflicts_are_those_of_the_options() {
        let bad = Options::default().with("sh-order", "9").render().unwrap_err();
        assert!(message(bad).contains("9 is not in 1..=6"));
        let args = Options::default().with("exponential", "linear").render().unwrap();
        assert!(message(Method::choose(&args, &stage()).unwrap_err()).contains("--exponential"));
    }

    #[test]
    fn every_option_has_one_owner_and_what_a_sweep_sets_itself_has_none() {
        assert_eq!((owner("sh-order"), owner("threads")), (Some(Owner::Render), Some(Owner::Render)));
        assert_eq!((owner("gaussians"), owner("max-error")), (Some(Owner::Bake), Some(Owner::Bake)));
        for name in ["scene", "output", "frames", "resume", "sigma-t", "help", "sh_order", ""] {
            assert_eq!(owner(name), None, "{name}");
        }
        let dials = dials();
        assert!(dials.iter().any(|d| d == "cutoff") && dials.iter().any(|d| d == "key-every"));
        assert!(AXES.iter().all(|axis| command::<RenderArgs>().get_arguments().any(|a| a.get_long() == Some(axis))));
        assert_eq!(possible_values("route"), ["grid", "centres"]);
        assert!(message(unknown("--dial", "sh_order", &["sh-order", "route"])).contains("did you mean sh-order?"));
    }
}
