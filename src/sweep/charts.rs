//! Which points of a sweep go into which plot.
//!
//! A curve is one dial of one method, from the method's defaults. Dials have colours and markers, the same all over the
//! page; the first method's markers are full, others are open.

use super::plot::{Curve, Mark, Plot, Scale, Style, pareto_front};
use super::points::{COMBINED, DEFAULTS};
use super::table::{Group, Row};
use std::collections::BTreeSet;

/// What all plots of a page have in common.
pub struct Charts {
    /// Dials in the order of the page; the defaults are the first.
    dials: Vec<String>,
    /// Methods in the order of the page.
    methods: Vec<String>,
}

impl Charts {
    /// The charts of these groups.
    pub fn of(groups: &[Group]) -> Self {
        let (mut dials, mut methods) = (vec![DEFAULTS.to_owned()], Vec::new());
        for row in groups.iter().flat_map(|g| &g.rows) {
            if !dials.contains(&row.dial) {
                dials.push(row.dial.clone());
            }
            if !methods.contains(&row.figures.method) {
                methods.push(row.figures.method.clone());
            }
        }
        Self { dials, methods }
    }

    /// The Pareto front of a group: total seconds and relative RMSE.
    pub fn front(&self, group: &Group) -> Vec<[f64; 2]> {
        pareto_front(group.rows.iter().map(|row| [row.figures.seconds.total, row.figures.relative_rmse]))
    }

    /// Error against seconds, and its legend.
    pub fn error_by_seconds(&self, group: &Group) -> (String, String) {
        let tracer: Vec<Mark> = group
            .reference
            .curve
            .iter()
            .map(|at| Mark {
                x: at.seconds,
                y: 100.0 * at.relative_standard_error,
                spread: 0.0,
                label: format!(
                    "path tracer, {} passes: {}, {}",
                    at.passes,
                    percent(at.relative_standard_error),
                    seconds(at.seconds)
                ),
            })
            .collect();
        let style = Style { number: None, open: false, joined: true };
        let mut curves = vec![Curve { name: "path tracer (standard error)".into(), style, marks: tracer }];
        curves.extend(self.curves(group, &|row| row.figures.seconds.total, &|_| true));
        let front = self.front(group).into_iter().map(|[x, y]| [x, shown(y, least(group, x, y))]).collect();
        let marks = || curves.iter().flat_map(|c| &c.marks);
        let (x, y) = (Scale::log(marks().map(|m| m.x)), Scale::log(marks().map(|m| m.y)));
        let plot = Plot {
            title: "Error against seconds".into(),
            size: [900.0, 520.0],
            x_label: "seconds a frame".into(),
            y_label: "relative RMSE, per cent".into(),
            x,
            y,
            curves,
            front,
        };
        (plot.svg(), plot.curves.iter().map(Curve::legend).collect())
    }

    /// Error against the size of the pack, and its legend; none if all rows have one pack.
    pub fn error_by_size(&self, group: &Group) -> Option<(String, String)> {
        let packs: BTreeSet<&str> = group.rows.iter().map(|row| row.bake.as_str()).collect();
        if packs.len() < 2 {
            return None;
        }
        // Dials that make other packs, and every row of a full product.
        let turned: BTreeSet<&str> = {
            let usual = group.rows.first().map_or("", |row| row.bake.as_str());
            group.rows.iter().filter(|row| row.bake != usual).map(|row| row.dial.as_str()).collect()
        };
        let kept = |row: &Row| row.dial == DEFAULTS || turned.contains(row.dial.as_str());
        let curves = self.curves(group, &|row| row.figures.bits_per_active_voxel, &kept);
        let marks = || curves.iter().flat_map(|c| &c.marks);
        let (x, y) = (Scale::log(marks().map(|m| m.x)), Scale::log(marks().map(|m| m.y)));
        let plot = Plot {
            title: "Error against size of the pack".into(),
            size: [620.0, 380.0],
            x_label: "bits an active voxel".into(),
            y_label: "relative RMSE, per cent".into(),
            x,
            y,
            curves,
            front: Vec::new(),
        };
        Some((plot.svg(), plot.curves.iter().map(Curve::legend).collect()))
    }

