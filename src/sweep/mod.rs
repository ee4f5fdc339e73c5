//! `smoke-bake sweep INPUT --scene SCENE -o DIR`: what every dial costs and buys, against an unbiased reference.
//!
//! | file | what |
//! |---|---|
//! | `options` | options of `render` and `bake` by name, parsed as the command line parses them |
//! | `points` | which settings are measured |
//! | `rungs` | the plan's rungs as points, and the plan's table |
//! | `setting` | scenes with the values of the axes |
//! | `source` | the true density, and the packs |
//! | `measure` | a reference; a point against it |
//! | `store` | the folder, and what a later run finds in it |
//! | `table` | rows as CSV and JSON |
//! | `plot`, `charts`, `page`, `style.css` | the page of plots |
//!
//! For each scene, combination of axes and frame: one reference, then every point. Bakes come first.

mod charts;
mod measure;
mod options;
mod page;
mod plot;
mod points;
mod rungs;
mod setting;
mod source;
mod store;
mod table;

use crate::cli::{RenderArgs, SweepArgs};
use crate::method::Method;
use crate::progress::Progress;
use crate::{answer, failure::Failure, render};
use measure::{Distance, FULL_COLOUR};
use options::{Options, Owner};
use points::Point;
use rayon::ThreadPool;
use rungs::Rows;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use setting::Setting;
use smoke_formats::pack::Pack;
use smoke_formats::{atomic, image};
use smoke_runtime::film::Film;
use smoke_runtime::plan::Survey;
use source::Source;
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use store::{Key, ReferenceImage, Store};
use table::{Figures, Group, Place, ReferenceFigures, Row};

/// Steps of progress of one bake, and of one reference, where one render is a step: about as long on the shipped plume.
const BAKE_STEPS: u64 = 4;
const REFERENCE_STEPS: u64 = 10;

/// What came of a point, as the journal has it.
#[derive(Serialize, Deserialize)]
enum Outcome {
    /// Figures.
    Measured(Box<Figures>),
    /// The method does not take this frame, scene or setting.
    Refused(String),
}

/// Checks everything that was asked, measures it, and writes the three answers.
pub fn run(args: &SweepArgs) -> Result<(), Failure> {
    let base = base(args)?;
    let settings = setting::all(args)?;
    let source = Source::open(args, &base)?;
    let Some(first) = settings.first() else { return Err(Failure::work("no scene")) };
    let dials = match (args.ladder.is_empty(), args.dial.is_empty()) {
        (false, _) => Vec::new(),
        (true, true) => points::usual(source.density_max()),
        (true, false) => args.dial.clone(),
    };
    let points = match args.ladder.is_empty() {
        true => points::expand(&base, &dials, args.grid, &first.stage)?,
        false => rungs::points(args, &base, &settings)?,
    };
    let store = Store::open(&args.output, args.resume)?;
    let mut sweep = Sweep { args, source, points, store, pools: Pools::default(), rungs: Rows::default() };
    let groups = sweep.measure(&settings)?;
    if groups.iter().all(|g| g.rows.is_empty()) {
        let why = groups.iter().flat_map(|g| &g.refused).next().map_or("no points", |[_, _, why]| why);
        return Err(Failure::work(format!("{}: nothing could be measured: {why}", args.input.display())));
    }
    let names: Vec<Value> = dials.iter().map(|d| json!({ "name": d.name, "values": d.values })).collect();
    let asked = json!({
        "input": args.input, "scenes": args.scene, "frames": sweep.source.frames(),
        "dials": names, "grid": args.grid, "ladder": args.ladder,
        "set": base.iter().map(|(name, value)| json!({ "name": name, "value": value })).collect::<Vec<_>>(),
        "vary": args.vary.iter().map(|d| json!({ "name": d.name, "values": d.values })).collect::<Vec<_>>(),
        "reference_error": args.reference_error, "repeat": args.repeat,
        "cores": std::thread::available_parallelism().map_or(1, usize::from),
    });
    sweep.answer(&groups, asked)
}

