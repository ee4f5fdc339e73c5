#!/usr/bin/env python3
"""Holds every part of a Mitsuba scene from `mitsuba_scene.py` against our own definition of it.

    cargo build --release
    python3 benches/peers/check_mitsuba_scene.py [--data ../shared/data]

Needs numpy and mitsuba. Each line is the largest error in units of its tolerance, which is derived beside it; each
check is then run once more with a planted defect, and must see it. Ends with exit code 1 if anything is off.
"""
import argparse
import os
import pathlib
import subprocess
import sys
import tempfile

import mitsuba as mi
import numpy as np

import drjit as dr

mi.set_variant("llvm_ad_rgb")

import mitsuba_scene as ms

ULP = 2.0**-23
MAPS = ("sunset", "studio", "courtyard")
CAMERA = {"position": [1.4, -4.6, 1.9], "target": [1.3, 1.3, 1.6], "up": [0.1, 0.0, 1.0], "fov": 36.0}
# A sheared, mirrored box of noise, the border of zeros as grid_to_npz.py leaves it.
AXES = np.array([[0.1, 0.02, 0.0], [0.0, 0.08, -0.01], [0.03, 0.0, -0.12]])
CORNER = np.array([0.3, -0.4, 2.0])


def z_up(d, up):
    return d if up == "z" else np.stack([d[:, 0], -d[:, 2], d[:, 1]], -1)


def sky(image, d, rotation, up, spread=False):
    """`Environment::radiance_from` of runtime/src/light.rs in numpy; and, if asked, how far apart the texels around are."""
    height, width = image.shape[:2]
    d = z_up(np.asarray(d, np.float64), up)
    u = 0.5 - (np.arctan2(d[:, 1], d[:, 0]) - rotation) / (2 * np.pi)
    v = 0.5 - np.arcsin(np.clip(d[:, 2], -1, 1)) / np.pi
    x, y = (u - np.floor(u)) * width - 0.5, v * height - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    f, g = (x - i)[:, None], (y - j)[:, None]
    texel = lambda a, b: image[np.clip(j + b, 0, height - 1), (i + a) % width].astype(np.float64)
    value = (texel(0, 0) * (1 - f) + texel(1, 0) * f) * (1 - g) + (texel(0, 1) * (1 - f) + texel(1, 1) * f) * g
    if not spread:
        return value
    return value, np.ptp(np.stack([texel(a, b) for a in (-1, 0, 1, 2) for b in (-1, 0, 1, 2)]), axis=0)


def directions(count, seed):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def environments(data):
    """(light, up, base) for every map, turned or not, either axis up."""
    for name in MAPS:
        for rotation, up in ((0.0, "z"), (37.0, "z"), (-110.0, "y")):
            yield {"image": f"env/{name}.exr", "rotation": rotation, "intensity": 1.5}, up, data


def environment_by_direction(data, defect):
    """A direction in f32 is rounded when stored (1), turned by a matrix (3), off unit length (1), and goes through atan2
    or acos (4) and a shift and scale (3): 12 roundings, of angles over sin theta, of texel coordinates times W / 2 pi =
    H / pi. Radiance moves by that share of the spread of the texels around."""
    worst, d = 0.0, directions(400_000, 1)
    for light, up, base in environments(data):
        image = ms.radiance(light, base)
        plugin = ms.environment(light, up, base)
        if defect:
            plugin["bitmap"] = mi.Bitmap(image)
        si = dr.zeros(mi.SurfaceInteraction3f, len(d))
        si.wi = -mi.Vector3f(np.ascontiguousarray(d.T))
        found = np.array(mi.load_dict(plugin).eval(si)).T
        truth, spread = sky(image, d, np.radians(light["rotation"]), up, spread=True)
        sin_theta = np.sqrt(np.maximum(1 - z_up(d, up)[:, 2].astype(np.float64) ** 2, 1e-12))
        texels = np.minimum(12 * ULP / sin_theta * image.shape[0] / np.pi, 1)
        tolerance = spread * texels[:, None] + 8 * ULP * (truth + spread) + 1e-12
        worst = max(worst, (np.abs(found - truth) / tolerance).max())
    return worst


