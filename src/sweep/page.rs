//! The page of a sweep: one HTML file that holds all it shows. No script, nothing that is fetched.
//!
//! For each reference: error against seconds with the Pareto front and the path tracer's own curve, error against the
//! size of the pack, error by dial, pictures beside the reference, all rows. Errors of zero cannot lie on a logarithmic
//! scale: an error below its own standard error is drawn at that.

use super::charts::{Charts, percent, seconds};
use super::plot::escape;
use super::points::DEFAULTS;
use super::store::{Key, Store};
use super::table::{Group, Row};
use crate::failure::Failure;
use smoke_formats::Error;
use std::fmt::Write;
use std::path::Path;

/// Rows whose pictures are on the page. Each takes some 50 kB; a page of hundreds of megabytes opens nowhere.
const MOST_PICTURES: usize = 400;

/// The whole page.
pub fn html(groups: &[Group], input: &Path, store: &Store) -> Result<String, Failure> {
    let input = escape(&input.display().to_string());
    let charts = Charts::of(groups);
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width\">\n<title>Sweep of {input}</title>\n<style>\n{}</style>\n</head>\n<body>\n\
         <h1>What each dial costs and buys</h1>\n<p>{input}, measured by smoke-bake {}. Errors are relative RMSE against \
         unbiased path-traced references, over the pixels with smoke, the references' own noise taken out. Seconds are \
         wall time of one frame, from the pack to the image.</p>\n",
        include_str!("style.css"),
        env!("CARGO_PKG_VERSION")
    );
    if groups.len() > 1 {
        overall(&mut out, groups);
    }
    let mut pictures = MOST_PICTURES;
    for group in groups {
        section(&mut out, group, &charts, store, &mut pictures)?;
    }
    out.push_str("</body>\n</html>\n");
    Ok(out)
}

