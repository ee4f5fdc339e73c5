//! Plots as SVG: scales with ticks, curves with markers, a front. No script, no font, nothing from elsewhere; colours are
//! CSS variables of the page, so that one drawing is right in light and in dark.
//!
//! A scale maps its range to [0, 1] monotonically: `(v - low) / (high - low)`, in logarithms for a logarithmic one. Ticks
//! are at 1, 2 and 5 times powers of ten, as many as have room.

use std::fmt::Write;

/// Room around the plotting area: left, right, top, bottom, in pixels.
const MARGIN: [f64; 4] = [62.0, 14.0, 12.0, 44.0];
/// Colours there are after that of the defaults: `--c1` and on in the page's style; curves beyond them begin anew with
/// another marker.
const COLOURS: usize = 9;
/// Markers there are.
const MARKERS: usize = 7;
/// Half the size of a marker.
const RADIUS: f64 = 4.2;
/// Room of a letter of the small text, in pixels.
const LETTER: f64 = 6.2;

/// From values to places.
#[derive(Clone, Debug, PartialEq)]
pub enum Scale {
    /// Logarithmic, from a low to a high above it, both above zero.
    Log(f64, f64),
    /// Named places, evenly spread; value i is the i-th.
    Names(Vec<String>),
}

impl Scale {
    /// A logarithmic scale that shows all of `values` that are above zero, with room to either side.
    pub fn log(values: impl Iterator<Item = f64>) -> Self {
        let legal = values.filter(|v| *v > 0.0 && v.is_finite());
        let (low, high) = legal.fold((f64::INFINITY, 0.0), |(low, high): (f64, f64), v| (low.min(v), high.max(v)));
        if low > high {
            return Self::Log(0.1, 1.0);
        }
        // At least a factor of two, so that a single value has neighbours to be read against.
        let room = (high / low).powf(0.05).max(if high < 2.0 * low { 1.5 } else { 1.1 });
        Self::Log((low / room).max(f64::MIN_POSITIVE), (high * room).min(f64::MAX))
    }

    /// Where `v` is, from 0 to 1 within the range.
    pub fn place(&self, v: f64) -> f64 {
        match self {
            Self::Log(low, high) => (v.max(f64::MIN_POSITIVE).ln() - low.ln()) / (high.ln() - low.ln()),
            Self::Names(names) => (v + 0.5) / names.len().max(1) as f64,
        }
    }

    /// Value and text of each tick, ascending; no more than about `most`.
    pub fn ticks(&self, most: usize) -> Vec<(f64, String)> {
        let (low, high) = match self {
            Self::Log(low, high) => (*low, *high),
            Self::Names(names) => return names.iter().enumerate().map(|(i, n)| (i as f64, n.clone())).collect(),
        };
        let most = most.max(1) as i32;
        let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
        // Where a decade has no room of its own, every second or third has.
        let every = ((last - first) / most).max(0) + 1;
        let within = |mantissas: &[f64]| -> Vec<f64> {
            let decades = (first..=last).filter(|d| d.rem_euclid(every) == 0);
            let values = decades.flat_map(|d| mantissas.iter().map(move |m| decimal(*m, d)));
            values.filter(|v| (low..=high).contains(v)).collect()
        };
        let finer = [&[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0][..], &[1.0, 2.0, 5.0], &[1.0, 3.0], &[1.0]];
        let fits = finer.iter().map(|m| within(m)).find(|ticks| ticks.len() <= most as usize);
        fits.unwrap_or_else(|| within(&[1.0])).into_iter().map(|v| (v, number(v))).collect()
    }
}

/// `mantissa * 10^exponent`, as close as reading it from text gives: 0.3 and not 0.30000000000000004.
fn decimal(mantissa: f64, exponent: i32) -> f64 {
    format!("{mantissa}e{exponent}").parse().unwrap_or(f64::INFINITY)
}

/// A number of a tick: plain from a thousandth to a hundred thousand, else with a power of ten.
fn number(v: f64) -> String {
    if (1e-3..1e5).contains(&v) { v.to_string() } else { format!("{v:e}") }
}