def environment_by_emitter_sampling(data, defect):
    """Integrals of radiance times 1, (1 + x) / 2, (1 + y) / 2, (1 + z) / 2 by Mitsuba's own emitter samples, against
    a quadrature of 2 x 2 points a texel. Tolerance: five standard errors, and 1e-5 for the quadrature."""
    worst, count = 0.0, 1 << 22
    for light, up, base in list(environments(data))[::2]:
        image = ms.radiance(light, base)
        emitter = mi.load_dict({"type": "scene", "sky": ms.environment(light, up, base)}).emitters()[0]
        rng = np.random.default_rng(3)
        sample, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, count), mi.Point2f(rng.random((2, count), np.float32)))
        d, weight = np.array(sample.d).T.astype(np.float64), np.array(weight).T.astype(np.float64)
        lobes = lambda d: np.stack([np.ones(len(d)), *(0.5 + 0.5 * d.T)], -1)[:, :, None]
        terms = lobes(d) * weight[:, None, :]
        found, error = terms.mean(0), terms.std(0) / np.sqrt(count)
        height, width = image.shape[0] * 2, image.shape[1] * 2
        edges = np.cos(np.arange(height + 1) / height * np.pi)
        truth = 0.0
        for row in range(height):
            azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi + np.radians(light["rotation"])
            polar = (row + 0.5) / height * np.pi
            here = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.full(width, np.cos(polar))], -1)
            if up == "y":
                here = np.stack([here[:, 0], here[:, 2], -here[:, 1]], -1)
            value = sky(image, here, np.radians(light["rotation"]), up)
            truth = truth + (lobes(here) * value[:, None, :]).sum(0) * (edges[row] - edges[row + 1]) * 2 * np.pi / width
        if defect:
            truth = truth * 1.002
        worst = max(worst, (np.abs(found - truth) / (5 * error + 1e-5 * truth)).max())
    return worst


def scene_of(light, albedo, sigma_t=4.0, g=0.0, width=40, height=50, camera=CAMERA):
    lights = light if isinstance(light, list) else [light]
    return {"world": {"up": "z"}, "camera": camera, "image": {"width": width, "height": height},
            "medium": {"sigma_t": sigma_t, "albedo": albedo, "g": g}, "light": lights}


def noise_box(seed=5):
    density = np.zeros((9, 11, 13), np.float32)
    density[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).random((7, 9, 11), np.float32)
    return {"density": density, "axes": AXES, "corner": CORNER}


def sky_through_the_program(options, defect):
    """Pixel middles of a camera that looks past the smoke into a visible sky: the program's image against Mitsuba's
    camera and environment. Tolerance as for directions, and the camera's own 16 roundings."""
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        def program(*arguments):
            run = subprocess.run([str(options.program), *map(str, arguments)], capture_output=True, text=True)
            if run.returncode != 0:
                sys.exit(run.stderr.strip())

        volume = ms.ROOT / "testdata" / "plume" / "plume.0001.vdb"
        program("bake", volume, "--frames", 1, "-o", folder / "a.smoke", "--gaussians", 20, "--max-error", 0.1, "--progress", "none")
        for light, up, base in environments(options.data):
            camera = {"position": [900.0, 0.0, 0.0], "target": [905.0, 2.0, 1.0], "up": [0.1, 0.0, 1.0], "fov": 70.0}
            image = f'[world]\nup = "{up}"\n[camera]\n' + "".join(f"{k} = {v}\n" for k, v in camera.items())
            image += "[image]\nwidth = 61\nheight = 47\n[medium]\nsigma_t = 1\n[[light]]\nkind = 'environment'\nvisible = true\n"
            image += f"image = '{(pathlib.Path(base) / light['image']).resolve()}'\nrotation = {light['rotation']}\nintensity = 1.5\n"
            (folder / "scene.toml").write_text(image)
            program("render", folder / "a.smoke", "--scene", folder / "scene.toml", "-o", folder / "a.exr", "--float", "--progress", "none")
            bitmap = mi.Bitmap(str(folder / "a.exr"))
            names = [field.name for field in bitmap.struct_()]
            values = np.array(bitmap)
            ours = np.stack([values[..., names.index(c)] for c in "RGB"], -1).reshape(-1, 3)
            scene = scene_of({**light, "kind": "environment", "visible": True}, [0.0] * 3, width=61, height=47, camera=camera)
            scene["world"]["up"] = up
            built = ms.build(scene, noise_box(), base, "all", options.peers)
            x, y = np.meshgrid(np.arange(61) + (0.0 if defect else 0.5), np.arange(47) + 0.5)
            at = mi.Point2f((x / 61).ravel().astype(np.float32), (y / 47).ravel().astype(np.float32))
            rays = built.sensors()[0].sample_ray(0.0, 0.5, at, mi.Point2f(0.5))[0]
            si = dr.zeros(mi.SurfaceInteraction3f, len(ours))
            si.wi = -rays.d
            found = np.array(built.environment().eval(si)).T
            d, image = np.array(rays.d).T.astype(np.float64), ms.radiance(light, base)
            _, spread = sky(image, d, np.radians(light["rotation"]), up, spread=True)
            sin_theta = np.sqrt(np.maximum(1 - z_up(d, up)[:, 2] ** 2, 1e-12))
            texels = (12 + 16) * ULP / sin_theta * image.shape[0] / np.pi
            tolerance = spread * texels[:, None] + 16 * ULP * (ours + spread) + 1e-12
            worst = max(worst, (np.abs(found - ours) / tolerance).max())
    return worst