    /// One plot of errors for each dial, all on one scale.
    pub fn error_by_dial(&self, group: &Group) -> Vec<String> {
        let all = Scale::log(group.rows.iter().map(|row| 100.0 * drawn(row)));
        let mut plots = Vec::new();
        for dial in self.dials.iter().filter(|dial| *dial != DEFAULTS && *dial != COMBINED) {
            let rows = || group.rows.iter().filter(|row| row.dial == *dial);
            let mut values: Vec<String> = vec!["default".into()];
            for row in rows() {
                if !values.contains(&row.value) {
                    values.push(row.value.clone());
                }
            }
            if values.len() < 2 {
                continue;
            }
            let place = |row: &Row| {
                let value = if row.dial == DEFAULTS { "default" } else { row.value.as_str() };
                values.iter().position(|v| v == value).unwrap_or(0) as f64
            };
            let methods: BTreeSet<&str> = rows().map(|row| row.figures.method.as_str()).collect();
            let kept = |row: &Row| {
                row.dial == *dial || (row.dial == DEFAULTS && methods.contains(row.figures.method.as_str()))
            };
            let mut curves = self.curves(group, &place, &kept);
            // The defaults are on the dial's own curve.
            curves.retain(|curve| curve.style.joined);
            let plot = Plot {
                title: format!("Error by {dial}"),
                size: [290.0, 230.0],
                x_label: dial.clone(),
                y_label: "relative RMSE, per cent".into(),
                x: Scale::Names(values.clone()),
                y: all.clone(),
                curves,
                front: Vec::new(),
            };
            plots.push(plot.svg());
        }
        plots
    }

    /// Which markers are which method's.
    pub fn methods_legend(&self, group: &Group) -> String {
        let has = |method: &&String| group.rows.iter().any(|row| row.figures.method == **method);
        let curve = |method: &String| {
            let style = Style { joined: true, ..self.style(method, DEFAULTS) };
            Curve { name: method.clone(), style, marks: Vec::new() }.legend()
        };
        self.methods.iter().filter(has).map(curve).collect()
    }

    /// A curve for each method and dial, of the rows that are `kept`, from the method's defaults, ascending in `x`.
    fn curves(&self, group: &Group, x: &dyn Fn(&Row) -> f64, kept: &dyn Fn(&Row) -> bool) -> Vec<Curve> {
        let mut curves = Vec::new();
        // The defaults last, on top of all.
        for dial in self.dials[1..].iter().chain(&self.dials[..1]) {
            for method in &self.methods {
                let of = |dial: &str| -> Vec<&Row> {
                    let mine = |row: &&Row| row.dial == dial && row.figures.method == *method && kept(row);
                    group.rows.iter().filter(mine).collect()
                };
                let mut rows = of(dial);
                if rows.is_empty() {
                    continue;
                }
                let style = self.style(method, dial);
                if style.joined {
                    rows.extend(of(DEFAULTS));
                }
                let mut marks: Vec<Mark> = rows.iter().map(|row| mark(row, x(row))).filter(|m| m.y > 0.0).collect();
                marks.sort_by(|a, b| a.x.total_cmp(&b.x));
                curves.push(Curve { name: format!("{dial}, {method}"), style, marks });
            }
        }
        curves
    }

    fn style(&self, method: &str, dial: &str) -> Style {
        let place = |all: &[String], name: &str| all.iter().position(|n| n == name).unwrap_or(0);
        let method = place(&self.methods, method);
        // Full and open tell two methods apart; further ones have colours of their own.
        let number = Some(place(&self.dials, dial) + method / 2 * self.dials.len());
        Style { number, open: method % 2 == 1, joined: dial != DEFAULTS && dial != COMBINED }
    }
}

fn mark(row: &Row, x: f64) -> Mark {
    let f = &row.figures;
    let turned = if row.dial == DEFAULTS { DEFAULTS.to_owned() } else { format!("{} {}", row.dial, row.value) };
    let (error, spread) = (percent(f.relative_rmse), percent(f.relative_rmse_standard_error));
    let label = format!("{}, {turned}: {error} \u{b1} {spread}, {}", f.method, seconds(f.seconds.total));
    Mark { x, y: 100.0 * drawn(row), spread: 100.0 * f.relative_rmse_standard_error, label }
}

