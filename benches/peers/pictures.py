"""Pictures of an image beside its reference, for the pages."""
import mitsuba as mi
import numpy as np

FULL_SCALE = 0.2


def tone(image, exposure):
    """Linear radiance as sRGB bytes."""
    value = np.clip(image * exposure, 0, 1)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return (255 * curve + 0.5).astype(np.uint8)


def signed(difference, scale):
    """Red where too bright, blue where too dark, white for none; full at `scale`."""
    t = np.clip(difference.mean(-1, keepdims=True) / scale, -1, 1)
    return (255 * (1 - np.abs(t) * np.where(t > 0, [0.0, 1.0, 1.0], [1.0, 1.0, 0.0])) + 0.5).astype(np.uint8)


def panels(path, image, truth):
    """Fast image, reference and their signed difference side by side, halved."""
    halved = [v[: len(v) // 2 * 2, : v.shape[1] // 2 * 2].reshape(len(v) // 2, 2, v.shape[1] // 2, 2, 3).mean(axis=(1, 3)) for v in (image, truth)]
    exposure = 0.8 / np.quantile(halved[1], 0.998)
    seen = halved[1][halved[1].sum(-1) > 0]
    false_colour = signed(halved[0] - halved[1], FULL_SCALE * seen.mean())
    mi.Bitmap(np.ascontiguousarray(np.concatenate([tone(halved[0], exposure), tone(halved[1], exposure), false_colour], axis=1))).write(str(path))