/// One measured point.
#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    /// Value across.
    pub x: f64,
    /// Value up.
    pub y: f64,
    /// Standard error of `y`.
    pub spread: f64,
    /// Shown when the pointer is on it.
    pub label: String,
}

/// How a curve is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style {
    /// Which colour and marker, 0 for the defaults alone; none for the path tracer's dashed line.
    pub number: Option<usize>,
    /// Markers that are open instead of full, and a thinner line.
    pub open: bool,
    /// Points joined by a line.
    pub joined: bool,
}

/// Points that belong together.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// Colour and marker.
    pub style: Style,
    /// Its points, in the order in which they are joined.
    pub marks: Vec<Mark>,
}

/// One plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Plot {
    /// What it shows, for those who cannot see it.
    pub title: String,
    /// Width and height in pixels.
    pub size: [f64; 2],
    /// What is across, with its unit.
    pub x_label: String,
    /// What is up, with its unit.
    pub y_label: String,
    /// Across.
    pub x: Scale,
    /// Up.
    pub y: Scale,
    /// Curves, the first undermost.
    pub curves: Vec<Curve>,
    /// The Pareto front, ascending in x.
    pub front: Vec<[f64; 2]>,
}

impl Plot {
    /// The drawing, for the inside of an HTML page.
    pub fn svg(&self) -> String {
        let [width, height] = self.size;
        let [left, right, top, bottom] = MARGIN;
        let mut out = format!(
            "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\" aria-label=\"{}\">\n",
            escape(&self.title)
        );
        let across = width - left - right;
        let slope = self.slope(across);
        let up = height - top - bottom - slope;
        self.grid(&mut out, [across, up], slope);
        let at = |x: f64, y: f64| [left + across * self.x.place(x), top + up * (1.0 - self.y.place(y))];
        if let Some(first) = self.front.first() {
            // From the top: nothing faster than the first is as good as anything on the front.
            let mut path = format!("M{:.1} {top}", at(first[0], first[1])[0]);
            for step in &self.front {
                let [x, y] = at(step[0], step[1]);
                // Stairs: up to the next point, the error is still that of the last.
                let _ = write!(path, "H{x:.1}V{y:.1}");
            }
            let _ = writeln!(out, "<path class=\"front\" d=\"{path}H{:.1}\"/>", left + across);
        }
        for curve in &self.curves {
            curve.draw(&mut out, &at, [top, top + up]);
        }
        for step in &self.front {
            let [x, y] = at(step[0], step[1]);
            let _ = writeln!(out, "<circle class=\"ring\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{}\"/>", RADIUS + 4.0);
        }
        out + "</svg>"
    }

    /// Room below for the names across: names that would touch lie aslant, at 24 degrees; 0 where they have room.
    fn slope(&self, across: f64) -> f64 {
        let ticks = self.x.ticks((across / 55.0) as usize);
        let longest = LETTER * ticks.iter().map(|t| t.1.chars().count()).max().unwrap_or(0) as f64;
        if longest > across / ticks.len().max(1) as f64 { longest * 24f64.to_radians().sin() } else { 0.0 }
    }

