//! Measured errors and seconds of the rungs over scenes, and what they predict for another scene.
//!
//! `measured.csv` is made by `smoke-bake sweep --ladder`, which writes a file of that name in this form; the lines that made
//! it are in `docs/decisions/033-plan.md`. A row is one rung on one scene, and a rung's scenes are a full product of four
//! axes: optical depth (95th percentile), |g|, albedo and directionality of the light. In
//! `(ln depth, |g|, sqrt(1 - albedo), directionality)` the logarithms of the error and of the seconds per unit of work are
//! interpolated linearly between the measured ones, and held constant beyond the outermost.
//! `sqrt(1 - albedo)` because a thick medium's light falls off by it (diffusion: the root of `3 (1 - albedo)`).
//! Cost: 16 cells a prediction.

use super::Survey;
use super::ladder::{Rung, rung};
use super::work::{speedup, work};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::LazyLock;

/// First line of a table.
pub const HEADER: &str = "scene,depth,g,albedo,directionality,rung,error,\
     work_source,work_volume,work_view,seconds_source,seconds_volume,seconds_view,threads";

/// Errors below this are noise of the references they were measured against.
pub const LEAST_ERROR: f64 = 1e-3;
/// Seconds of a stage that takes none.
const LEAST_SECONDS: f64 = 1e-6;

/// A measurement: one rung on one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// What was rendered, in words without commas.
    pub scene: String,
    /// Optical depth, 95th percentile.
    pub depth: f64,
    /// Mean cosine of the phase function; its sign does not matter.
    pub g: f64,
    /// Albedo.
    pub albedo: f64,
    /// Directionality of the light, 0 to 1.
    pub directionality: f64,
    /// Name of the rung.
    pub rung: String,
    /// Relative RMSE over the pixels with smoke, no sky visible; the reference's noise at the end for the reference.
    pub error: f64,
    /// Units of work of the stages.
    pub work: [f64; 3],
    /// Seconds of the stages.
    pub seconds: [f64; 3],
    /// Threads that took them.
    pub threads: usize,
}

impl Row {
    /// A measurement of `rung` on the scene of `survey`, whose medium must be grey.
    pub fn new(scene: &str, survey: &Survey, rung: &Rung, error: f64, seconds: [f64; 3], threads: usize) -> Self {
        let parameters = survey.medium.parameters;
        Self {
            scene: scene.replace([',', '\n'], " "),
            depth: survey.medium.depth_p95()[0],
            g: f64::from(parameters.g),
            albedo: f64::from(parameters.albedo[0]),
            directionality: survey.light.directionality(),
            rung: rung.name.to_owned(),
            error,
            work: work(rung, survey),
            seconds,
            threads,
        }
    }

    fn parse(line: &str) -> Option<Self> {
        let mut fields = line.split(',');
        let scene = fields.next()?.to_owned();
        let mut number = || fields.next()?.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
        let [depth, g, albedo, directionality] = [number()?, number()?, number()?, number()?];
        let rung = fields.next()?.to_owned();
        let mut number = || fields.next()?.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
        let error = number()?;
        let work = [number()?, number()?, number()?];
        let seconds = [number()?, number()?, number()?];
        let threads = number()? as usize;
        let good = depth > 0.0 && g < 1.0 && albedo <= 1.0 && directionality <= 1.01 && threads > 0;
        (good && fields.next().is_none()).then_some(Self {
            scene,
            depth,
            g,
            albedo,
            directionality,
            rung,
            error,
            work,
            seconds,
            threads,
        })
    }
}

impl fmt::Display for Row {
    /// A line of the table. Axes are rounded, so that scenes which differ by rounding alone share a node.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scene, g, albedo, directionality, rung, error, work, seconds, threads, .. } = self;
        write!(f, "{scene},{:.3e},{:.3},{albedo:.4},{directionality:.3},{rung},{error:.4e}", self.depth, g.abs())?;
        work.iter().try_for_each(|w| write!(f, ",{w:.4e}"))?;
        seconds.iter().try_for_each(|s| write!(f, ",{s:.3e}"))?;
        write!(f, ",{threads}")
    }
}

