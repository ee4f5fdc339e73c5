#!/usr/bin/env python3
"""Measures the fast method's images against the path tracer's, and writes docs/accuracy.md with its pictures.

    cargo build --release
    python3 -m venv venv && venv/bin/pip install mitsuba numpy
    venv/bin/python benches/peers/accuracy.py --work WORK

Mitsuba only reads and writes images here; that the tracer agrees with it is shown by `reference.py`. Packs and references
are kept in --work. Ends with exit code 1 if an image of the default route misses its bar.
"""
import json
import pathlib
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")

from pictures import panels
from program import Program, channels, finish, options

FRAMES = (1020, 1040, 1060)
BARS = {"single": 0.05, "all": 0.10}
GRID = ("grid (default)", [])
TRANSFER = ("transfer", [])
# That of plume.toml: sigma_t, albedo, g.
MEDIUM = (8.0, 0.92, 0.0)
CENTRES = [
    ("centres: direct, integral", ["--exponential", "direct"], ["--multiple", "integral"]),
    ("centres: pointwise, integral", ["--exponential", "pointwise"], ["--multiple", "integral"]),
    ("centres: hybrid, integral", ["--exponential", "hybrid"], ["--multiple", "integral"]),
    ("centres: direct, diffusion", ["--exponential", "direct"], ["--multiple", "diffusion"]),
    ("centres: linear, diffusion (the paper)", ["--exponential", "linear"], ["--multiple", "diffusion"]),
]


class Measure:
    def __init__(self, program, chosen):
        self.program, self.chosen = program, chosen

    def reference(self, frame, name, scene):
        path = self.program.work / f"accuracy_{frame}_{name}.exr"
        if not path.exists():
            self.program.render(self.program.pack(frame), self.chosen.scene, path, "--method", "reference",
                                "--seed", 1001, "--target-error", self.chosen.reference_error, *scene)
        return path

    def error(self, frame, name, scene, *dials, transfer=None):
        """Relative RMSE where A > 0 with the reference's noise taken out, and bias; by `compare`. `transfer` is the medium
        (sigma_t, albedo, g) that transfer is baked for, if that is the method."""
        image, reference = self.program.work / "image.exr", self.reference(frame, name, scene)
        pack = self.program.transfer_pack(frame, *transfer) if transfer else self.program.pack(frame)
        method = "transfer" if transfer else "compensated"
        self.program.render(pack, self.chosen.scene, image, "--method", method, *scene, *dials)
        found = json.loads(self.program.run("compare", image, reference, "--mask-alpha", "--json"))
        return found["debiased"]["all"]["relative_rmse"], found["all"]["bias"], image, reference


def percent(value):
    return f"{100 * value:.2f} %"


def signed(value):
    return f"{100 * value:+.2f} %"


def orders(measure, chosen, page, missed):
    size = ["--width", chosen.width, "--height", chosen.height]
    for order in ("single", "all"):
        page.append(f"\n### Order: {order} (bar for the default: {percent(BARS[order])})\n")
        page.append("| route | " + " | ".join(f"{f}: error | bias" for f in FRAMES) + " |")
        page.append("|---|" + "---|" * (2 * len(FRAMES)))
        routes = [GRID]
        for name, exponential, multiple in CENTRES:
            dials = ["--route", "centres", *exponential]
            if order == "all":
                routes.append((name, dials + multiple))
            elif name.split(",")[0] not in [r[0] for r in routes]:
                routes.append((name.split(",")[0], dials))
        for name, dials in [*routes, TRANSFER]:
            cells = []
            for frame in FRAMES:
                scene, transfer = [*size, "--order", order], MEDIUM if name == TRANSFER[0] else None
                rmse, bias, image, reference = measure.error(frame, order, scene, "--samples", 2, *dials, transfer=transfer)
                cells += [percent(rmse), signed(bias)]
                if name == GRID[0] and not rmse <= BARS[order]:
                    missed.append(f"frame {frame}, {order}: {percent(rmse)} above {percent(BARS[order])}")
                if name == GRID[0] and (order, frame) == ("all", 1060):
                    panels(chosen.page.parent / "images" / "accuracy.png", channels(image), channels(reference))
            page.append(f"| {name} | " + " | ".join(cells) + " |")
            print(page[-1], flush=True)