/// Every point over all references.
fn overall(out: &mut String, groups: &[Group]) {
    let mut points: Vec<([&str; 3], Vec<&Row>)> = Vec::new();
    for row in groups.iter().flat_map(|g| &g.rows) {
        let name = [row.figures.method.as_str(), row.dial.as_str(), row.value.as_str()];
        match points.iter_mut().find(|(known, _)| *known == name) {
            Some((_, rows)) => rows.push(row),
            None => points.push((name, vec![row])),
        }
    }
    let sorted = |of: &dyn Fn(&Row) -> f64, rows: &[&Row]| {
        let mut values: Vec<f64> = rows.iter().map(|row| of(row)).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let _ = write!(
        out,
        "<h2>All {} references together</h2>\n<details><summary>{} points</summary>\n<div class=\"scroll\"><table>\n<tr>\
         <th class=\"text\">method</th><th class=\"text\">dial</th><th class=\"text\">value</th><th>least error</th>\
         <th>median error</th><th>largest error</th><th>median seconds</th></tr>\n",
        groups.len(),
        points.len()
    );
    for ([method, dial, value], rows) in &points {
        let errors = sorted(&|row| row.figures.relative_rmse, rows);
        let times = sorted(&|row| row.figures.seconds.total, rows);
        let (least, median, most) = (errors[0], errors[errors.len() / 2], errors[errors.len() - 1]);
        let _ = writeln!(
            out,
            "<tr><td class=\"text\">{}</td><td class=\"text\">{}</td><td class=\"text\">{}</td><td>{}</td><td>{}</td>\
             <td>{}</td><td>{}</td></tr>",
            escape(method),
            escape(dial),
            escape(value),
            percent(least),
            percent(median),
            percent(most),
            seconds(times[times.len() / 2])
        );
    }
    out.push_str("</table></div></details>\n");
}

fn section(
    out: &mut String,
    group: &Group,
    charts: &Charts,
    store: &Store,
    pictures: &mut usize,
) -> Result<(), Failure> {
    let place = &group.place;
    let axes: String = place.axes.iter().map(|(name, value)| format!(", {name} {value}")).collect();
    let scene = Path::new(&place.scene).file_name().map_or(place.scene.clone(), |n| n.to_string_lossy().into_owned());
    let title = escape(&format!("{scene}{axes}, frame {}", place.frame));
    let [width, height] = group.size;
    let r = &group.reference;
    let _ = write!(
        out,
        "<h2>{title}</h2>\n<p>{width} x {height} pixels. Reference: {} passes in {}, relative standard error {}.</p>\n",
        r.passes,
        seconds(r.seconds),
        percent(r.relative_standard_error)
    );
    let (time, legend) = charts.error_by_seconds(group);
    let _ = write!(
        out,
        "<h3>Error against seconds</h3>\n{time}\n<div class=\"legend\">{legend}<span><i class=\"swatch\"></i>Pareto front: \
         nothing measured is both faster and better</span></div>\n"
    );
    match charts.error_by_size(group) {
        Some((size, legend)) => {
            let _ =
                write!(out, "<h3>Error against size of the pack</h3>\n{size}\n<div class=\"legend\">{legend}</div>\n");
        }
        None => {
            let bits = group.rows.first().map_or(0.0, |row| row.figures.bits_per_active_voxel);
            let _ = write!(
                out,
                "<h3>Error against size of the pack</h3>\n<p>One pack, {bits:.2} bits an active voxel. Sweep the volumes \
                 with dials of bake (gaussians, max-error) for more.</p>\n"
            );
        }
    }
    let dials = charts.error_by_dial(group);
    if !dials.is_empty() {
        out.push_str("<h3>Error by dial</h3>\n<div class=\"many\">\n");
        dials.iter().for_each(|svg| out.push_str(svg));
        let _ = writeln!(out, "</div>\n<div class=\"legend\">{}</div>", charts.methods_legend(group));
    }
    gallery(out, group, store, pictures)?;
    rows(out, group, charts);
    Ok(())
}

/// The reference, then each row's image and its difference.
fn gallery(out: &mut String, group: &Group, store: &Store, left: &mut usize) -> Result<(), Failure> {
    let _ = write!(
        out,
        "<h3>Pictures</h3>\n<p>Each with its difference from the reference beside it: red too bright, blue too dark, full \
         at {} of the reference's root mean square.</p>\n<div class=\"pictures\">\n<figure><div>{}</div><figcaption><b>\
         reference</b></figcaption></figure>\n",
        percent(group.full_colour),
        picture(&store.picture(&group.picture))?
    );
    let shown = group.rows.len().min(*left);
    *left -= shown;
    let mut before: Vec<&Key> = Vec::new();
    for row in &group.rows[..shown] {
        // A value that is the default has the default's picture.
        if before.contains(&&row.picture) {
            continue;
        }
        before.push(&row.picture);
        let f = &row.figures;
        let _ = writeln!(
            out,
            "<figure><div>{}{}</div><figcaption><b>{}</b><br>{}<br>{}, {}</figcaption></figure>",
            picture(&store.picture(&row.picture))?,
            picture(&store.difference(&row.picture))?,
            escape(&turned(row)),
            escape(&f.method),
            percent(f.relative_rmse),
            seconds(f.seconds.total)
        );
    }
    out.push_str("</div>\n");
    if shown < group.rows.len() {
        let _ = writeln!(out, "<p>Pictures of {} more rows are in the folder pictures.</p>", group.rows.len() - shown);
    }
    Ok(())
}

/// All rows, those on the front marked.
fn rows(out: &mut String, group: &Group, charts: &Charts) {
    let mut stages: Vec<&String> = Vec::new();
    for name in group.rows.iter().flat_map(|row| row.figures.seconds.stages.keys()) {
        if !stages.contains(&name) {
            stages.push(name);
        }
    }
    let heads: String = stages.iter().map(|name| format!("<th>{}, s</th>", escape(&name.replace('_', " ")))).collect();
    let _ = write!(
        out,
        "<h3>All rows</h3>\n<p>Marked: on the Pareto front.</p>\n<div class=\"scroll\"><table>\n<tr><th class=\"text\">method\
         </th><th class=\"text\">dial</th><th class=\"text\">value</th><th>error</th><th>\u{b1}</th><th>bias</th><th>FLIP</th>{heads}<th>\
         total, s</th><th>pack, bytes</th><th>bits a voxel</th></tr>\n"
    );
    let front = charts.front(group);
    for row in &group.rows {
        let f = &row.figures;
        let best = front.contains(&[f.seconds.total, f.relative_rmse]);
        let times: String = stages
            .iter()
            .map(|&name| f.seconds.stages.get(name).and_then(|v| v.as_f64()))
            .map(|v| format!("<td>{}</td>", v.map_or(String::new(), |v| format!("{v:.3}"))))
            .collect();
        let _ = writeln!(
            out,
            "<tr{}><td class=\"text\">{}</td><td class=\"text\">{}</td><td class=\"text\">{}</td><td>{}</td><td>{}</td>\
             <td>{:+.3} %</td><td>{:.4}</td>{times}<td>{:.3}</td><td>{}</td><td>{:.2}</td></tr>",
            if best { " class=\"best\"" } else { "" },
            escape(&f.method),
            escape(&row.dial),
            escape(&row.value),
            percent(f.relative_rmse),
            percent(f.relative_rmse_standard_error),
            100.0 * f.bias,
            f.flip,
            f.seconds.total,
            f.pack_bytes,
            f.bits_per_active_voxel
        );
    }
    out.push_str("</table></div>\n");
    if !group.refused.is_empty() {
        out.push_str("<p>Left out:</p>\n<ul>\n");
        for [dial, value, why] in &group.refused {
            let _ = writeln!(out, "<li>{} {}: {}</li>", escape(dial), escape(value), escape(why));
        }
        out.push_str("</ul>\n");
    }
}

/// Dial and value in words.
fn turned(row: &Row) -> String {
    if row.dial == DEFAULTS { DEFAULTS.into() } else { format!("{} {}", row.dial, row.value) }
}

/// A PNG file as an element that holds it.
fn picture(path: &Path) -> Result<String, Failure> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    Ok(format!("<img alt=\"\" src=\"data:image/png;base64,{}\">", base64(&bytes)))
}