/// Rows of a table's text; an error names the line.
pub fn rows(text: &str) -> Result<Vec<Row>, String> {
    let mut lines = text.lines();
    if lines.next().map(str::trim) != Some(HEADER) {
        return Err(format!("line 1: expected {HEADER}"));
    }
    let parse = |(i, line): (usize, &str)| Row::parse(line).ok_or_else(|| format!("line {}: found {line}", i + 2));
    lines.enumerate().map(parse).collect()
}

/// What is predicted of one rung on one scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Relative RMSE over the pixels with smoke.
    pub error: f64,
    /// Seconds of source radiance, volume pass and view pass.
    pub seconds: [f64; 3],
}

/// Logarithms of the error, and of the single-thread seconds per unit of work of the three stages.
type Cell = [f64; 4];

/// The measurements of one rung.
#[derive(Clone, Debug)]
struct Measured {
    /// Coordinates, ascending, along each axis.
    axes: [Vec<f64>; 4],
    /// A cell for each node of the axes' product, the first axis fastest.
    cells: Vec<Cell>,
}

/// The measurements of all rungs, by name.
#[derive(Clone, Debug)]
pub struct Table(BTreeMap<String, Measured>);

/// The table that the program predicts from.
pub static MEASURED: LazyLock<Table> =
    LazyLock::new(|| Table::parse(include_str!("measured.csv")).expect("a test holds that the table is whole"));

/// Interpolation coordinates.
fn coordinates(depth: f64, g: f64, albedo: f64, directionality: f64) -> [f64; 4] {
    [depth.max(f64::MIN_POSITIVE).ln(), g.abs(), (1.0 - albedo).max(0.0).sqrt(), directionality]
}

impl Table {
    /// A table from its text.
    ///
    /// # Errors
    /// The first line that is not a row; a rung that is not in the ladder; a node of the axes' product where a rung has
    /// no row, or two.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut of_rungs: BTreeMap<String, Vec<Row>> = BTreeMap::new();
        for row in rows(text)? {
            of_rungs.entry(row.rung.clone()).or_default().push(row);
        }
        match of_rungs.keys().find(|name| rung(name).is_none()) {
            Some(unknown) => Err(format!("rung {unknown}: not in the ladder")),
            None => of_rungs
                .into_iter()
                .map(|(name, rows)| Ok((name, Measured::new(&rows)?)))
                .collect::<Result<_, _>>()
                .map(Self),
        }
    }

    /// The error that the rung called `rung` is predicted to make on a scene at this place of the axes, no sky visible.
    pub fn error_at(&self, rung: &str, depth: f64, g: f64, albedo: f64, directionality: f64) -> Option<f64> {
        Some(self.0.get(rung)?.interpolate(coordinates(depth, g, albedo, directionality))[0].exp())
    }

    /// What `rung` is predicted to do on the scene of `survey` with `threads`; none for a rung that was not measured.
    ///
    /// The error is the largest of the three channels'. For the reference it is the noise at which it was stopped when it
    /// was measured.
    pub fn predict(&self, rung: &Rung, survey: &Survey, threads: usize) -> Option<Prediction> {
        let measured = self.0.get(rung.name)?;
        let (depth, albedo) = (survey.medium.depth_p95(), survey.medium.parameters.albedo.map(f64::from));
        let (g, directionality) = (f64::from(survey.medium.parameters.g), survey.light.directionality());
        let channels = [0, 1, 2].map(|c| measured.interpolate(coordinates(depth[c], g, albedo[c], directionality)));
        let worst = |i: usize| channels.iter().map(|cell| cell[i]).fold(f64::NEG_INFINITY, f64::max).exp();
        let work = work(rung, survey);
        let seconds = [0, 1, 2].map(|s| worst(s + 1) * work[s] / speedup(threads));
        Some(Prediction { error: worst(0) * survey.view.dilution, seconds })
    }
}