def camera_rays(options, defect):
    """`Camera::direction` of runtime/src/camera.rs at pixel middles. Tolerance: 16 roundings of a unit vector."""
    scene = scene_of({"kind": "environment", "color": [1, 1, 1]}, [0.0] * 3)
    built = ms.build(scene, noise_box(), ".", "all", options.peers)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(40) + 0.5, np.arange(50) + 0.5))
    at = mi.Point2f((x / 40).astype(np.float32), (y / 50).astype(np.float32))
    rays = built.sensors()[0].sample_ray(0.0, 0.5, at, mi.Point2f(0.5))[0]
    position, target, up = (np.array(CAMERA[k]) for k in ("position", "target", "up"))
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    pixel = 2 * np.tan(np.radians(CAMERA["fov"]) / 2) / (50 if defect else 40)
    truth = forward + right * ((x - 20) * pixel)[:, None] - np.cross(right, forward) * ((y - 25) * pixel)[:, None]
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    return np.abs(np.array(rays.d).T - truth).max() / (16 * ULP)


def pixels_are_boxes(options, defect):
    """Mean over each pixel of a visible sky, no smoke: Mitsuba's image against 24 x 24 rays a pixel through our
    formulas. Tolerance: six standard errors of both (the rays' as if random, which overstates it)."""
    light = {"kind": "environment", "image": "env/studio.exr", "visible": True}
    camera = {**CAMERA, "position": [50.0, 0.0, 0.0], "target": [55.0, 2.0, 1.0]}
    built = ms.build(scene_of(light, [0.0] * 3, width=12, height=10, camera=camera), noise_box(), options.data, "all", options.peers)
    passes = ms.Passes(built, 256)
    passes.run(64)
    fine = (np.arange(24) + 0.5) / 24 + (0.25 if defect else 0)
    x, y = ((np.arange(n)[:, None] + fine).ravel() / n for n in (12, 10))
    x, y = (a.ravel().astype(np.float32) for a in np.meshgrid(x, y))
    rays = built.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]
    value = sky(ms.radiance(light, options.data), np.array(rays.d).T, 0.0, "z")
    value = value.reshape(10, 24, 12, 24, 3).transpose(0, 2, 4, 1, 3).reshape(10, 12, 3, -1)
    error = np.hypot(passes.standard_error(), value.std(-1) / 24)
    return (np.abs(passes.mean - value.mean(-1)) / (6 * error)).max()


