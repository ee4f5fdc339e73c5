#!/usr/bin/env python3
"""Measures the program's images against unbiased references, and writes docs/accuracy.md.

    cargo build --release
    SMOKE_BAKE_DATA=../shared/data python3 benches/peers/accuracy.py

Needs numpy and mitsuba (only to read the references' own standard errors). The folder of the data holds
plume/plume.1020.vdb ...; the references of 320 x 400 lie in ../peers/references and their scene in ../peers/scenes
beside it, or where --references and --scene say. Packs are baked with the default settings into --work, unless they are
there already. Ends with exit code 1 if an image of the default route misses its bar.
"""
import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import mitsuba
import numpy as np

mitsuba.set_variant("scalar_rgb")
ROOT = pathlib.Path(__file__).resolve().parents[2]
FRAMES = (1020, 1040, 1060)
BARS = {"single": 0.05, "all": 0.10}
GRID = ("grid (default)", ["--route", "grid"])
CENTRES = [
    ("centres: direct, integral", ["--exponential", "direct"], ["--multiple", "integral"]),
    ("centres: pointwise, integral", ["--exponential", "pointwise"], ["--multiple", "integral"]),
    ("centres: hybrid, integral", ["--exponential", "hybrid"], ["--multiple", "integral"]),
    ("centres: direct, diffusion", ["--exponential", "direct"], ["--multiple", "diffusion"]),
    ("centres: linear, diffusion (the paper)", ["--exponential", "linear"], ["--multiple", "diffusion"]),
]


def channels(path):
    """R, G, B of an EXR as one array, and A if there is one."""
    bitmap = mitsuba.Bitmap(str(path))
    names = [field.name for field in bitmap.struct_()]
    values = np.array(bitmap).reshape(bitmap.height(), bitmap.width(), -1).astype(np.float64)
    rgb = np.stack([values[..., names.index(c)] for c in "RGB"], -1)
    return rgb, values[..., names.index("A")] if "A" in names else None


class Measure:
    def __init__(self, options, work):
        self.options, self.work = options, work

    def program(self, *arguments):
        run = subprocess.run([str(self.options.program), *map(str, arguments)], capture_output=True, text=True)
        if run.returncode != 0:
            sys.exit(f"{' '.join(map(str, arguments))}: {run.stderr.strip()}")
        return run.stdout

    def pack(self, frame):
        path = self.work / f"plume_{frame}.smoke"
        if not path.exists():
            source = self.options.data / "plume" / "plume.####.vdb"
            self.program("bake", source, "--frames", frame, "-o", path, "--progress", "none")
        return path

    def error(self, frame, reference, *dials):
        """Relative RMSE and bias where A > 0, the reference's own noise there, seconds of the source radiance."""
        image = self.work / "image.exr"
        report = json.loads(self.program("render", self.pack(frame), "--scene", self.options.scene, "-o", image,
                                         "--float", "--json", "--progress", "none", *dials))
        found = json.loads(self.program("compare", image, reference, "--mask-alpha", "--json"))["all"]
        (truth, _), (std, _) = channels(reference), channels(reference.with_suffix(".std.exr"))
        mask = channels(image)[1] > 0
        noise = np.sqrt((std[mask] ** 2).mean() / (truth[mask] ** 2).mean())
        return found["relative_rmse"], found["bias"], noise, report["frames"][0]["seconds"]


def percent(value):
    return f"{100 * value:.1f} %"


def signed(value):
    return f"{100 * value:+.1f} %"


def main():
    data = os.environ.get("SMOKE_BAKE_DATA", ROOT / ".." / "shared" / "data")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path(data))
    parser.add_argument("--references", type=pathlib.Path)
    parser.add_argument("--scene", type=pathlib.Path)
    parser.add_argument("--program", type=pathlib.Path, default=ROOT / "target" / "release" / "smoke-bake")
    parser.add_argument("--work", type=pathlib.Path, help="folder of packs to use and keep")
    parser.add_argument("--page", type=pathlib.Path, default=ROOT / "docs" / "accuracy.md")
    options = parser.parse_args()
    peers = options.data / ".." / "peers"
    options.references = options.references or peers / "references"
    options.scene = options.scene or peers / "scenes" / "plume.toml"
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or pathlib.Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        missed = write_page(Measure(options, work), options)
    for line in missed:
        print(line, file=sys.stderr)
    sys.exit(1 if missed else 0)