impl Measured {
    fn new(rows: &[Row]) -> Result<Self, String> {
        let place = |row: &Row| coordinates(row.depth, row.g, row.albedo, row.directionality);
        let axes: [Vec<f64>; 4] = std::array::from_fn(|a| {
            let mut values: Vec<f64> = rows.iter().map(|row| place(row)[a]).collect();
            values.sort_by(f64::total_cmp);
            values.dedup();
            values
        });
        let nodes: usize = axes.iter().map(Vec::len).product();
        let mut cells: Vec<Option<Cell>> = vec![None; nodes];
        for row in rows {
            let place = place(row);
            // Every coordinate is on its axis.
            let along = |a: usize| axes[a].partition_point(|v| *v < place[a]);
            let at = (0..4).rev().fold(0, |at, a| at * axes[a].len() + along(a));
            if cells[at].replace(Self::cell(row)).is_some() {
                return Err(format!("rung {}: two rows for {}", row.rung, row.scene));
            }
        }
        let missing = cells.iter().filter(|cell| cell.is_none()).count();
        let whole = cells.into_iter().collect::<Option<_>>();
        let name = rows.first().map_or("", |row| &row.rung);
        whole.map(|cells| Self { axes, cells }).ok_or_else(|| format!("rung {name}: {missing} of {nodes} rows missing"))
    }

    fn cell(row: &Row) -> Cell {
        let speedup = speedup(row.threads);
        let stage = |s: usize| (row.seconds[s].max(LEAST_SECONDS) * speedup / row.work[s].max(1.0)).ln();
        [row.error.max(LEAST_ERROR).ln(), stage(0), stage(1), stage(2)]
    }