/// The error that is drawn for a row.
fn drawn(row: &Row) -> f64 {
    row.figures.relative_rmse.max(row.figures.relative_rmse_standard_error)
}

/// The standard error of the row at these seconds and this error.
fn least(group: &Group, total: f64, error: f64) -> f64 {
    let here = |row: &&Row| row.figures.seconds.total == total && row.figures.relative_rmse == error;
    group.rows.iter().find(here).map_or(0.0, |row| row.figures.relative_rmse_standard_error)
}

/// An error as it is drawn, in per cent.
fn shown(error: f64, standard_error: f64) -> f64 {
    100.0 * error.max(standard_error)
}

/// A part of one in per cent, three digits.
pub fn percent(part: f64) -> String {
    format!("{} %", three_digits(100.0 * part))
}

/// Seconds, three digits.
pub fn seconds(seconds: f64) -> String {
    format!("{} s", three_digits(seconds))
}

fn three_digits(v: f64) -> String {
    let digits = if v == 0.0 { 0 } else { (2 - v.abs().log10().floor() as i32).clamp(0, 6) as usize };
    format!("{v:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::super::table::tests::group;
    use super::*;

    #[test]
    fn figures_have_three_digits() {
        assert_eq!(
            (percent(0.01234), percent(0.5), seconds(0.000123456)),
            ("1.23 %".into(), "50.0 %".into(), "0.000123 s".into())
        );
        assert_eq!(
            (seconds(1234.5), seconds(0.0), percent(1e-12)),
            ("1234 s".into(), "0 s".into(), "0.000000 %".into())
        );
    }

    #[test]
    fn each_dial_of_each_method_is_a_curve_from_its_defaults() {
        let rows = [
            ("defaults", "", "grid", 0.02, 1.0),
            ("defaults", "", "centres", 0.06, 0.5),
            ("cutoff", "0.1", "grid", 0.03, 0.9),
            ("cutoff", "0.2", "grid", 0.04, 0.8),
            ("cutoff", "0.1", "centres", 0.07, 0.4),
        ];
        let group = group(&rows);
        let charts = Charts::of(std::slice::from_ref(&group));
        let curves = charts.curves(&group, &|row| row.figures.seconds.total, &|_| true);
        let names: Vec<(&str, usize)> = curves.iter().map(|c| (c.name.as_str(), c.marks.len())).collect();
        let expected = [("cutoff, grid", 3), ("cutoff, centres", 2), ("defaults, grid", 1), ("defaults, centres", 1)];
        assert_eq!(names, expected);
        assert!(curves[0].marks.windows(2).all(|w| w[0].x <= w[1].x));
        let styles: Vec<Style> = curves.iter().map(|c| c.style).collect();
        assert!(styles.iter().enumerate().all(|(i, a)| styles[..i].iter().all(|b| a != b)), "{styles:?}");
        assert_eq!(charts.front(&group), [[0.4, 0.07], [0.5, 0.06], [0.8, 0.04], [0.9, 0.03], [1.0, 0.02]]);
        assert!(charts.error_by_size(&group).is_none());
        assert_eq!(charts.error_by_dial(&group).len(), 1);
    }

    #[test]
    fn packs_are_plotted_once_there_are_two_and_only_by_the_dials_that_made_them() {
        let mut group = group(&[
            ("defaults", "", "grid", 0.02, 1.0),
            ("cutoff", "0.1", "grid", 0.03, 0.9),
            ("max-error", "0.1", "grid", 0.05, 1.0),
        ]);
        group.rows[2].bake = "max-error=0.1".into();
        let charts = Charts::of(std::slice::from_ref(&group));
        let (svg, legend) = charts.error_by_size(&group).unwrap();
        assert!(legend.contains("max-error") && !legend.contains("cutoff") && svg.contains("max-error 0.1"));
    }

    #[test]
    fn an_error_of_zero_is_drawn_at_its_standard_error() {
        let group = group(&[("defaults", "", "grid", 0.0, 1.0)]);
        assert_eq!(mark(&group.rows[0], 1.0).y, 0.1);
        let (svg, _) = Charts::of(std::slice::from_ref(&group)).error_by_seconds(&group);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
