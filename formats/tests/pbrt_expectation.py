#!/usr/bin/python3
"""What a pbrt medium's text says, read by regular expressions, in the layout of openvdb_expectation.py.

    pbrt_expectation.py FILE OUT

Needs python3-numpy.
"""
import re
import sys
import numpy as np

from openvdb_expectation import POINTS


def expectation(path):
    text = open(path).read()

    def numbers(key):
        return [float(v) for v in re.search(key + r'"\s*\[?\s*([-0-9.e+ ]+)', text).group(1).split()]

    dims = np.array([numbers(f"integer n{a}")[0] for a in "xyz"], "<u4")
    p0, p1 = np.array(numbers("point p0")), np.array(numbers("point p1"))
    at = text.index('"float density"')
    values = np.array(text[text.index("[", at) + 1:text.index("]", at)].split(), "<f4")
    world = p0 + (np.array(POINTS) + 0.5) * (p1 - p0) / dims
    head = [np.zeros(3, "<i4"), dims, np.array((values != 0).sum(), "<u8"), world.astype("<f8")]
    return b"".join(part.tobytes() for part in head + [values, (values != 0).astype("u1")])


if __name__ == "__main__":
    with open(sys.argv[2], "wb") as file:
        file.write(expectation(sys.argv[1]))
