"""Are two Monte Carlo images estimates of the same image? A z-test, channel by channel.

With means a, b and standard errors s, t from n and m independent passes, a pixel's

    T = (a - b) / sqrt(s^2 + t^2)

follows Student's t with `(s^2 + t^2)^2 / (s^4 / (n - 1) + t^4 / (m - 1))` degrees of freedom (Welch 1947, Satterthwaite
1946), and pixels are independent. Two things are asked: the difference of the images' means is within 3 of its standard
errors; and no more pixels have |T| > 2 than 99.9 % of all runs would show, if each had its own share of Student's tail.
The bound on the count is the binomial one at the mean share, which is never below that of unequal shares (Hoeffding
1956). Pixels that are zero in both images, without error, say nothing and are left out.

A standard error is no measure of a pixel that few samples ever light: most runs see none of them, and state zero with
no error. So a caller names the pixels whose error can be believed, by what is known of them without the images' noise
(`believed`); the others count in the mean, where they do no harm, and not in the share.
"""
from dataclasses import dataclass

import numpy as np
from scipy import stats

Z_OF_MEAN, BEYOND, CERTAINTY = 3.0, 2.0, 0.999
# Fewer and Student's tail is as much a matter of the pixels' own distribution.
LEAST_PASSES = 64


@dataclass
class Estimate:
    """Mean and standard error of the mean, rows x columns x channels, from `passes` independent passes."""

    mean: np.ndarray
    standard_error: np.ndarray
    passes: int


def compare(a, b, believed):
    """One row a channel: figures and whether they pass. `believed`, rows x columns: pixels that count in the share."""
    for image in (a, b):
        if image.passes < LEAST_PASSES:
            raise SystemExit(f"found {image.passes} passes, expected at least {LEAST_PASSES}: ask for a smaller error or more passes")
    variance_a, variance_b = np.square(a.standard_error), np.square(b.standard_error)
    rows = []
    for c, name in enumerate("RGB"):
        difference = (a.mean - b.mean)[..., c]
        va, vb = variance_a[..., c], variance_b[..., c]
        seen = (difference != 0) | (va + vb > 0)
        z = float(difference[seen].sum() / np.sqrt((va + vb)[seen].sum()))
        off = float(difference[seen].sum() / b.mean[..., c].sum())
        seen &= believed
        difference, va, vb = difference[seen], va[seen], vb[seen]
        variance = va + vb
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = variance**2 / (va**2 / (a.passes - 1) + vb**2 / (b.passes - 1))
            t = np.where(variance > 0, difference / np.sqrt(variance), np.inf * np.sign(difference))
        freedom = np.where(np.isfinite(freedom), freedom, min(a.passes, b.passes) - 1)
        share = float(np.mean(2 * stats.t.sf(BEYOND, freedom)))
        beyond = int((np.abs(t) > BEYOND).sum())
        bound = int(stats.binom.ppf(CERTAINTY, t.size, share))
        rows.append({
            "channel": name, "pixels": int(t.size), "z_of_mean": z,
            "difference_of_means": off,
            "beyond": beyond / t.size, "expected": share, "bound": bound / t.size,
            "largest": float(np.abs(t).max()),
            "passes": bool(abs(z) <= Z_OF_MEAN and beyond <= bound),
        })
    return rows