    /// Frame, grid lines, ticks and labels around an area of `size`, with names of that `slope`.
    fn grid(&self, out: &mut String, [across, up]: [f64; 2], slope: f64) {
        let [left, _, top, bottom] = MARGIN;
        let _ = writeln!(out, "<rect class=\"area\" x=\"{left}\" y=\"{top}\" width=\"{across}\" height=\"{up}\"/>");
        for (value, text) in self.x.ticks((across / 55.0) as usize) {
            let x = left + across * self.x.place(value);
            let y = top + up;
            let (turn, anchor) = if slope > 0.0 {
                (format!(" transform=\"rotate(-24 {x:.1} {:.1})\"", y + 13.0), "end")
            } else {
                (String::new(), "middle")
            };
            let _ = writeln!(out, "<path class=\"line\" d=\"M{x:.1} {top}V{y:.1}\"/>");
            let text = escape(&text);
            let _ =
                writeln!(out, "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\"{turn}>{text}</text>", y + 15.0);
        }
        for (value, text) in self.y.ticks((up / 30.0) as usize) {
            let y = top + up * (1.0 - self.y.place(value));
            let _ = writeln!(out, "<path class=\"line\" d=\"M{left} {y:.1}H{:.1}\"/>", left + across);
            let text = escape(&text);
            let _ =
                writeln!(out, "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>", left - 6.0, y + 4.0);
        }
        let (x, y) = (left + across / 2.0, top + up / 2.0);
        let below = top + up + bottom + slope - 8.0;
        let _ = writeln!(
            out,
            "<text class=\"label\" x=\"{x:.1}\" y=\"{below:.1}\" text-anchor=\"middle\">{}</text>",
            escape(&self.x_label)
        );
        let label = escape(&self.y_label);
        let _ = writeln!(
            out,
            "<text class=\"label\" x=\"13\" y=\"{y:.1}\" text-anchor=\"middle\" transform=\"rotate(-90 13 {y:.1})\">{label}</text>"
        );
    }
}

impl Curve {
    /// Draws the curve with its values placed by `at`; standard errors end at the upper and the lower `edge`.
    fn draw(&self, out: &mut String, at: &dyn Fn(f64, f64) -> [f64; 2], edge: [f64; 2]) {
        let _ = writeln!(out, "<g class=\"{}\">", self.style.class());
        let places: Vec<[f64; 2]> = self.marks.iter().map(|m| at(m.x, m.y)).collect();
        if self.style.joined && places.len() > 1 {
            let points: Vec<String> = places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
            let _ = writeln!(out, "<polyline points=\"{}\"/>", points.join(" "));
        }
        for (mark, [x, y]) in self.marks.iter().zip(places) {
            let _ = write!(out, "<g><title>{}</title>", escape(&mark.label));
            if mark.spread > 0.0 {
                let end = |y: f64| at(mark.x, y)[1].clamp(edge[0], edge[1]);
                let (low, high) = (end(mark.y - mark.spread), end(mark.y + mark.spread));
                let _ = write!(out, "<path class=\"spread\" d=\"M{x:.1} {low:.1}V{high:.1}\"/>");
            }
            let _ = writeln!(out, "{}</g>", self.style.marker([x, y]));
        }
        out.push_str("</g>\n");
    }

    /// A line of a legend: the marker and the name.
    pub fn legend(&self) -> String {
        let line = if self.style.joined { "<polyline points=\"1,8 29,8\"/>" } else { "" };
        let marker = self.style.marker([15.0, 8.0]);
        let (class, name) = (self.style.class(), escape(&self.name));
        format!(
            "<span><svg viewBox=\"0 0 30 16\" width=\"30\" height=\"16\" aria-hidden=\"true\"><g class=\"{class}\">{line}{marker}</g></svg>{name}</span>"
        )
    }
}

impl Style {
    fn class(self) -> String {
        let colour = match self.number {
            None => "tracer".to_owned(),
            Some(0) => "c0".to_owned(),
            Some(n) => format!("c{}", 1 + (n - 1) % COLOURS),
        };
        if self.open { colour + " open" } else { colour }
    }

