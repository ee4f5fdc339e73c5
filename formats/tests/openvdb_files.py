#!/usr/bin/python3
"""Small files of every shape that OpenVDB's own library (pyopenvdb) can write, into FOLDER.

    openvdb_files.py FOLDER [LABEL]

Prints one line a float grid: file name, tab, grid name. Needs python3-openvdb and python3-numpy.
"""
import sys
import numpy as np
import pyopenvdb as vdb


def float_grid(name="density", background=0.0, half=False, transform=None, kind=vdb.GridClass.FOG_VOLUME):
    grid = vdb.FloatGrid(background)
    grid.name, grid.gridClass, grid.saveFloatAsHalf = name, kind, half
    if transform is not None:
        grid.transform = transform
    return grid


def speckle(grid, seed, origin=(0, 0, 0), dims=(37, 21, 30), share=0.4):
    """Random voxels, some of them active; the inactive ones keep their value."""
    random = np.random.default_rng(seed)
    values = np.where(random.random(dims) < share, random.normal(size=dims), grid.background).astype(np.float32)
    grid.copyFromArray(values, ijk=origin)
    return grid


def inactive(grid, values, dims=(24, 16, 8)):
    """Whole leaves whose inactive voxels hold just the given values: the seven node codes of active-mask compression."""
    random = np.random.default_rng(5)
    accessor = grid.getAccessor()
    for ijk in np.ndindex(dims):
        if random.random() < 0.1:
            accessor.setValueOn(ijk, float(random.normal()))
        else:
            accessor.setValueOff(ijk, float(random.choice(values)))
    return grid


def affine(rows):
    return vdb.createLinearTransform(rows)


def cases():
    rotated = affine([[0.08, 0.06, 0, 0], [-0.06, 0.08, 0, 0], [0, 0, 0.1, 0], [12.5, -3.25, 1e4, 1]])
    scaled = affine([[0.1, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, -0.3, 0], [0, 0, 0, 1]])
    moved = affine([[0.1, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, 0.3, 0], [5, 6, 7, 1]])
    uniform_moved = affine([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [5, 6, 7, 1]])
    # OpenVDB itself makes no map whose determinant is near 1e-15.
    tiny = vdb.createLinearTransform(1e-4)

    yield "plain", [speckle(float_grid(), 1)]
    yield "half", [speckle(float_grid(half=True), 2)]
    yield "empty", [float_grid()]
    yield "empty_half_background", [float_grid(half=True, background=1.5)]
    for half in (False, True):
        one = float_grid(half=half)
        one.getAccessor().setValueOn((-1, 4096, 7), 0.75)
        yield f"one_voxel_half_{half}", [one]
    yield "negative", [speckle(float_grid(), 3, origin=(-4100, -9, -130))]
    far = float_grid(half=True)
    for ijk in [(-5000, 0, 0), (5000, 5, 3), (0, -2, 4)]:
        far.getAccessor().setValueOn(ijk, 0.5)
    yield "far_apart", [far]
    for background in (0.0, 0.25):
        for half in (False, True):
            tiles = speckle(float_grid(background=background, half=half), 4, origin=(3, 1, 2))
            tiles.fill((-64, -32, 0), (71, 47, 31), 0.625, True)
            tiles.fill((128, 128, 8), (271, 263, 23), 0.375, True)
            tiles.fill((160, 160, 8), (167, 183, 15), 0.125, False)
            yield f"tiles_{background}_half_{half}", [tiles]
    root = float_grid(background=0.5)
    root.fill((0, 0, 0), (4096 + 15, 127, 15), 2.0, True)
    yield "inner_tiles", [root]
    huge_inactive = float_grid(background=3.0)
    huge_inactive.fill((-4096, -4096, -4096), (4095, 4095, 4095), -3.0, False)
    huge_inactive.getAccessor().setValueOn((0, 0, 0), 1.0)
    yield "inactive_tiles_of_another_value", [huge_inactive]
    for background in (0.0, 1.5):
        for half in (False, True):
            for label, values in {
                "minus": [-background], "both": [-background, background], "one": [0.3], "one_or_background": [0.3, background],
                "two": [0.3, 0.7], "three": [0.3, 0.7, 0.9],
            }.items():
                grid = float_grid(background=background, half=half)
                yield f"inactive_{label}_{background}_half_{half}", [inactive(grid, values)]
    sphere = vdb.createLevelSetSphere(20.0, (1, 2, 3), 1.0, 3.0)
    sphere.name = "density"
    yield "level_set", [sphere]
    for label, transform in {"rotated": rotated, "scaled": scaled, "moved": moved, "uniform_moved": uniform_moved,
                             "tiny": tiny}.items():
        yield f"map_{label}", [speckle(float_grid(transform=transform), 7)]
    # No more than one level of sharing: the copy is written as an instance of the first.
    first = speckle(float_grid(), 8)
    shared = first.copy()
    shared.name, shared.transform = "shared", rotated
    yield "instance", [first, shared]
    flags, vectors = vdb.BoolGrid(), vdb.Vec3SGrid()
    flags.name, vectors.name = "flags", "velocity"
    flags.fill((0, 0, 0), (20, 20, 20), True)
    vectors.fill((0, 0, 0), (20, 20, 20), (1, 2, 3))
    yield "several", [flags, speckle(float_grid("heat"), 9), vectors, speckle(float_grid(half=True), 10)]
    yield "same_name", [speckle(float_grid(), 11), speckle(float_grid(), 12), speckle(float_grid("other"), 13)]


if __name__ == "__main__":
    folder, only = sys.argv[1], sys.argv[2:]
    for label, grids in cases():
        if only and label not in only:
            continue
        vdb.write(f"{folder}/{label}.vdb", grids=grids)
        for grid in grids:
            if isinstance(grid, vdb.FloatGrid):
                print(f"{label}.vdb\t{grid.name}")
