#!/usr/bin/python3
"""What OpenVDB's own library (pyopenvdb) says about grids, as raw bytes for a test to compare with.

    openvdb_expectation.py FILE GRID OUT [FILE GRID OUT ...]

OUT is little-endian: i32 origin[3], u32 dims[3], u64 active voxels, f64 world[6][3] (index points POINTS mapped to
world), then dims[0] * dims[1] * dims[2] values as f32 and as many active states as u8, x fastest.
The box holds the active voxels and, if the background is zero, every inactive voxel of another value.
Needs python3-openvdb and python3-numpy.
"""
import sys
import numpy as np
import pyopenvdb as vdb

POINTS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (12.25, -7.5, 1000), (-123456, 98765, 3)]


def box_of(grid):
    low, high = np.full(3, 2 ** 31 - 1, np.int64), np.full(3, -2 ** 31, np.int64)
    if grid.activeVoxelCount():
        low, high = (np.array(c, np.int64) for c in grid.evalActiveVoxelBoundingBox())
    if grid.background == 0:
        for item in grid.iterOffValues():
            if item.value != 0:
                low, high = np.minimum(low, item.min), np.maximum(high, item.max)
    dims = np.maximum(high - low + 1, 0)
    return (low, dims) if dims.all() else (np.zeros(3, np.int64), np.zeros(3, np.int64))


def dense(grid, low, dims):
    box = np.zeros(dims, np.float32)
    if box.size:
        grid.copyToArray(box, ijk=tuple(int(v) for v in low))
    return box.transpose(2, 1, 0)


def states(grid, low, dims):
    marks = grid.deepCopy()
    marks.background = 0.0
    marks.mapOn(lambda _: 1.0)
    marks.mapOff(lambda _: 0.0)
    return dense(marks, low, dims)


def expectation(path, name):
    grid = vdb.read(path, name)
    low, dims = box_of(grid)
    world = [grid.transform.indexToWorld(p) for p in POINTS]
    head = [low.astype("<i4"), dims.astype("<u4"), np.array(grid.activeVoxelCount(), "<u8"), np.array(world, "<f8")]
    body = [dense(grid, low, dims).astype("<f4"), states(grid, low, dims).astype("u1")]
    return b"".join(part.tobytes() for part in head + body)


if __name__ == "__main__":
    arguments = sys.argv[1:]
    for path, name, out in zip(arguments[::3], arguments[1::3], arguments[2::3], strict=True):
        with open(out, "wb") as file:
            file.write(expectation(path, name))
