"""A project scene in Mitsuba 3, with the same meaning to float rounding.

The scene is built by `mitsuba_reference.py` of the shared peers' folder (found by `peers_folder`), with one part
replaced: the environment. What was found when each part was held against our own definition
(`check_mitsuba_scene.py` repeats it):

| part | found | done |
|---|---|---|
| environment, rows | Mitsuba puts row j at v = j / (H - 1), the first row on the pole; ours has texel middles at v = (j + 0.5) / H. Off by half a texel at the poles: up to 3 x the radiance of the sunset in one direction, 1000 x at a lamp of the courtyard; 0.05 to 0.2 % of the mean | 2 H + 1 rows: all our texel middles and the points half-way between, so that linear interpolation is ours |
| environment, columns | texel middles at (i + 0.5) / W in both, round the horizon in both | nothing |
| environment, rotation, up axis | the shared script resamples to the nearest texel | `to_world` turns the map, exactly |
| environment, samples below zero | Mitsuba keeps them (5 texels of the sunset) | zero, as in ours |
| environment, one colour | resampled to 8 x 16 | emitter `constant` |
| camera: pixel middles, box filter, fov across | same | nothing |
| density: voxel middles, scale, border | same, trilinear | nothing |
| density under a mirroring map | the box's faces look inwards, so that Mitsuba never enters the medium | the first axis is turned round, map and array |
| albedo | RGB as given: no spectral upsampling in rgb variants | nothing |
| phase function: sign of g | same | nothing |
| directional light: direction, irradiance | same | nothing |
| `hide_emitters` | hides the sky through the medium's box too: a black medium gives exact zeros | refused where only some lights are visible |
| point light | same, but a shadow ray ends at 1 - 9e-4 of its way: in smoke of extinction s, a light at distance d inside it is too bright by 9e-4 s d | keep point lights outside the smoke here |

`llvm_ad_rgb` needs a libLLVM of 16 or newer: Debian's libllvm19, and
DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1.
"""
import importlib.util
import pathlib
import time

import mitsuba as mi
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Columns: where Mitsuba's x, y, z axes of an environment lie in a world whose z is up, so that its u is ours.
ENVIRONMENT_AXES = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
WORLD_FROM_Z_UP = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}


def peers_folder(data):
    """The shared peers' folder beside the data."""
    return pathlib.Path(data) / ".." / "peers"


def radiance(light, base):
    """Radiance of an environment's image, rows x columns x RGB, as the program reads it."""
    image = mi.Bitmap(str(pathlib.Path(base) / light["image"]))
    image = np.array(image.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False))
    return np.maximum(image, np.float32(0)) * np.float32(light.get("intensity", 1.0))


def with_half_way_rows(image):
    """2 H + 1 rows at v = i / 2 H: the odd ones are the image's, the even ones half-way between, or the end rows."""
    rows = np.empty((2 * len(image) + 1, *image.shape[1:]), np.float32)
    rows[1::2] = image
    rows[0], rows[-1] = image[0], image[-1]
    rows[2:-1:2] = 0.5 * (image[1:] + image[:-1])
    return rows


def environment(light, up, base):
    """An environment light for Mitsuba."""
    if "image" not in light:
        colour = [float(c) * light.get("intensity", 1.0) for c in light["color"]]
        return {"type": "constant", "radiance": {"type": "rgb", "value": colour}}
    turn = np.radians(light.get("rotation", 0.0))
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    to_world = np.eye(4)
    to_world[:3, :3] = WORLD_FROM_Z_UP[up] @ about_z @ ENVIRONMENT_AXES
    bitmap = mi.Bitmap(with_half_way_rows(radiance(light, base)))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(to_world.tolist())}


def unmirrored(frame):
    """The same density with a map of positive determinant."""
    density, axes, corner = frame["density"], frame["axes"].copy(), frame["corner"]
    if np.linalg.det(axes) < 0:
        corner = corner + axes[:, 0] * (len(density) - 1)
        density, axes[:, 0] = density[::-1], -axes[:, 0]
    return {"density": density, "axes": axes, "corner": corner}


def build(scene, frame, base, order, peers):
    """The scene (a parsed scene.toml, its folder `base`), the density `frame` (see grid_to_npz.py) in Mitsuba."""
    skies = [light for light in scene.get("light", []) if light["kind"] == "environment"]
    if len(skies) > 1:
        raise SystemExit(f"found {len(skies)} environments, expected at most one: Mitsuba holds no more")
    specification = importlib.util.spec_from_file_location("mitsuba_reference", pathlib.Path(peers) / "mitsuba_reference.py")
    shared = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(shared)
    shared.environment = environment
    return shared.build(scene, unmirrored(frame), base, order)


class Passes:
    """Independent renders of one scene, and what they say together. A pass is `spp` samples a pixel, its seed its number."""

    def __init__(self, scene, spp, integrator=None):
        self.scene, self.spp, self.integrator = scene, spp, integrator
        self.count, self.seconds = 0, []
        self.mean = self.squares = 0.0

    def warm_up(self, seed=2**31):
        """Compiles the kernel; the image is thrown away."""
        self.image(seed)

    def image(self, seed):
        return np.array(mi.render(self.scene, spp=self.spp, seed=seed, integrator=self.integrator), dtype=np.float64)

    def run(self, passes):
        """Further passes (Welford's update of mean and squares); gives their seconds together."""
        start = time.perf_counter()
        for _ in range(passes):
            image = self.image(self.count)
            self.count += 1
            step = image - self.mean
            self.mean = self.mean + step / self.count
            self.squares = self.squares + step * (image - self.mean)
        self.seconds.append(time.perf_counter() - start)
        return self.seconds[-1]

    def variance_of_a_pass(self):
        return self.squares / (self.count - 1)

    def standard_error(self):
        return np.sqrt(self.variance_of_a_pass() / self.count)

    def relative_error(self, passes):
        """Relative standard error that this many passes have: sqrt(mean se^2) / sqrt(mean mean^2)."""
        return float(np.sqrt(self.variance_of_a_pass().mean() / passes / (self.mean**2).mean()))
