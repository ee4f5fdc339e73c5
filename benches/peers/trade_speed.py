"""Sections of docs/trade.md about speed: the path tracer and the fast method, each beside Mitsuba 3, in pairs.

Mitsuba is run for a fixed number of samples and its seconds scaled to the error asked: they go with its inverse square.
Each round runs Mitsuba, then the program; a ratio is that of the medians over the rounds. Mitsuba's kernel is compiled
before the first round, its scene is loaded, the program's frame is decoded: none of these is in the seconds.
"""
import json
import statistics
import tomllib

import mitsuba as mi
import numpy as np

import mitsuba_scene as ms
from pictures import FULL_SCALE, panels
from program import channels, relative_error, seconds, standard_error
from reference import FRAMES, VARIANTS, changed, scene_file

TARGET = 0.02
TRACER_BAR, FAST_BAR = 3, 50
# Russian roulette from this depth on: of 2, 5, 16, 64 and the shared script's 256 the one with the least error^2 times
# processor seconds, under the sky, at g = 0.85 and with an RGB albedo (256 takes 1 to 11 % more, 5 takes 2 to 53 % more).
ROULETTE = 16
# The seed of references; the program's own images have another.
TRUTH = ["--method", "reference", "--seed", 1001]
FAST_DIALS = {
    "default": [],
    "coarse: `--beams 32 --scatter-step 4`": ["--beams", 32, "--scatter-step", 4],
    "fine: `--beams 256 --scatter-step 1 --samples 2`": ["--beams", 256, "--scatter-step", 1, "--samples", 2],
}


def integrator(order):
    single = order == "single"
    return mi.load_dict({"type": "volpath", "max_depth": 2 if single else -1, "rr_depth": 10**6 if single else ROULETTE, "hide_emitters": True})


def mitsuba_passes(program, chosen, frame, changes, order, width, height, spp):
    scene = changed(tomllib.loads(chosen.scene.read_text()), changes, width, height)
    passes = ms.Passes(ms.build(scene, program.density(frame), chosen.scene.parent, order, program.peers), spp, integrator(order))
    passes.warm_up()
    return passes


def tracer(program, chosen):
    """Seconds to 2 % relative standard error, the path tracer beside Mitsuba."""
    width, height = chosen.tracer_size
    pairs = [(1040, variant) for variant in VARIANTS] + [(frame, "sky") for frame in FRAMES if frame != 1040]
    lines, missed = [], []
    for frame, variant in pairs:
        changes, dials, order = VARIANTS[variant]
        passes = mitsuba_passes(program, chosen, frame, changes, order, width, height, chosen.spp)
        scene, ours, errors = scene_file(program, chosen.scene, changes), [], []
        for _ in range(chosen.rounds):
            passes.run(chosen.passes)
            report = program.render(program.pack(frame), scene, program.work / "tracer.exr", "--method", "reference",
                                    "--target-error", TARGET, "--width", width, "--height", height, *dials)
            ours.append(seconds(report))
            errors.append(report["relative_error"])
        theirs = statistics.median(passes.seconds) * (passes.relative_error(chosen.passes) / TARGET) ** 2
        ratio = theirs / statistics.median(ours)
        if not ratio >= TRACER_BAR:
            missed.append(f"path tracer, {frame} {variant}: {ratio:.2f} times as fast, bar {TRACER_BAR}")
        lines.append(f"| {frame} | {variant} | {statistics.median(passes.seconds):.1f} s to {100 * passes.relative_error(chosen.passes):.2f} % | "
                     f"{theirs:.1f} s | {statistics.median(ours):.2f} s ({100 * statistics.median(errors):.2f} %) | **{ratio:.1f}** |")
        print(lines[-1], flush=True)
    head = [
        "## The path tracer beside Mitsuba's", "",
        f"Seconds to {100 * TARGET:.0f} % relative standard error, {width} x {height} pixels, `plume.toml` and its changes; Mitsuba {mi.__version__}, `llvm_ad_rgb`, "
        f"`volpath`, all cores. {chosen.rounds} rounds of Mitsuba ({chosen.passes} x {chosen.spp} samples a pixel) and `render --method reference --target-error 2%`, one after the other; "
        f"the ratio is that of the medians, bar {TRACER_BAR}. Mitsuba's seconds are scaled from the error that its samples have, by the square. "
        "Loading, decoding and Mitsuba's compilation are not counted. Russian roulette starts at depth "
        f"{ROULETTE} in Mitsuba, where it is fastest.", "",
        "| frame | scene | Mitsuba, measured | Mitsuba, to 2 % | ours, to 2 % (reached) | times as fast |", "|---|---|---|---|---|---|"]
    return head + lines, missed