/// The options that hold throughout: `--set` and the sweep's threads.
fn base(args: &SweepArgs) -> Result<Options, Failure> {
    let pack = source::is_pack(&args.input).then_some(args.input.as_path());
    points::check_names("--dial", &args.dial, pack)?;
    points::check_names("--set", &args.set, pack)?;
    // Not `auto`, which chooses the dials itself.
    let mut base = Options::default().with("method", "compensated");
    if let Some(threads) = args.threads {
        base = base.with("threads", &threads.to_string());
    }
    for set in &args.set {
        let [value] = set.values.as_slice() else {
            let text = format!("--set {}: expected one value; give several to --dial\n", set.name);
            return Err(clap::Error::raw(clap::error::ErrorKind::TooManyValues, text).into());
        };
        base = base.with(&set.name, value);
    }
    Ok(base)
}

/// Pools of threads by their size; 0 is one thread for each core.
#[derive(Default)]
struct Pools(BTreeMap<usize, ThreadPool>);

impl Pools {
    fn get(&mut self, threads: usize) -> Result<&ThreadPool, Failure> {
        match self.0.entry(threads) {
            Entry::Occupied(pool) => Ok(pool.into_mut()),
            Entry::Vacant(place) => {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
                Ok(place.insert(pool.map_err(|e| Failure::work(format!("--threads: {e}")))?))
            }
        }
    }
}

struct Sweep<'a> {
    args: &'a SweepArgs,
    source: Source,
    points: Vec<Point>,
    store: Store,
    pools: Pools,
    /// Of the rungs, for the plan's table.
    rungs: Rows,
}