/// Base64 with padding (RFC 4648, section 4).
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let bits = (0..3).fold(0u32, |bits, i| bits << 8 | u32::from(group.get(i).copied().unwrap_or(0)));
        for digit in 0..4 {
            let at = bits >> (18 - 6 * digit) & 63;
            out.push(if digit <= group.len() { char::from(DIGITS[at as usize]) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::table::tests::group;
    use super::*;
    use smoke_formats::image::{RgbImage, write_png};

    #[test]
    fn base64_is_that_of_rfc_4648() {
        let cases = [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")];
        assert!(cases.iter().all(|(plain, coded)| base64(plain.as_bytes()) == *coded));
        assert_eq!(base64(&[0xfb, 0xff, 0xfe]), "+//+");
    }

    fn page() -> String {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path(), false).unwrap();
        let rows = [
            ("defaults", "", "compensated grid", 0.017, 1.0),
            ("defaults", "", "compensated centres", 0.06, 0.5),
            ("sh-order", "1", "compensated grid", 0.2, 0.4),
            ("exponential", "<linear>", "compensated centres", 0.0, 0.3),
        ];
        let group = group(&rows);
        let pixels = vec![[0.5; 3]; 96];
        let image = RgbImage { width: 12, height: 8, pixels };
        for key in group.rows.iter().map(|row| &row.picture).chain([&group.picture]) {
            write_png(&store.picture(key), &image).unwrap();
            write_png(&store.difference(key), &image).unwrap();
        }
        let mut other = group.clone();
        other.place.frame = 8;
        html(&[group, other], Path::new("a&b.####.vdb"), &store).unwrap()
    }

    #[test]
    fn a_page_refers_to_nothing_outside_itself_and_runs_nothing() {
        let page = page();
        for outside in ["http", "//", "<script", "<link", "@import", "url(", "<iframe", "href=", "javascript", "onload"]
        {
            let found = page.split("base64,").map(|part| part.split_once('"').map_or(part, |(_, rest)| rest));
            // The first part has no picture before it.
            let mut text: Vec<&str> = found.collect();
            text[0] = page.split("base64,").next().unwrap();
            assert!(text.iter().all(|part| !part.contains(outside)), "{outside}");
        }
        let sources = page.matches("src=\"").count();
        assert!(sources > 8 && sources == page.matches("src=\"data:image/png;base64,").count());
    }

    #[test]
    fn a_page_shows_every_plot_and_row_and_escapes_all_names() {
        let page = page();
        for part in ["Error against seconds", "Error by dial", "Pareto front", "path tracer", "Pictures", "All rows"] {
            assert!(page.contains(part), "{part}");
        }
        assert_eq!(page.matches("<svg").count(), page.matches("</svg>").count());
        assert!(page.contains("exponential") && page.contains("&lt;linear&gt;") && page.contains("a&amp;b"));
        assert!(page.contains("no &lt;Gaussians&gt;") && page.contains("prefers-color-scheme: dark"));
        assert!(!page.contains("<linear>") && !page.contains("NaN") && !page.contains("inf"));
        // Of each reference: 4 rows, 2 of them on the front (the fastest is the best; the one of error 0).
        assert!(page.matches("class=\"best\"").count() >= 2);
    }
}
