#!/usr/bin/env python3
"""Holds the program's path tracer against Mitsuba 3 by a z-test (`z_test.py`), on the same density and the same scene.

    cargo build --release
    python3 -m venv venv && venv/bin/pip install mitsuba numpy scipy
    venv/bin/python benches/peers/reference.py --work WORK

Three frames of the plume under each of: the scene as it is, g = 0.85, an RGB albedo, a sun instead of the sky, single
scattering. Both take the density from the same pack: ours reads it, Mitsuba gets what `unpack` wrote. The scene means
the same in both (`mitsuba_scene.py`, checked by `check_mitsuba_scene.py`). Last, the scene once more with the program's
albedo 1 % off: that must be found. A pixel counts in the share beyond 2 SE where Mitsuba's camera rays are expected to
collide at least 100 times in all, by the exact opacity of ours. Over the frames of a scene together, sum(z) / sqrt(frames)
must be within 3 too: a bias too small for one frame. Mitsuba's images are kept in --work. Needs Debian's python3-openvdb for
`grid_to_npz.py`, and a libLLVM (see `mitsuba_scene.py`). Ends with exit code 1 if anything misses.
"""
import copy
import json
import pathlib
import sys
import tomllib

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import mitsuba_scene as ms
import z_test
from program import Program, channels, finish, options, seconds, standard_error

FRAMES = (1020, 1040, 1060)
SUN = [{"kind": "directional", "direction": [0.9, 0.35, -0.5], "irradiance": [14.0, 12.5, 10.5]}]
# Name: changes to the scene file, options of `render`, scattering orders.
VARIANTS = {
    "sky": ({}, [], "all"),
    "g = 0.85": ({"g": 0.85}, ["--g", 0.85], "all"),
    "RGB albedo": ({"albedo": [0.95, 0.8, 0.6]}, ["--albedo", "0.95,0.8,0.6"], "all"),
    "sun": ({"light": SUN}, [], "all"),
    "single": ({}, ["--order", "single"], "single"),
}
# With 100 expected collisions a count is off by a tenth, and so nearly normal that a tail beyond 2 SE is off by a tenth.
LEAST_COLLISIONS = 100
PLANTED = "albedo 1 % off"


def scene_file(program, base, changes):
    """The scene for the program: the file itself, or a copy with other lights."""
    if "light" not in changes:
        return base
    path = program.work / "sun.toml"
    head = base.read_text().split("[[light]]")[0]
    lines = [f"{key} = {value!r}" for light in changes["light"] for key, value in light.items()]
    path.write_text(head + "[[light]]\n" + "\n".join(lines) + "\n")
    return path


def changed(scene, changes, width, height):
    scene = copy.deepcopy(scene)
    scene["image"] = {"width": width, "height": height}
    scene["light"] = changes.get("light", scene["light"])
    scene["medium"].update({key: value for key, value in changes.items() if key != "light"})
    return scene


def mitsubas(program, chosen, frame, variant):
    """Mitsuba's estimate, from --work if it is there."""
    changes, _, order = VARIANTS[variant]
    name = f"{frame}_{variant}_{chosen.width}x{chosen.height}_{chosen.passes}x{chosen.spp}".replace(" ", "")
    path = program.work / f"mitsuba_{name}.npz"
    if not path.exists():
        scene = changed(tomllib.loads(chosen.scene.read_text()), changes, chosen.width, chosen.height)
        passes = ms.Passes(ms.build(scene, program.density(frame), chosen.scene.parent, order, program.peers), chosen.spp)
        spent = passes.run(chosen.passes)
        np.savez_compressed(path, mean=passes.mean, standard_error=passes.standard_error(), passes=passes.count, seconds=spent)
    stored = np.load(path)
    return z_test.Estimate(stored["mean"], stored["standard_error"], int(stored["passes"])), float(stored["seconds"])