impl Sweep<'_> {
    /// Bakes, then every group.
    fn measure(&mut self, settings: &[Setting]) -> Result<Vec<Group>, Failure> {
        let mut bakes: Vec<Options> = self.points.iter().map(|p| p.options.of(Owner::Bake)).collect();
        bakes.sort();
        bakes.dedup();
        let groups = (settings.len() * self.source.frames().len()) as u64;
        let point = u64::from(self.args.repeat);
        let steps = BAKE_STEPS * bakes.len() as u64 + groups * (REFERENCE_STEPS + point * self.points.len() as u64);
        let progress = Progress::start(self.args.progress, "sweeping", steps);
        let mut packs = BTreeMap::new();
        for bake in bakes {
            if matches!(self.source, Source::Volumes { .. }) {
                progress.describe(format!("baking {}", words(&bake)).trim_end().to_owned());
            }
            let threads = self.args.threads.unwrap_or(0);
            let (source, store) = (&self.source, &self.store);
            let pack = self.pools.get(threads)?.install(|| source.pack(&bake, store))?;
            packs.insert(bake, pack);
            progress.advance(BAKE_STEPS);
        }
        let mut all = Vec::new();
        for setting in settings {
            for i in 0..self.source.frames().len() {
                all.push(self.group(setting, i, &packs, &progress)?);
            }
        }
        progress.finish();
        Ok(all)
    }

    /// The reference of swept frame `i` under `setting`, and every point against it.
    fn group(
        &mut self,
        setting: &Setting,
        i: usize,
        packs: &BTreeMap<Options, Pack>,
        progress: &Progress,
    ) -> Result<Group, Failure> {
        let place = Place {
            scene: setting.scene.display().to_string(),
            axes: setting.axes.clone(),
            frame: self.source.frames()[i],
        };
        let (key, image, reference) = self.reference(setting, i, progress)?;
        progress.advance(REFERENCE_STEPS);
        // All rungs have the same pack.
        let of_rungs = self.points.iter().find(|point| point.rung.is_some());
        let survey = of_rungs
            .and_then(|point| packs.get(&point.options.of(Owner::Bake)))
            .map(|pack| rungs::survey(pack, self.source.position(i), setting))
            .transpose()?;
        // As the plan's table names it: no folders, and where it is among the axes the row says itself.
        let name = format!("{} {}", setting.scene.file_stem().unwrap_or_default().display(), place.frame);
        if let Some(survey) = &survey {
            let threads = self.pools.get(self.args.threads.unwrap_or(0))?.current_num_threads();
            self.rungs.push_reference(self.args, &name, survey, &reference, threads);
        }
        let (mut rows, mut refused) = (Vec::new(), Vec::new());
        for index in 0..self.points.len() {
            let point = self.points[index].clone();
            let turned =
                if point.value.is_empty() { point.dial.clone() } else { format!("{} {}", point.dial, point.value) };
            progress.describe(format!("frame {}, {turned}", place.frame));
            let bake = point.options.of(Owner::Bake);
            let Some(pack) = packs.get(&bake) else { continue };
            let (picture, outcome) = self.point(setting, i, pack, (&point, survey.as_ref()), (&key, &image))?;
            match outcome {
                Outcome::Measured(figures) => {
                    if let Some(survey) = &survey {
                        self.rungs.push(&name, survey, &point.value, &figures);
                    }
                    rows.push(Row {
                        place: place.clone(),
                        dial: point.dial,
                        value: point.value,
                        bake: words(&bake),
                        figures: *figures,
                        picture,
                    });
                }
                Outcome::Refused(why) => {
                    eprintln!("smoke-bake: note: frame {}, {turned}: left out: {why}", place.frame);
                    refused.push([point.dial, point.value, why]);
                }
            }
            progress.advance(self.args.repeat.into());
        }
        let size = [image.width, image.radiance.len() / image.width];
        Ok(Group { place, size, reference, picture: key, full_colour: FULL_COLOUR, rows, refused })
    }

    fn reference(
        &mut self,
        setting: &Setting,
        i: usize,
        progress: &Progress,
    ) -> Result<(Key, ReferenceImage, ReferenceFigures), Failure> {
        let target = self.args.reference_error;
        let (density, scene) = (self.source.identity(i), setting.identity()?);
        let key = Key::of(&["reference", &density, &scene, &target.to_string()]);
        if let Some(figures) = self.store.find(&key) {
            return Ok((key.clone(), self.store.read_reference(&key)?, figures));
        }
        let frame = self.source.frames()[i];
        let field = self.source.truth(i)?;
        let mut on_pass = |passes: u32, error: f64| {
            progress.describe(format!("frame {frame}, reference, pass {passes}, {:.2} %", 100.0 * error));
        };
        let pool = self.pools.get(self.args.threads.unwrap_or(0))?;
        let traced = pool.install(|| measure::reference(&field, &setting.stage, setting.orders, target, &mut on_pass));
        let (image, figures) = traced?;
        self.store.write_reference(&key, &image)?;
        image::write_png(&self.store.picture(&key), &image.thumbnail())?;
        self.store.keep(&key, &figures)?;
        Ok((key, image, figures))
    }

    fn point(
        &mut self,
        setting: &Setting,
        i: usize,
        pack: &Pack,
        (point, survey): (&Point, Option<&Survey>),
        (reference, truth): (&Key, &ReferenceImage),
    ) -> Result<(Key, Outcome), Failure> {
        let asked: RenderArgs = setting.options(&point.options).render()?;
        // The Debug form has every option: whatever is not the same in it is another point.
        let dials = survey.and_then(|survey| point.rung?.settings_for(survey));
        let (made_by, repeat) = (format!("{asked:?} {dials:?}"), self.args.repeat.to_string());
        let key = Key::of(&["point", reference.as_str(), &format!("{:016x}", pack.checksum()), &made_by, &repeat]);
        if let Some(outcome) = self.store.find(&key) {
            return Ok((key, outcome));
        }
        let (position, repeat) = (self.source.position(i), self.args.repeat);
        let pool = self.pools.get(asked.threads.unwrap_or(0))?;
        let threads = pool.current_num_threads();
        let rendered = match dials
            .map_or_else(|| Method::choose(&asked, &setting.stage), |dials| Ok(Method::of(dials)))
            .map_err(points::conflict)
        {
            Ok(method) => pool
                .install(|| measure::render(pack, position, (&method, asked.detail), &setting.stage, repeat))?
                .map(|rendered| (method, rendered)),
            // Its options do not go with the order of this scene.
            Err(failure) => Err(failure?.to_string().trim_start_matches("error: ").trim().to_owned()),
        };
        let measured = match rendered {
            Ok((method, (film, seconds))) => self.errors(&key, truth, &film)?.map(|errors| (method, seconds, errors)),
            Err(why) => Err(why),
        };
        let outcome = match measured {
            Err(why) => Outcome::Refused(why),
            Ok((method, seconds, d)) => {
                let mut settings = render::document(&method, asked.detail, &setting.stage.scene)["render"].take();
                settings["threads"] = json!(threads);
                let names = ["method", "route"].map(|name| settings[name].as_str().map(str::to_owned));
                let at_rest: u64 = pack.frames().iter().map(|f| f.bytes_at_rest).sum();
                let active: u64 = pack.frames().iter().map(|f| f.active_voxels).sum();
                Outcome::Measured(Box::new(Figures {
                    relative_rmse: d.relative_rmse[0],
                    relative_rmse_standard_error: d.relative_rmse[1],
                    bias: d.bias[0],
                    bias_standard_error: d.bias[1],
                    flip: d.flip,
                    seconds,
                    pack_bytes: pack.file_bytes(),
                    bits_per_active_voxel: 8.0 * at_rest as f64 / active.max(1) as f64,
                    method: names.into_iter().flatten().collect::<Vec<_>>().join(" "),
                    settings,
                }))
            }
        };
        self.store.keep(&key, &outcome)?;
        Ok((key, outcome))
    }

    /// How far a film is from the reference, its thumbnails written; an inner error where that cannot be said.
    fn errors(&self, key: &Key, truth: &ReferenceImage, film: &Film) -> Result<Result<Distance, String>, Failure> {
        let radiance: Vec<[f32; 3]> = film.pixels.iter().map(|p| p.radiance).collect();
        let alpha: Vec<f32> = film.pixels.iter().map(|p| p.alpha()).collect();
        let distance = match truth.distance(&radiance, &alpha) {
            Ok(distance) => distance,
            Err(e) => return Ok(Err(e.to_string())),
        };
        if !distance.relative_rmse.iter().chain(&distance.bias).all(|v| v.is_finite()) {
            return Ok(Err("the reference is black, and the image is not".into()));
        }
        image::write_png(&self.store.picture(key), &truth.exposed(&radiance))?;
        image::write_png(&self.store.difference(key), &truth.false_colour(&radiance, &alpha)?)?;
        Ok(Ok(distance))
    }

    /// Writes CSV, JSON and page, and says where they are.
    fn answer(&self, groups: &[Group], asked: Value) -> Result<(), Failure> {
        let write = |name: &str, text: &str| atomic::write_bytes(&self.store.path(name), text.as_bytes());
        let document = table::json(groups, asked);
        let text = serde_json::to_string_pretty(&document).map_err(|e| Failure::work(format!("sweep.json: {e}")))?;
        write("sweep.csv", &table::csv(groups))?;
        write("sweep.json", &(text + "\n"))?;
        if !self.args.ladder.is_empty() {
            write(store::MEASURED, &self.rungs.csv())?;
        }
        write("index.html", &page::html(groups, &self.args.input, &self.store)?)?;
        if self.args.json {
            return answer::json(&document);
        }
        let rows: usize = groups.iter().map(|g| g.rows.len()).sum();
        let page = self.store.path("index.html");
        answer::text(&format!("{}: {rows} rows against {} references\n", page.display(), groups.len()))
    }
}

/// Options as text: `gaussians=100 max-error=0.01`.
fn words(options: &Options) -> String {
    options.iter().map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join(" ")
}