def media(measure, page):
    paper = CENTRES[-1]
    page.append("| sigma_t | albedo | grid: error | bias | centres: error | bias | paper: error | bias | transfer: error | bias |")
    page.append("|---|---|---|---|---|---|---|---|---|---|")
    for sigma in (2, 8, 32):
        for albedo in (0.5, 0.92, 0.99):
            scene = ["--sigma-t", sigma, "--albedo", albedo, "--g", 0.5, "--width", 80, "--height", 100]
            cells = []
            routes = ([], ["--route", "centres"], ["--route", "centres", *paper[1], *paper[2]])
            # Each of transfer is a bake of its own.
            baked = [([], (sigma, albedo, 0.5))] if albedo == 0.92 else []
            for dials, transfer in [*((dials, None) for dials in routes), *baked]:
                rmse, bias, _, _ = measure.error(1040, f"{sigma}_{albedo}", scene, "--samples", 4, *dials, transfer=transfer)
                cells += [percent(rmse), signed(bias)]
            cells += ["", ""] if not baked else []
            page.append(f"| {sigma} | {albedo} | " + " | ".join(cells) + " |")
            print(page[-1], flush=True)


def main():
    parser = options(__doc__)
    parser.add_argument("--scene", type=pathlib.Path, help="[default: scenes/plume.toml of the peers]")
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=200)
    parser.add_argument("--reference-error", default="1%", help="relative standard error of the references")
    parser.add_argument("--page", type=pathlib.Path, default=pathlib.Path(__file__).parents[2] / "docs" / "accuracy.md")
    chosen = finish(parser)
    chosen.scene = chosen.scene or chosen.peers / "scenes" / "plume.toml"
    measure, missed = Measure(Program(chosen), chosen), []
    page = [HEAD.format(error=chosen.reference_error, width=chosen.width, height=chosen.height)]
    orders(measure, chosen, page, missed)
    page.append(PICTURE + MEDIA)
    media(measure, page)
    page.append(FOOT)
    chosen.page.write_text("\n".join(page) + "\n")
    for line in missed:
        print(line, file=sys.stderr)
    sys.exit(1 if missed else 0)


HEAD = """# Accuracy: the fast method against unbiased references

Generated by `python3 benches/peers/accuracy.py --work WORK --width {width} --height {height} --reference-error {error}`, through the program itself: `bake` (default settings, one frame a pack), `render`, `compare --mask-alpha`.

The error is the relative RMSE over the pixels with smoke: root mean square of the error over that of the reference. Bias is the mean error over the reference's mean. References are `render --method reference --target-error {error}`, which agrees with Mitsuba 3 ([trade.md](trade.md)); their noise is taken out of the error by their own standard errors (`compare`: debiased). "Transfer" is `bake --transfer dsf642` with its defaults for the medium of the row, and `render --method transfer`.

## The plume under a sunset

`plume.toml`: {width} x {height}, sigma_t 8, albedo 0.92, isotropic. SH order 4, 4 rays a pixel."""

PICTURE = """
![The default, the reference, and the difference](images/accuracy.png)

*Frame 1060, all orders: the default, the reference, and their difference: red too bright, blue too dark, full at 20 % of the mean radiance of the smoke.*
"""

MEDIA = """
## Media

Frame 1040, g = 0.5, all orders, 80 x 100 pixels, 16 rays a pixel (a pixel is two voxels wide). "Centres" is direct, integral; "paper" is linear, diffusion. Transfer is baked for one albedo.
"""

FOOT = """
## Reading it

- The grid route is the default because of these tables.
- At the centres, direct and pointwise exponentials end nearly level: what is left is mostly the interpolation of source radiance between the centres, not the exponential. It grows with sigma_t, as the mean free path falls below a Gaussian's radius.
- The paper's own pair, optimal-linear exponential and diffusion, is far too dark in this medium: its exponential is good to a mean depth of 0.5 (`exponential.rs`), and its equations are used as corrected in `diffusion.rs`.
- What the grid route is off by comes from radiance that is read between nodes as if it were linear, where it falls off exponentially. At g = 0.5 the phase function's fourth and later bands are missing too (`--sh-order`).
- Transfer has the phase function itself for light that was scattered once, and photons' noise, cells of two voxels and compression for the rest. What a bake costs, and what a change of the light then takes: [decisions/050-transfer.md](decisions/050-transfer.md)."""

if __name__ == "__main__":
    main()