def density_and_albedo(options, defect):
    """sigma_t and sigma_s at random points in and around a sheared box, against `DensityField::sample`. Tolerance: a
    coordinate in voxels is rounded some 8 times at a size of 13, on a density that moves by 1 a voxel along each axis."""
    frame, albedo = noise_box(), [0.95, 0.8, 0.6]
    scene = ms.build(scene_of({"kind": "environment", "color": [1, 1, 1]}, albedo), frame, ".", "all", options.peers)
    shape = np.array(frame["density"].shape)
    node = np.random.default_rng(6).uniform(-1, shape, size=(200_000, 3))
    world = (node @ AXES.T + CORNER).astype(np.float32)
    mei = dr.zeros(mi.MediumInteraction3f, len(world))
    mei.p = mi.Point3f(np.ascontiguousarray(world.T))
    sigma_s, _, sigma_t = scene.shapes()[0].interior_medium().get_scattering_coefficients(mei)
    node = np.linalg.solve(AXES, (world.astype(np.float64) - CORNER).T).T + (0.5 if defect else 0)
    inside = ((node >= 0) & (node <= shape - 1)).all(1)
    base = np.clip(np.floor(node).astype(int), 0, shape - 2)
    f, truth = node - base, 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f), axis=1)
        truth = truth + weight * frame["density"][tuple((base + corner).T)]
    truth = np.where(inside, truth, 0.0) * 4.0
    tolerance = 4.0 * 3 * 8 * 13 * ULP
    error = np.abs(np.array(sigma_t)[0] - truth).max() / tolerance
    return max(error, np.abs(np.array(sigma_s).T - truth[:, None] * albedo).max() / tolerance)


def phase_function(options, defect):
    """Henyey-Greenstein of the cosine between the ray's direction and the one it goes on in: forward is positive.
    Tolerance: the peak's denominator (1 - g)^2 of the rounded cosine, 32 roundings."""
    worst = 0.0
    for g in (0.85, -0.4):
        scene = ms.build(scene_of({"kind": "environment", "color": [1, 1, 1]}, [1.0] * 3, g=g), noise_box(), ".", "all", options.peers)
        phase = scene.shapes()[0].interior_medium().phase_function()
        d, wo = directions(100_000, 7), directions(100_000, 8)
        mei = dr.zeros(mi.MediumInteraction3f, len(d))
        mei.wi = -mi.Vector3f(np.ascontiguousarray(d.T))
        mei.sh_frame = mi.Frame3f(mei.wi)
        value, pdf = phase.eval_pdf(mi.PhaseFunctionContext(mi.load_dict({"type": "independent"})), mei, mi.Vector3f(np.ascontiguousarray(wo.T)))
        cosine = (d.astype(np.float64) * wo).sum(1) * (-1 if defect else 1)
        denominator = 1 + g * g - 2 * g * cosine
        truth = (1 - g * g) / (4 * np.pi * denominator**1.5)
        tolerance = truth * 32 * ULP / denominator
        worst = max(worst, *((np.abs(np.array(v).reshape(-1, len(d))[0] - truth) / tolerance).max() for v in (value, pdf)))
    return worst


def lights(options, defect):
    """A directional light travels along `direction`, whatever its length, with the irradiance given; a point sends
    intensity / distance^2. Tolerance: 8 roundings."""
    sun = {"kind": "directional", "direction": [0.9, 0.35, -0.5], "irradiance": [14.0, 12.5, 10.5]}
    point = {"kind": "point", "position": [2.0, -1.0, 0.5], "intensity": [3.0, 2.0, 1.0]}
    scene = ms.build(scene_of([sun, point], [1.0] * 3), noise_box(), ".", "all", options.peers)
    it = dr.zeros(mi.Interaction3f, 1)
    it.p = mi.Point3f(0.5, 0.25, 1.5)
    worst = 0.0
    for emitter in scene.emitters():
        sample, weight = emitter.sample_direction(it, mi.Point2f(0.3, 0.6))
        if "irectional" in str(emitter).split("[")[0]:
            toward, truth = -np.array(sun["direction"]), np.array(sun["irradiance"])
            toward = -toward if defect else toward
        else:
            toward = np.array(point["position"]) - [0.5, 0.25, 1.5]
            truth = np.array(point["intensity"]) / (toward @ toward)
        worst = max(worst, np.abs(np.array(sample.d).ravel() - toward / np.linalg.norm(toward)).max() / (8 * ULP))
        worst = max(worst, np.abs(np.array(weight).ravel() / truth - 1).max() / (8 * ULP))
    return worst


