"""Section of docs/trade.md with the plots of `smoke-bake sweep`: error against seconds, error against size."""
import re

import mitsuba_scene as ms

# The plots that are taken, of the first scene and frame; the dials one by one are left to the sweep's own page.
TAKEN = ["Error against seconds", "Error against size of the pack"]


def figures(page):
    """The SVG pictures of a self-contained page, each made to stand alone: its namespace, and the page's style."""
    style = "".join(re.findall(r"<style.*?</style>", page, re.S))
    for title, svg in re.findall(r"(?:<h[2-4][^>]*>([^<]*)</h[2-4]>(?:(?!<h[2-4]|<svg).)*)?(<svg\b.*?</svg>)", page, re.S):
        opening, rest = svg.split(">", 1)
        if "xmlns=" not in opening:
            opening += ' xmlns="http://www.w3.org/2000/svg"'
        yield title.strip(), f"{opening}>{style}{rest}\n"


def sweep(program, chosen):
    """Sweeps the shipped sequence, as the guide does, and takes the plots of its page."""
    folder, scene = program.work / "sweep", ms.ROOT / "testdata" / "scenes" / "sunset.toml"
    source = ms.ROOT / "testdata" / "plume" / "plume.####.vdb"
    program.run("sweep", source, "--scene", scene, "-o", folder, "--resume", "--progress", "none", *chosen.sweep_options)
    lines = ["## Every dial", "",
             "`smoke-bake sweep testdata/plume/plume.####.vdb --scene testdata/scenes/sunset.toml -o sweep` on the sequence that comes with the program. "
             "Its page, `sweep/index.html`, has these plots with their legends and the pictures of each point; `sweep.csv` and `sweep.json` have the figures."]
    for old in chosen.images.glob("trade_sweep_*.svg"):
        old.unlink()
    plots = {}
    for title, svg in figures((folder / "index.html").read_text()):
        if title in TAKEN:
            plots.setdefault(title, svg)
    for count, (title, svg) in enumerate(plots.items(), 1):
        name = f"trade_sweep_{count}.svg"
        (chosen.images / name).write_text(svg)
        lines += ["", f"![{title}](images/{name})"]
    return lines, [f"sweep: no plot {title!r} in its page" for title in TAKEN if title not in plots]