def ours(program, chosen, frame, variant, *planted):
    changes, dials, _ = VARIANTS[variant]
    image = program.work / "ours.exr"
    report = program.render(program.pack(frame), scene_file(program, chosen.scene, changes), image, "--method", "reference",
                            "--target-error", chosen.target_error, "--width", chosen.width, "--height", chosen.height, *dials, *planted)
    return z_test.Estimate(channels(image), standard_error(image), report["passes"]), channels(image, ["A"])[..., 0], seconds(report)


def relative(estimate):
    return float(np.sqrt((estimate.standard_error**2).mean() / (estimate.mean**2).mean()))


def main():
    parser = options(__doc__)
    parser.add_argument("--scene", type=pathlib.Path, help="[default: scenes/plume.toml of the peers]")
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--width", type=int, default=80)
    parser.add_argument("--height", type=int, default=100)
    parser.add_argument("--passes", type=int, default=64, help="of Mitsuba")
    parser.add_argument("--spp", type=int, default=32, help="of each pass of Mitsuba")
    parser.add_argument("--target-error", default="1%", help="relative standard error of ours")
    parser.add_argument("--json", type=pathlib.Path, help="[default: reference.json in --work]")
    chosen = finish(parser)
    chosen.scene = chosen.scene or chosen.peers / "scenes" / "plume.toml"
    program, results = Program(chosen), []
    print("frame  variant         channel  z of mean  mean off   beyond 2 SE  expected  bound    largest  ours SE  Mitsuba SE")

    def test(frame, variant, name, must_pass, *planted):
        theirs, their_seconds = mitsubas(program, chosen, frame, variant)
        mine, opacity, my_seconds = ours(program, chosen, frame, variant, *planted)
        rows = z_test.compare(mine, theirs, opacity * chosen.passes * chosen.spp >= LEAST_COLLISIONS)
        good = all(row["passes"] for row in rows) == must_pass
        for row in rows:
            note = "" if row["passes"] else "  MISS" if must_pass else "  found, as it must be"
            print(f"{frame}   {name:<15} {row['channel']}        {row['z_of_mean']:+9.2f}  {100 * row['difference_of_means']:+8.3f} %  {100 * row['beyond']:8.2f} %  "
                  f"{100 * row['expected']:6.2f} %  {100 * row['bound']:5.2f} %  {row['largest']:6.2f}  {100 * relative(mine):5.2f} %  {100 * relative(theirs):5.2f} %{note}", flush=True)
        results.append({"frame": frame, "variant": name, "good": good, "channels": rows, "passes": mine.passes,
                        "relative_error": relative(mine), "mitsuba_relative_error": relative(theirs),
                        "seconds": my_seconds, "mitsuba_seconds": their_seconds})

    pooled = {}
    for variant in chosen.variants:
        for frame in chosen.frames:
            test(frame, variant, variant, True)
        z = [[row["z_of_mean"] for row in r["channels"]] for r in results if r["variant"] == variant]
        pooled[variant] = list(np.sum(z, axis=0) / np.sqrt(len(z)))
        print(f"all    {variant:<15} RGB      " + " ".join(f"{v:+.2f}" for v in pooled[variant]), flush=True)
    albedo = tomllib.loads(chosen.scene.read_text())["medium"]["albedo"]
    for frame in chosen.frames:
        test(frame, "sky", PLANTED, False, "--albedo", ",".join(str(0.99 * a) for a in albedo))
    document = {"scene": chosen.scene.name, "width": chosen.width, "height": chosen.height, "passes": chosen.passes,
                "spp": chosen.spp, "target_error": chosen.target_error, "results": results, "pooled_z": pooled}
    (chosen.json or program.work / "reference.json").write_text(json.dumps(document, indent=1) + "\n")
    missed = [f"{r['frame']} {r['variant']}" for r in results if not r["good"]]
    missed += [f"{variant} over all frames" for variant, z in pooled.items() if not np.abs(z).max() <= z_test.Z_OF_MEAN]
    print(f"missed: {', '.join(missed)}" if missed else f"all {len(results)} as they must be")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