def black_smoke_and_hidden_sky(options, defect):
    """Albedo 0: exactly nothing where the sky is hidden; where it is visible, the transmittance of each pixel's rays by
    8 x 8 rays of 200 steps. Tolerance: zero, and five standard errors (SE 2e-4) of the image's mean."""
    frame, sky_light = noise_box(), {"kind": "environment", "color": [1.0, 1.0, 1.0]}
    camera = {**CAMERA, "target": list(CORNER + AXES @ [4, 5, 6]), "fov": 14.0}
    scene = lambda visible: scene_of({**sky_light, "visible": visible}, [0.0] * 3, width=16, height=16, camera=camera)
    hidden = ms.Passes(ms.build(scene(False), frame, ".", "all", options.peers), 16).image(1)
    if np.abs(hidden).max() != 0:
        return np.inf
    built = ms.build(scene(True), frame, ".", "all", options.peers)
    passes = ms.Passes(built, 1024)
    passes.run(16)
    x, y = (a.ravel().astype(np.float32) for a in np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(128) + 0.5) / 128))
    rays = built.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]
    origin, d = np.array(CAMERA["position"]), np.array(rays.d).T.astype(np.float64)
    centre = np.linalg.norm(CORNER + AXES @ [4, 5, 6] - origin)
    medium, depth, step = built.shapes()[0].interior_medium(), 0.0, 2.4 / 200
    for t in centre - 1.2 + (np.arange(200) + 0.5) * step:
        mei = dr.zeros(mi.MediumInteraction3f, len(d))
        mei.p = mi.Point3f(np.ascontiguousarray((origin + d * t).T.astype(np.float32)))
        # The clamped border counts for nothing: the density is zero there.
        depth = depth + np.array(medium.get_scattering_coefficients(mei)[2])[0] * step
    truth = np.exp(-depth).mean() * (1.01 if defect else 1)
    error = np.sqrt((passes.standard_error() ** 2).sum(axis=(0, 1))) / 256
    return (np.abs(passes.mean.mean(axis=(0, 1)) - truth) / (5 * error)).max()


def white_furnace(options, defect):
    """Albedo 1, g = 0.5 under a visible sky of 1: every pixel is 1. Tolerance: five standard errors of the mean."""
    scene = scene_of({"kind": "environment", "color": [1.0] * 3, "visible": True}, [0.99 if defect else 1.0] * 3, 6.0, 0.5, 24, 24,
                     {**CAMERA, "target": list(CORNER + AXES @ [4, 5, 6]), "fov": 12.0})
    passes = ms.Passes(ms.build(scene, noise_box(), ".", "all", options.peers), 256)
    passes.run(16)
    error = np.sqrt((passes.standard_error() ** 2).sum(axis=(0, 1))) / 576
    return (np.abs(passes.mean.mean(axis=(0, 1)) - 1) / (5 * error)).max()


CHECKS = {
    "environment: radiance by direction": lambda o, d: environment_by_direction(o.data, d),
    "environment: integrals by emitter samples": lambda o, d: environment_by_emitter_sampling(o.data, d),
    "environment and camera: through the program": sky_through_the_program,
    "camera: rays of pixel middles": camera_rays,
    "film: means over pixels": pixels_are_boxes,
    "medium: density, its place, RGB albedo": density_and_albedo,
    "phase function: sign and value of g": phase_function,
    "lights: directional and point": lights,
    "integrator: black smoke, hidden sky": black_smoke_and_hidden_sky,
    "integrator: white furnace": white_furnace,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = os.environ.get("SMOKE_BAKE_DATA", ms.ROOT / ".." / "shared" / "data")
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path(data))
    parser.add_argument("--peers", type=pathlib.Path, help="folder of mitsuba_reference.py [default: beside the data]")
    parser.add_argument("--program", type=pathlib.Path, default=ms.ROOT / "target" / "release" / "smoke-bake")
    options = parser.parse_args()
    options.peers = options.peers or ms.peers_folder(options.data)
    good = True
    for name, check in CHECKS.items():
        right, planted = check(options, False), check(options, True)
        passed = right <= 1 < planted
        good &= passed
        print(f"{'ok  ' if passed else 'OFF '} {name}: {right:.2f} of the tolerance; with a planted defect {planted:.3g}", flush=True)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