    fn marker(self, [x, y]: [f64; 2]) -> String {
        let r = RADIUS;
        let polygon = |corners: &[[f64; 2]]| {
            let corners: Vec<String> =
                corners.iter().map(|[dx, dy]| format!("{:.1},{:.1}", x + r * dx, y + r * dy)).collect();
            format!("<polygon class=\"marker\" points=\"{}\"/>", corners.join(" "))
        };
        // Another marker for the second round of colours.
        match self.number.map(|n| (n + n.saturating_sub(1) / COLOURS) % MARKERS) {
            None => format!("<circle class=\"marker\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\"/>"),
            Some(0) => format!("<circle class=\"marker\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r}\"/>"),
            Some(1) => polygon(&[[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]]),
            Some(2) => polygon(&[[0.0, -1.2], [1.1, 0.8], [-1.1, 0.8]]),
            Some(3) => polygon(&[[0.0, -1.3], [1.3, 0.0], [0.0, 1.3], [-1.3, 0.0]]),
            Some(4) => polygon(&[[0.0, 1.2], [1.1, -0.8], [-1.1, -0.8]]),
            Some(5) => polygon(&[[-1.2, 0.0], [-0.6, -1.1], [0.6, -1.1], [1.2, 0.0], [0.6, 1.1], [-0.6, 1.1]]),
            Some(_) => polygon(&[
                [-0.4, -1.2],
                [0.4, -1.2],
                [0.4, -0.4],
                [1.2, -0.4],
                [1.2, 0.4],
                [0.4, 0.4],
                [0.4, 1.2],
                [-0.4, 1.2],
                [-0.4, 0.4],
                [-1.2, 0.4],
                [-1.2, -0.4],
                [-0.4, -0.4],
            ]),
        }
    }
}

/// The points that no other beats in both values: ascending in x, descending in y.
pub fn pareto_front(points: impl Iterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut sorted: Vec<[f64; 2]> = points.filter(|p| p.iter().all(|v| v.is_finite())).collect();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut front: Vec<[f64; 2]> = Vec::new();
    for point in sorted {
        if front.last().is_none_or(|last| point[1] < last[1]) {
            front.push(point);
        }
    }
    front
}

