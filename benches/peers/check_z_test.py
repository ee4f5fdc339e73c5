#!/usr/bin/env python3
"""Shows on made-up images that `z_test.py` passes what is right and finds what is not. Needs numpy and scipy.

    python3 benches/peers/check_z_test.py
"""
import sys

import numpy as np

import z_test

PIXELS, PASSES, RUNS = (100, 80, 3), 64, 100


def images(rng, bias=0.0, confidence=1.0):
    """Two estimates of a smooth image from exponential samples (as skewed as a path tracer's passes of a few paths);
    the first with a relative `bias`, and with standard errors `confidence` times too small. A quarter is empty."""
    truth = np.linspace(0, 2, np.prod(PIXELS)).reshape(PIXELS)
    truth[:25] = 0
    out = []
    for factor, trust in ((1 + bias, confidence), (1.0, 1.0)):
        # The mean of `PASSES` passes of 8 exponential samples, and its standard error, pass by pass.
        samples = rng.standard_gamma(8, size=(PASSES, *PIXELS)) / 8 * truth * factor
        error = samples.std(0, ddof=1) / np.sqrt(PASSES)
        out.append(z_test.Estimate(samples.mean(0), error / trust, PASSES))
    return out


def misses(runs, **defect):
    rng = np.random.default_rng(11)
    return sum(not row["passes"] for _ in range(runs) for row in z_test.compare(*images(rng, **defect), np.ones(PIXELS[:2], bool)))


def main():
    right = misses(RUNS)
    # Of 300 channels 2.7 per mille miss by |z| > 3 and 1 per mille by the share: 1.1 expected, above 6 a chance of 1e-4.
    checks = {f"right images miss {right} of {3 * RUNS} times, at most 6": right <= 6}
    for name, defect in (("0.6 % too bright", {"bias": 0.006}), ("standard errors of one a quarter too small", {"confidence": 4 / 3})):
        found = misses(10, **defect)
        checks[f"{name}: found in {found} of 30 channels, all"] = found == 30
    for name, good in checks.items():
        print("ok  " if good else "OFF ", name)
    sys.exit(0 if all(checks.values()) else 1)


if __name__ == "__main__":
    main()