    fn interpolate(&self, at: [f64; 4]) -> Cell {
        let places: [(usize, usize, f64); 4] = std::array::from_fn(|a| {
            let axis = &self.axes[a];
            let last = axis.len() - 1;
            let high = axis.partition_point(|v| *v < at[a]).clamp(last.min(1), last);
            let low = high.saturating_sub(1);
            let width = axis[high] - axis[low];
            let fraction = if width > 0.0 { ((at[a] - axis[low]) / width).clamp(0.0, 1.0) } else { 0.0 };
            (low, high, fraction)
        });
        let mut sum = [0.0; 4];
        for corner in 0..16usize {
            let (mut node, mut weight) = (0, 1.0);
            for a in (0..4).rev() {
                let (low, high, fraction) = places[a];
                let upper = corner >> a & 1 == 1;
                node = node * self.axes[a].len() + if upper { high } else { low };
                weight *= if upper { fraction } else { 1.0 - fraction };
            }
            (0..4).for_each(|i| sum[i] += weight * self.cells[node][i]);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ladder::{TRANSFER, ladder};
    use crate::plan::tests::survey;

    /// A table over 2 x 2 x 1 x 2 scenes: error = 0.01 depth (1 + g), seconds = work * 1e-6.
    fn table_text() -> String {
        let mut text = HEADER.to_owned();
        for depth in [1.0, 100.0] {
            for g in [0.0, 0.5] {
                for directionality in [0.0, 1.0] {
                    let error = 0.01 * depth * (1.0 + g);
                    text += &format!("\na b,{depth},{g},0.9,{directionality},default,{error}");
                    text += ",2e6,1e6,4e6,2,1,4,1";
                }
            }
        }
        text
    }

    #[test]
    fn nodes_are_met_exactly_logarithms_are_linear_between_and_constant_beyond() {
        let table = Table::parse(&table_text()).unwrap();
        let default = rung("default").unwrap();
        let error = |depth: f32, g: f32| {
            let mut survey = survey(1.0, 0.9, g);
            survey.medium.column_p95 = f64::from(depth);
            table.predict(&default, &survey, 1).unwrap().error
        };
        let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-6, "{a} {b}");
        near(error(1.0, 0.0), 0.01);
        near(error(100.0, -0.5), 1.5);
        near(error(10.0, 0.0), 0.1);
        near(error(10.0, 0.25), 0.1 * 1.5f64.sqrt());
        near(error(1e-9, 0.0), 0.01);
        near(error(1e9, 0.9), 1.5);
        near(error(0.0, 0.0), 0.01);
    }

    #[test]
    fn seconds_are_in_proportion_to_the_work_and_fall_with_threads() {
        let table = Table::parse(&table_text()).unwrap();
        let (default, survey) = (rung("default").unwrap(), survey(1.0, 0.9, 0.0));
        let one = table.predict(&default, &survey, 1).unwrap().seconds;
        let work = work(&default, &survey);
        (0..3).for_each(|s| assert!((one[s] / (work[s] * 1e-6) - 1.0).abs() < 1e-6, "{one:?} {work:?}"));
        assert!(table.predict(&default, &survey, 4).unwrap().seconds[0] < one[0] / 2.5);
        assert_eq!(table.predict(&rung("centres").unwrap(), &survey, 1), None);
    }

    #[test]
    fn channels_of_different_thickness_are_predicted_by_the_worst() {
        let table = Table::parse(&table_text()).unwrap();
        let mut survey = survey(1.0, 0.9, 0.0);
        survey.medium.column_p95 = 1.0;
        survey.medium.parameters.sigma_t = [1.0, 100.0, 10.0];
        assert!((table.predict(&rung("default").unwrap(), &survey, 1).unwrap().error - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_row_reads_back_as_it_was_written_but_for_rounding() {
        let row = Row::new("a, b", &survey(2.0, 0.9, -0.3), &rung("draft").unwrap(), 0.0123, [0.1, 0.2, 0.3], 2);
        let read = rows(&format!("{HEADER}\n{row}")).unwrap().remove(0);
        assert_eq!((read.scene.as_str(), read.rung.as_str(), read.threads), ("a  b", "draft", 2));
        assert_eq!((read.g, read.albedo, read.error, read.seconds), (0.3, 0.9, 0.0123, [0.1, 0.2, 0.3]));
        assert!((read.depth / row.depth - 1.0).abs() < 1e-3 && (read.work[0] / row.work[0] - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_table_with_a_wrong_line_a_hole_or_a_double_is_refused_by_name() {
        let text = table_text();
        let without_last = &text[..text.rfind('\n').unwrap()];
        let doubled = format!("{text}\n{}", text.lines().last().unwrap());
        for (text, expected) in [
            ("nothing", "line 1"),
            (without_last, "1 of 8 rows missing"),
            (&doubled, "two rows"),
            (&text.replace("default", "defualt"), "not in the ladder"),
            (&text.replace(",0.9,", ",NaN,"), "line 2"),
            (&text.replace(",0.9,", ",1.9,"), "line 2"),
            (&text.replace(",4,1", ",4,0"), "line 2"),
            (&text.replace(",4,1", ",4,1,7"), "line 2"),
        ] {
            let message = Table::parse(text).unwrap_err();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn the_measured_table_is_whole_and_has_every_rung() {
        let table = Table::parse(include_str!("measured.csv")).unwrap();
        for rung in ladder() {
            let axes = table.0.get(rung.name).map(|measured| &measured.axes);
            // Transfer was measured at one albedo: its error hardly depends on it, and each is a bake.
            let least = |axis: usize| if rung.name == TRANSFER && axis == 2 { 1 } else { 2 };
            let whole = |axes: &[Vec<f64>; 4]| (0..4).all(|axis| axes[axis].len() >= least(axis));
            assert!(axes.is_some_and(whole), "{}", rung.name);
        }
    }
}