def fast(program, chosen):
    """The fast method beside Mitsuba at equal error."""
    width, height = chosen.fast_size
    size = ["--width", width, "--height", height]
    frame, truth = 1040, program.work / f"truth_{width}x{height}.exr"
    if not truth.exists():
        report = program.render(program.pack(frame), chosen.scene, truth, *TRUTH, "--target-error", chosen.truth_error, *size)
        truth.with_suffix(".json").write_text(json.dumps(report))
    noise = json.loads(truth.with_suffix(".json").read_text())["relative_error"]
    passes = mitsuba_passes(program, chosen, frame, {}, "all", width, height, chosen.spp)
    image = program.work / "fast.exr"
    times, walls, errors = ({name: [] for name in FAST_DIALS} for _ in range(3))
    for _ in range(chosen.rounds):
        passes.run(chosen.passes)
        for name, dials in FAST_DIALS.items():
            report = program.render(program.pack(frame), chosen.scene, image, "--method", "compensated", *size, *dials)
            times[name].append(seconds(report))
            walls[name].append(report["wall_seconds"])
            errors[name].append(relative_error(channels(image), channels(truth), standard_error(truth), channels(truth, ["A"])[..., 0] > 0))
            if name == "default":
                panels(chosen.images / "trade_fast.png", channels(image), channels(truth))
    lines, missed = [], []
    for name in FAST_DIALS:
        error, ours = errors[name][0], statistics.median(times[name])
        if not error > 0:
            lines.append(f"| {name} | below what the reference's noise can tell | {ours:.2f} s | {statistics.median(walls[name]):.2f} s | | |")
            continue
        theirs = statistics.median(passes.seconds) * (passes.relative_error(chosen.passes) / error) ** 2
        lines.append(f"| {name} | {100 * error:.2f} % | {ours:.2f} s | {statistics.median(walls[name]):.2f} s | {theirs:.0f} s | **{theirs / ours:.0f}** |")
        print(lines[-1], flush=True)
        if name == "default" and not theirs / ours >= FAST_BAR:
            missed.append(f"fast method: {theirs / ours:.1f} times as fast, bar {FAST_BAR}")
    head = [
        "## The fast method beside Mitsuba, at equal error", "",
        f"`plume.toml`, frame {frame}, {width} x {height} pixels. Error: relative RMSE over the pixels with smoke against our path tracer ({100 * noise:.2f} % of its own noise, taken out). "
        f"Mitsuba's seconds are those to a relative standard error as large, scaled from {statistics.median(passes.seconds):.1f} s to {100 * passes.relative_error(chosen.passes):.2f} % "
        f"({chosen.passes} x {chosen.spp} samples a pixel), {chosen.rounds} rounds, in turn with ours; bar for the default {FAST_BAR}.", "",
        "| dials | error | ours, decoded frame to image | the whole process | Mitsuba to that error | times as fast |", "|---|---|---|---|---|---|"]
    tail = ["", "![The fast method, the path tracer, and the difference](images/trade_fast.png)", "",
            f"*The default, the path tracer, and their difference: red too bright, blue too dark, full at {100 * FULL_SCALE:.0f} % of the mean radiance of the smoke.*"]
    return head + lines + tail, missed