/// Text for the inside of an element or a quoted attribute.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // Not allowed in XML, whatever a file's name may hold.
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(scale: &Scale, most: usize) -> Vec<f64> {
        scale.ticks(most).into_iter().map(|(v, _)| v).collect()
    }

    #[test]
    fn ticks_are_round_numbers_within_the_range_and_no_more_than_there_is_room_for() {
        assert_eq!(values(&Scale::Log(0.9, 11.0), 6), [1.0, 2.0, 5.0, 10.0]);
        assert_eq!(values(&Scale::Log(0.001, 1.0), 6), [0.001, 0.01, 0.1, 1.0]);
        assert_eq!(values(&Scale::Log(0.25, 0.65), 6), [0.3, 0.4, 0.5, 0.6]);
        for (low, high) in [(1e-12, 1e12), (1e-300, 1e300), (0.5, 1.0), (3.1, 3.2), (0.017, 0.9)] {
            for most in [1, 3, 8] {
                let ticks = values(&Scale::Log(low, high), most);
                assert!(ticks.len() <= most + 1, "{low} {high} {most}: {ticks:?}");
                assert!(ticks.windows(2).all(|w| w[0] < w[1]) && ticks.iter().all(|t| (low..=high).contains(t)));
            }
        }
        let text: Vec<String> = Scale::Log(1e-5, 1e5).ticks(12).into_iter().map(|t| t.1).collect();
        assert_eq!(text[..3], ["1e-5", "1e-4", "0.001"]);
        assert_eq!(Scale::Names(vec!["a".into(), "b".into()]).ticks(1).len(), 2);
    }

    #[test]
    fn a_logarithmic_scale_is_monotonic_ends_at_its_ends_and_shows_all_values() {
        let scale = Scale::log([0.02, 0.5, 3.0, 0.0, f64::NAN, f64::INFINITY].into_iter());
        let places: Vec<f64> = [0.02, 0.1, 0.5, 1.0, 3.0].iter().map(|&v| scale.place(v)).collect();
        assert!(places.windows(2).all(|w| w[0] < w[1]) && places[0] > 0.0 && places[4] < 1.0, "{places:?}");
        let Scale::Log(low, high) = scale else { panic!() };
        assert!((scale.place(low)).abs() < 1e-12 && (scale.place(high) - 1.0).abs() < 1e-12);
        // Equal ratios are equal distances.
        assert!((scale.place(0.2) - scale.place(0.1) - scale.place(0.4) + scale.place(0.2)).abs() < 1e-12);
        let one = Scale::log([5.0].into_iter());
        assert!((one.place(5.0) - 0.5).abs() < 1e-12);
        let none = Scale::log(std::iter::empty());
        assert!(none.place(0.5).is_finite() && none.place(0.0).is_finite());
        let names = Scale::Names(vec!["a".into(), "b".into()]);
        assert_eq!((names.place(0.0), names.place(1.0)), (0.25, 0.75));
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points = [[3.0, 1.0], [1.0, 4.0], [2.0, 5.0], [2.0, 2.0], [4.0, 1.0], [1.0, 6.0], [f64::NAN, 0.0]];
        assert_eq!(pareto_front(points.into_iter()), [[1.0, 4.0], [2.0, 2.0], [3.0, 1.0]]);
        assert!(pareto_front(std::iter::empty()).is_empty());
    }

    #[test]
    fn text_is_escaped_wherever_it_comes_from() {
        let evil = "<b a=\"1\" c='2'>&\u{7}";
        assert_eq!(escape(evil), "&lt;b a=&quot;1&quot; c=&#39;2&#39;&gt;&amp; ");
        let mark = Mark { x: 1.0, y: 1.0, spread: 0.1, label: evil.into() };
        let style = Style { number: Some(12), open: true, joined: true };
        let curve = Curve { name: evil.into(), style, marks: vec![mark.clone(), Mark { x: 2.0, ..mark }] };
        let plot = Plot {
            title: evil.into(),
            size: [400.0, 300.0],
            x_label: evil.into(),
            y_label: evil.into(),
            x: Scale::Names(vec![evil.into(), evil.into(), evil.into()]),
            y: Scale::log([1.0].into_iter()),
            curves: vec![curve.clone()],
            front: vec![[1.0, 1.0]],
        };
        let svg = plot.svg() + &curve.legend();
        assert!(!svg.contains("<b ") && !svg.contains('\u{7}') && svg.matches("&lt;b a=").count() >= 8, "{svg}");
    }

    #[test]
    fn names_lie_aslant_where_they_have_no_room() {
        let plot = |name: &str| Plot {
            title: String::new(),
            size: [MARGIN[0] + MARGIN[1] + 200.0, 200.0],
            x_label: String::new(),
            y_label: String::new(),
            x: Scale::Names(vec![name.into(); 4]),
            y: Scale::Log(1.0, 10.0),
            curves: vec![],
            front: vec![],
        };
        assert!(plot("0.25").slope(200.0) == 0.0 && !plot("0.25").svg().contains("rotate(-24"));
        assert!(plot("pointwise").slope(200.0) > 10.0 && plot("pointwise").svg().contains("rotate(-24"));
    }

    #[test]
    fn a_point_is_drawn_where_its_values_are() {
        let mark = |x, y| Mark { x, y, spread: 2.0, label: String::new() };
        let style = Style { number: Some(0), open: false, joined: true };
        let curve = Curve { name: "a".into(), style, marks: vec![mark(1.0, 10.0), mark(10.0, 1.0)] };
        let (x, y) = (Scale::Log(1.0, 10.0), Scale::Log(1.0, 10.0));
        let [left, right, top, bottom] = MARGIN;
        let size = [left + right + 100.0, top + bottom + 100.0];
        let (title, x_label, y_label) = (String::new(), String::new(), String::new());
        let plot = Plot { title, size, x_label, y_label, x, y, curves: vec![curve], front: vec![] };
        let corners = format!("points=\"{left:.1},{top:.1} {:.1},{:.1}\"", left + 100.0, top + 100.0);
        assert!(plot.svg().contains(&corners), "{corners}\n{}", plot.svg());
        // The standard error of the second point reaches below zero: its line ends at the edge of the plot.
        let line = format!("V{:.1}\"", top + 100.0 * (1.0 - 3f64.log10()));
        assert!(plot.svg().contains(&format!("M{:.1} {:.1}{line}", left + 100.0, top + 100.0)), "{}", plot.svg());
    }
}
