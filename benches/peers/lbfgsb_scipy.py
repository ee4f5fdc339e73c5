#!/usr/bin/env python3
"""Our L-BFGS-B against SciPy's, from the same start with the same number of evaluations.

    lbfgsb_scipy.py FIT_TRACE VOLUME.npz [VOLUME.npz ...]

FIT_TRACE is the program of bake/examples/fit_trace.rs (cargo build --release -p smoke-baking --example fit_trace);
a volume is an npz with density[x, y, z], whose border of zeros is taken off. SciPy minimises the same objective
(same kernels, same support, float64 tables and sums on a float32 field), compiled with numba; needs numpy, scipy, numba.
Ends with status 1 if ours is worse anywhere by more than one part in a thousand.
"""
import json, subprocess, sys, tempfile
from pathlib import Path
import numpy as np
from numba import njit, prange
from scipy.optimize import minimize

GAUSSIANS, RADII = 600, 3.0

@njit(parallel=True, fastmath=False)
def evaluate(x, density, h, energy):
    n = x.size // 5
    nx, ny, nz = density.shape
    dims = np.array([nx, ny, nz])
    lo, hi = np.zeros((n, 3), np.int64), np.zeros((n, 3), np.int64)
    side = dims.max()
    u, b = np.zeros((n, 3, side)), np.zeros((n, 3, side))
    for g in prange(n):
        r = x[5 * g + 3]
        for a in range(3):
            c = x[5 * g + a]
            lo[g, a] = min(max(int(np.floor((c - RADII * r) / h - 0.5)), 0), dims[a])
            hi[g, a] = min(max(int(np.ceil((c + RADII * r) / h + 0.5)), 0), dims[a])
            for i in range(lo[g, a], hi[g, a]):
                t = ((i + 0.5) * h - c) / r
                u[g, a, i] = t
                b[g, a, i] = np.exp(-t * t) if t * t < RADII * RADII else 0.0
    error = -density
    for k in prange(nz):
        for g in range(n):
            if lo[g, 2] <= k < hi[g, 2]:
                for j in range(lo[g, 1], hi[g, 1]):
                    if u[g, 1, j] ** 2 + u[g, 2, k] ** 2 < RADII * RADII:
                        s = x[5 * g + 4] * b[g, 2, k] * b[g, 1, j]
                        for i in range(lo[g, 0], hi[g, 0]):
                            error[i, j, k] += s * b[g, 0, i]
    cost = 0.0
    sums = np.zeros(nz)
    for k in prange(nz):
        for j in range(ny):
            for i in range(nx):
                e = np.float64(error[i, j, k])
                sums[k] += e * e
    cost = sums.sum() / energy
    gradient = np.zeros_like(x)
    for g in prange(n):
        m0 = m1 = m2 = m3 = m4 = 0.0
        for k in range(lo[g, 2], hi[g, 2]):
            for j in range(lo[g, 1], hi[g, 1]):
                uy, uz = u[g, 1, j], u[g, 2, k]
                if uy * uy + uz * uz < RADII * RADII:
                    a0 = a1 = a2 = 0.0
                    for i in range(lo[g, 0], hi[g, 0]):
                        eb = error[i, j, k] * b[g, 0, i]
                        a0 += eb
                        a1 += eb * u[g, 0, i]
                        a2 += eb * u[g, 0, i] ** 2
                    s = b[g, 1, j] * b[g, 2, k]
                    m0 += s * a0
                    m1 += s * a1
                    m2 += s * a0 * uy
                    m3 += s * a0 * uz
                    m4 += s * (a2 + a0 * (uy * uy + uz * uz))
        f = 4 * x[5 * g + 4] / x[5 * g + 3] / energy
        gradient[5 * g], gradient[5 * g + 1], gradient[5 * g + 2] = f * m1, f * m2, f * m3
        gradient[5 * g + 3], gradient[5 * g + 4] = f * m4, 2 * m0 / energy
    return cost, gradient

