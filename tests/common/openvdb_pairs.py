#!/usr/bin/python3
"""For each pair of files on the command line, what OpenVDB's library sees in their grid `density`: the largest
difference of any voxel, whether the second's active voxels are those of the first that are active or not zero, and
whether points of index space lie at the same place in the world. Needs python3-openvdb and python3-numpy.
"""
import sys
import numpy as np
import pyopenvdb as vdb

POINTS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (100, -7, 31), (-4096, 5, 4096)]


def box(grid):
    return np.array(grid.evalActiveVoxelBoundingBox())


def dense(grid, low, high):
    values = np.zeros(high - low + 1, dtype=np.float32)
    grid.copyToArray(values, ijk=tuple(int(i) for i in low))
    return values


def active(grid, low, high):
    """The active voxels as an array, from a copy whose active values are all 1 and whose others are 0."""
    marks = vdb.FloatGrid(0.0)
    accessor = marks.getAccessor()
    for item in grid.citerOnValues():
        if item.count == 1:
            accessor.setValueOn(item.min, 1.0)
        else:
            marks.fill(item.min, item.max, 1.0, True)
    return dense(marks, low, high) != 0


for first, second in zip(sys.argv[1::2], sys.argv[2::2]):
    source, unpacked = vdb.read(first, "density"), vdb.read(second, "density")
    # A voxel that is not zero may lie outside the active box, but inside its leaf.
    low = np.minimum(box(source)[0], box(unpacked)[0]) - 8
    high = np.maximum(box(source)[1], box(unpacked)[1]) + 8
    a, b = dense(source, low, high), dense(unpacked, low, high)
    difference = np.abs(a.astype(np.float64) - b.astype(np.float64)).max()
    support = active(source, low, high) | (a != 0)
    world = lambda grid: np.array([grid.transform.indexToWorld(p) for p in POINTS])
    print(repr(float(difference)), np.array_equal(support, active(unpacked, low, high)),
          np.array_equal(world(source), world(unpacked)))
