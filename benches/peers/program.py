"""The program as the peers' scripts use it: bake, unpack, render; and its images."""
import argparse
import json
import os
import pathlib
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np

import mitsuba_scene as ms


def options(doc):
    """A parser with what all scripts ask for: data, peers, program, work."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = os.environ.get("SMOKE_BAKE_DATA", ms.ROOT / ".." / "shared" / "data")
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path(data), help="folder with plume/ and env/")
    parser.add_argument("--peers", type=pathlib.Path, help="folder of mitsuba_reference.py and grid_to_npz.py [default: beside the data]")
    parser.add_argument("--program", type=pathlib.Path, default=ms.ROOT / "target" / "release" / "smoke-bake")
    parser.add_argument("--work", type=pathlib.Path, required=True, help="folder of packs and results to use and keep; remove it after a change")
    return parser


def finish(parser):
    """Parsed options, with their defaults and the work folder in place."""
    chosen = parser.parse_args()
    chosen.peers = chosen.peers or ms.peers_folder(chosen.data)
    chosen.work.mkdir(parents=True, exist_ok=True)
    return chosen


class Program:
    def __init__(self, chosen):
        self.path, self.data, self.peers, self.work = chosen.program, chosen.data, chosen.peers, chosen.work

    def run(self, *arguments):
        """Standard output of a run; a failure ends the script with the program's own line."""
        run = subprocess.run([str(self.path), *map(str, arguments)], capture_output=True, text=True)
        if run.returncode != 0:
            sys.exit(f"smoke-bake {' '.join(map(str, arguments))}: {run.stderr.strip()}")
        return run.stdout

    def pack(self, frame):
        """A frame of the plume, baked with the default settings."""
        path = self.work / f"plume_{frame}.smoke"
        if not path.exists():
            self.run("bake", self.data / "plume" / "plume.####.vdb", "--frames", frame, "-o", path, "--progress", "none")
        return path

    def transfer_pack(self, frame, sigma_t, albedo, g):
        """The same with the light's transfer for a medium."""
        path = self.work / f"plume_{frame}_transfer_{sigma_t}_{albedo}_{g}.smoke"
        if not path.exists():
            medium = path.with_suffix(".toml")
            camera = "[camera]\nposition = [0, -1, 0]\ntarget = [0, 0, 0]\nfov = 30\n[image]\nwidth = 1\nheight = 1\n"
            medium.write_text(f"{camera}[medium]\nsigma_t = {sigma_t}\nalbedo = {albedo}\ng = {g}\n")
            self.run("bake", self.data / "plume" / "plume.####.vdb", "--frames", frame, "-o", path, "--progress", "none",
                     "--transfer", "dsf642", "--medium", medium)
        return path

    def density(self, frame):
        """The density of that pack, not of its source, as `grid_to_npz.py` leaves it."""
        path = self.work / f"plume_{frame}.npz"
        if not path.exists():
            volume = path.with_suffix(".vdb")
            self.run("unpack", self.pack(frame), "-o", volume, "--progress", "none")
            subprocess.run(["/usr/bin/python3", str(self.peers / "grid_to_npz.py"), str(volume), str(path)], check=True, stdout=subprocess.DEVNULL)
        return np.load(path)

    def render(self, pack, scene, image, *dials):
        """One frame to `image`; what `--json` says of it, and `wall_seconds` of the whole process."""
        start = time.perf_counter()
        text = self.run("render", pack, "--scene", scene, "-o", image, "--float", "--json", "--progress", "none", *dials)
        report = json.loads(text)
        return {**report["frames"][0], "settings": report["settings"], "wall_seconds": time.perf_counter() - start}


def seconds(report):
    """From the decoded frame to the image: all stages but reading and writing."""
    return sum(value for stage, value in report["seconds"].items() if stage not in ("decode", "write"))


def channels(path, names=("R", "G", "B")):
    """Channels of an EXR, rows x columns x names; None if one is missing."""
    bitmap = mi.Bitmap(str(path))
    found = [field.name for field in bitmap.struct_()]
    values = np.array(bitmap).reshape(bitmap.height(), bitmap.width(), -1).astype(np.float64)
    return np.stack([values[..., found.index(n)] for n in names], -1) if set(names) <= set(found) else None


def standard_error(path):
    return channels(path, [f"standard_error.{c}" for c in "RGB"])


def relative_error(image, truth, error, seen):
    """Relative RMSE over the pixels `seen`, the noise of the truth taken out: its variance adds to the squares of both."""
    variance = (error[seen] ** 2).mean()
    squares = ((image[seen] - truth[seen]) ** 2).mean() - variance
    return float(np.sqrt(max(squares, 0.0) / ((truth[seen] ** 2).mean() - variance)))