def rosenbrock(x):
    a, b = 1 - x[:-1], x[1:] - x[:-1] ** 2
    g = np.zeros_like(x)
    g[:-1] = -2 * a - 400 * x[:-1] * b
    g[1:] += 200 * b
    return (a * a + 100 * b * b).sum(), g

def paired_rosenbrock(x):
    p, q = x[::2], x[1::2]
    a, b = 1 - p, q - p * p
    g = np.zeros_like(x)
    g[::2], g[1::2] = -2 * a - 400 * p * b, 200 * b
    return (a * a + 100 * b * b).sum(), g

def scipy_best(f, start, bounds, evaluations, memory):
    """Best cost within so many evaluations, and the evaluations used."""
    costs = []
    def counted(x):
        cost, g = f(x)
        costs.append(cost)
        return cost, g
    options = dict(maxcor=memory, maxfun=evaluations, maxiter=10 ** 6, ftol=2.2e-9, gtol=1e-9 if memory == 20 else 1e-5)
    if memory == 20:
        options["ftol"] = 0.0
    minimize(counted, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    costs = costs[:evaluations]
    return min(costs), len(costs)

def ours(arguments):
    trace = json.loads(subprocess.run([str(a) for a in arguments], check=True, capture_output=True, text=True).stdout)
    return trace[-1][1], trace[-1][0], trace

def main():
    program, volumes = sys.argv[1], sys.argv[2:]
    worse = 0
    print("| problem | evaluations allowed | ours | SciPy | ours reaches SciPy's end after |\n|---|---|---|---|---|")
    def row(name, evaluations, mine, theirs, floor=0.0):
        nonlocal worse
        worse += not mine[0] <= max(theirs[0] * 1.001, floor)
        level = next((n for n, cost in mine[2] if cost <= theirs[0] * 1.000001), "-")
        print(f"| {name} | {evaluations} | {mine[0]:.6g} after {mine[1]} | {theirs[0]:.6g} after {theirs[1]} | {level} |", flush=True)
    start = lambda n: np.where(np.arange(n) % 2 == 0, -1.2, 1.0)
    for name, n, f, x, bounds in [
        ("rosenbrock", 2, rosenbrock, start(2), None),
        ("rosenbrock", 25, rosenbrock, start(25), None),
        ("bounded_rosenbrock", 25, rosenbrock, np.full(25, 3.0), [(1.5 if i % 2 == 0 else -100, 100) for i in range(25)]),
        ("paired_rosenbrock", 1000, paired_rosenbrock, start(1000), None),
    ]:
        # Below 1e-9 both have converged by their own tests.
        row(f"{name}, n = {n}", 400, ours([program, name, n, 400]), scipy_best(f, x, bounds, 400, 10), 1e-9)
    for path in volumes:
        density = np.load(path)["density"][1:-1, 1:-1, 1:-1]
        density = np.ascontiguousarray(density / density.max(), np.float32)
        h, energy = 1 / max(density.shape), float((density.astype(float) ** 2).sum())
        with tempfile.TemporaryDirectory() as folder:
            raw, first = Path(folder) / "volume", Path(folder) / "start"
            raw.write_bytes(np.array(density.shape, "<u4").tobytes() + density.transpose(2, 1, 0).astype("<f4").tobytes())
            for evaluations in (200, 400):
                mine = ours([program, raw, GAUSSIANS, evaluations, first])
                x = np.fromfile(first, "<f8")
                f = lambda x: evaluate(x, density, h, energy)
                bounds = [(None, None)] * 3 + [(0.015, 0.09), (0.01, 1.0)]
                theirs = scipy_best(f, x, bounds * (x.size // 5), evaluations, 20)
                row(f"{Path(path).stem}, {x.size // 5} Gaussians", evaluations, mine, theirs)
    sys.exit(worse > 0)

if __name__ == "__main__":
    main()