def write_page(measure, options):
    missed = []
    page = [HEAD]
    for order in ("single", "all"):
        page.append(f"\n### Order: {order} (bar for the default: {percent(BARS[order])})\n")
        page.append("| route | " + " | ".join(f"{f}: RMSE | bias" for f in FRAMES) + " |")
        page.append("|---|" + "---|" * (2 * len(FRAMES)))
        routes = [GRID]
        for name, exponential, multiple in CENTRES:
            dials = ["--route", "centres", *exponential]
            if order == "all":
                routes.append((name, dials + multiple))
            elif name.split(",")[0] not in [r[0] for r in routes]:
                routes.append((name.split(",")[0], dials))
        noises = {}
        for name, dials in routes:
            cells = []
            for frame in FRAMES:
                suffix = "_single" if order == "single" else ""
                reference = options.references / f"plume_{frame}{suffix}.exr"
                rmse, bias, noises[frame], _ = measure.error(frame, reference, "--order", order, *dials)
                cells += [percent(rmse), signed(bias)]
                if name == GRID[0] and not rmse <= BARS[order]:
                    missed.append(f"frame {frame}, {order}: {percent(rmse)} above {percent(BARS[order])}")
            page.append(f"| {name} | " + " | ".join(cells) + " |")
        page.append("| *noise of the reference* | " + " | ".join(f"{percent(noises[f])} | " for f in FRAMES) + " |")
    page.append(MEDIA)
    page.append("| sigma_t | albedo | grid: RMSE | bias | centres: RMSE | bias | paper: RMSE | bias | noise of the reference |")
    page.append("|---|---|---|---|---|---|---|---|---|")
    own = ROOT / "benches" / "peers" / "references"
    paper = CENTRES[-1]
    for sigma in (2, 8, 32):
        for albedo in (0.5, 0.92, 0.99):
            reference = own / f"plume_1040_g0.5_sigma{sigma}_albedo{albedo}.exr"
            medium = ["--sigma-t", sigma, "--albedo", albedo, "--g", 0.5, "--width", 80, "--height", 100, "--samples", 4]
            cells = []
            for dials in (GRID[1], ["--route", "centres"], ["--route", "centres", *paper[1], *paper[2]]):
                rmse, bias, noise, _ = measure.error(1040, reference, *medium, *dials)
                cells += [percent(rmse), signed(bias)]
            page.append(f"| {sigma} | {albedo} | " + " | ".join(cells) + f" | {percent(noise)} |")
    page.append(FOOT)
    options.page.write_text("\n".join(page) + "\n")
    return missed


HEAD = """# Accuracy: rendered images against unbiased references

Generated by `SMOKE_BAKE_DATA=../shared/data python3 benches/peers/accuracy.py`, through the program itself: `bake` (default settings, one frame a pack), `render`, `compare --mask-alpha`.

The figure is the relative RMSE over the pixels with smoke: root mean square of the error over that of the reference. Bias is the mean error over the reference's mean. The references are Monte Carlo and carry noise of their own, which is in every figure: an exact image would score the noise, and a figure near it cannot be told from exact.

## The plume under a sunset

`plume.toml`: 320 x 400, sigma_t 8, albedo 0.92, isotropic. SH order 4."""

MEDIA = """
## Media

Frame 1040, g = 0.5, all orders, 80 x 100 pixels, 16 rays a pixel (a pixel is two voxels wide). References: `benches/peers/references`. "Centres" is direct, integral; "paper" is linear, diffusion.
"""

FOOT = """
## Reading it

- The grid route is the default because of these tables.
- At the centres, direct and pointwise exponentials end nearly level: what is left is mostly the interpolation of source radiance between the centres, not the exponential. It grows with sigma_t, as the mean free path falls below a Gaussian's radius.
- The paper's own pair, optimal-linear exponential and diffusion, is far too dark in this medium: its exponential is good to a mean depth of 0.5 (`exponential.rs`), and its equations are used as corrected in `diffusion.rs`.
- The grid route is about a per cent too bright: radiance is read between nodes as if it were linear, where it falls off exponentially. At g = 0.5 the phase function's fourth and later bands are missing too (`--sh-order`)."""

if __name__ == "__main__":
    main()
