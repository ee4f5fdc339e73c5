#!/usr/bin/env python3
"""Our L-BFGS-B against SciPy's, from the same start with the same number of evaluations.

    lbfgsb_scipy.py FIT_TRACE [VOLUME.vdb ...]

FIT_TRACE is the program of bake/examples/fit_trace.rs (cargo build --release -p smoke-baking --example fit_trace);
it reads the volumes. Test functions run to their end under the same tests of convergence. For the volumes SciPy
minimises the same objective (same kernels, same support, float64 tables and sums on a float32 field), compiled with
numba; needs numpy, scipy, numba.
Ends with status 1 if ours needs more evaluations or ends higher anywhere.
"""
import json, subprocess, sys, tempfile
from pathlib import Path
import numpy as np
from numba import njit, prange
from scipy.optimize import minimize

GAUSSIANS, RADII, FTOL, SEEDS = 600, 3.0, 1e7 * np.finfo(float).eps, 20

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

def powell(x):
    a, b, c, d = x[::4], x[1::4], x[2::4], x[3::4]
    p, q, r, s = a + 10 * b, c - d, b - 2 * c, a - d
    g = np.empty_like(x)
    g[::4], g[1::4] = 2 * p + 40 * s ** 3, 20 * p + 4 * r ** 3
    g[2::4], g[3::4] = 10 * q - 8 * r ** 3, -10 * q - 40 * s ** 3
    return (p * p + 5 * q * q + r ** 4 + 10 * s ** 4).sum(), g

def beale(x):
    c, k, (x, y) = np.array([1.5, 2.25, 2.625]), np.arange(1, 4), x
    t = c - x + x * y ** k
    return (t * t).sum(), 2 * np.array([(t * (y ** k - 1)).sum(), (t * x * k * y ** (k - 1)).sum()])

def quadratic(n, seed):
    """The problem that fit_trace calls quadratic:SEED."""
    state = seed
    def random():
        nonlocal state
        state = (state * 6364136223846793005 + 1442695040888963407) % 2 ** 64
        return (state >> 11) / 2 ** 53
    v = np.array([2 * random() - 1 for _ in range(n)])
    diagonal = (1 + 31 * np.arange(n) / (n - 1)) ** 2
    reflect = lambda x: x - 2 * (x @ v) / (v @ v) * v
    product = lambda x: reflect(reflect(x) * diagonal)
    def optimum():
        kind, place, multiplier = random(), random(), random()
        return (0, 10 * multiplier) if kind < 0.25 else (1, -10 * multiplier) if kind < 0.5 else (place, 0)
    best = np.array([optimum() for _ in range(n)], float)
    b = product(best[:, 0]) - best[:, 1]
    def f(x):
        h = product(x)
        return float(x @ (0.5 * h - b)), h - b
    return f, f(best[:, 0])[0]

def scipy_best(f, start, bounds, evaluations, **options):
    """Best cost within so many evaluations, and the evaluations used."""
    costs = []
    def counted(x):
        cost, g = f(x)
        costs.append(cost)
        return cost, g
    options = dict(maxfun=evaluations, maxiter=10 ** 6, **options)
    minimize(counted, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    costs = costs[:evaluations]
    return min(costs), len(costs)

def ours(arguments):
    """Pairs of evaluations and cost, one an iteration."""
    return json.loads(subprocess.run([str(a) for a in arguments], check=True, capture_output=True, text=True).stdout)

def within(trace, evaluations):
    """Best cost of a trace after at most so many evaluations."""
    return min(cost for n, cost in trace if n <= evaluations)

def main():
    program, volumes = sys.argv[1], sys.argv[2:]
    failed = 0
    every = lambda n, *period: np.array([period[i % len(period)] for i in range(n)], float)
    functions = [
        ("rosenbrock", 2, rosenbrock, [-1.2, 1], None),
        ("rosenbrock", 25, rosenbrock, [-1.2, 1], None),
        ("bounded_rosenbrock", 25, rosenbrock, [3], [(1.5, 100), (-100, 100)]),
        ("paired_rosenbrock", 1000, paired_rosenbrock, [-1.2, 1], None),
        ("powell", 40, powell, [3, -1, 0, 1], None),
        ("bounded_powell", 40, powell, [3, -1, .5, 1], [(.1, None), (None, None), (.2, None), (None, .9)]),
        ("beale", 2, beale, [1, 1], [(-4.5, 2.5), (-4.5, 4.5)]),
    ]
    def compare(name, n, f, start, bounds):
        """Both to their end, by SciPy's default tests; a cost counts as no worse within those tests' own resolution."""
        trace = ours([program, name, n, 15000])
        bounds = bounds and [bounds[i % len(bounds)] for i in range(n)]
        cost, used = scipy_best(f, every(n, *start), bounds, 15000, maxcor=10, ftol=FTOL, gtol=1e-5)
        return trace[-1], (used, cost), trace[-1][0] <= used and trace[-1][1] <= cost + FTOL * max(abs(cost), 1)
    print("| function | ours | SciPy | no more, no worse |\n|---|---|---|---|")
    for name, n, f, start, bounds in functions:
        mine, theirs, passed = compare(name, n, f, start, bounds)
        failed += not passed
        print(f"| {name}, n = {n} | {mine[1]:.6g} after {mine[0]} | {theirs[1]:.6g} after {theirs[0]} | {passed} |", flush=True)
    for n in (50, 200):
        results = []
        for seed in range(SEEDS):
            f, best = quadratic(n, seed)
            mine, theirs, passed = compare(f"quadratic:{seed}", n, f, [0.5], [(0, 1)])
            assert min(mine[1], theirs[1]) > best - 1e-9 * abs(best), "the problems differ"
            results.append((mine[0], theirs[0], passed, mine[0] - theirs[0]))
        mine, theirs, passed, difference = map(np.array, zip(*results))
        failed += not passed.all()
        print(f"| {SEEDS} quadratics, n = {n} | {mine.mean():.1f} | {theirs.mean():.1f} evaluations in the mean | "
              f"{passed.mean():.0%}, difference {difference.min()} to {difference.max()} |", flush=True)
    print("\n| fit | evaluations | ours | SciPy | ours reaches SciPy's end after |\n|---|---|---|---|---|")
    for path in volumes:
        with tempfile.TemporaryDirectory() as folder:
            for evaluations in (200, 400):
                trace = ours([program, path, GAUSSIANS, evaluations, folder])
                x = np.fromfile(Path(folder) / "start", "<f8")
                raw = (Path(folder) / "volume").read_bytes()
                dims = np.frombuffer(raw, "<u4", 3)
                density = np.ascontiguousarray(np.frombuffer(raw, "<f4", offset=12).reshape(dims[::-1]).transpose(2, 1, 0))
                energy = float((density.astype(float) ** 2).sum())
                f = lambda x: evaluate(x, density, 1 / max(dims), energy)
                bounds = [(None, None)] * 3 + [(0.015, 0.09), (0.01, 1.0)]
                cost, used = scipy_best(f, x, bounds * (x.size // 5), evaluations, maxcor=20, ftol=0, gtol=1e-9)
                mine = within(trace, used)
                failed += not mine <= cost
                level = next((n for n, mine in trace if mine <= cost), "-")
                print(f"| {Path(path).stem}, {x.size // 5} Gaussians | {used} | {mine:.6g} | {cost:.6g} | {level} |", flush=True)
    sys.exit(failed > 0)

if __name__ == "__main__":
    main()
