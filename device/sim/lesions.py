"""Lesions of diabetic retinopathy: microaneurysms, haemorrhages and hard exudates."""

from dataclasses import dataclass

import numpy as np

from device.values import Image


@dataclass(frozen=True)
class Lesions:
    """Coverage by blood outside the vessels (`dark`) and by lipid (`bright`), 0 to 1, (rows, cols)."""

    dark: Image
    bright: Image


def scatter(
    x: Image,
    y: Image,
    rng: np.random.Generator,
    reach_deg: float,
    centre: tuple[float, float],
    haemorrhages: int,
    microaneurysms: int,
    exudates: int,
) -> Lesions:
    """Return lesions at random places of the field; `x` (1, cols) and `y` (rows, 1) are degrees from the fovea.

    The field has the radius `reach_deg` and its centre at `centre`, degrees from the fovea. Microaneurysms are dots 0.2
    to 0.3 degrees wide, haemorrhages blots of up to two degrees; exudates lie on a ring of about 1.3 degrees radius
    around one random place.
    """
    dark = np.zeros((y.size, x.size), np.float32)
    bright = np.zeros_like(dark)
    for _ in range(haemorrhages):
        _blot(dark, x, y, rng, _random_place(rng, reach_deg, centre, 2.5), rng.uniform(0.3, 0.85), 0.85, rough=0.17)
    for _ in range(microaneurysms):
        _blot(dark, x, y, rng, _random_place(rng, reach_deg, centre, 1.6), rng.uniform(0.09, 0.17), 0.75, rough=0.05)
    cluster = _random_place(rng, 0.35 * reach_deg, (0.0, 0.0), 2.5)
    for _ in range(exudates):
        turn = rng.uniform(0, 2 * np.pi)
        far = abs(rng.normal(1.3, 0.45))
        place = (cluster[0] + far * np.cos(turn), cluster[1] + far * np.sin(turn))
        _blot(bright, x, y, rng, place, rng.uniform(0.1, 0.32), rng.uniform(0.7, 1), rough=0.25)
    return Lesions(dark, bright)


def _random_place(
    rng: np.random.Generator, reach_deg: float, centre: tuple[float, float], from_fovea: float
) -> tuple[float, float]:
    """Return a random (x, y) in the field, off the optic disc and more than `from_fovea` degrees from the fovea."""
    for _ in range(100):
        far = 0.92 * reach_deg * np.sqrt(rng.random())
        turn = rng.uniform(0, 2 * np.pi)
        x = centre[0] + far * np.cos(turn)
        y = centre[1] + far * np.sin(turn)
        if np.hypot(x, y) > from_fovea and np.hypot(x - 15.2, y + 1.5) > 4:
            break
    return float(x), float(y)


def _blot(
    onto: Image,
    x: Image,
    y: Image,
    rng: np.random.Generator,
    place: tuple[float, float],
    radius: float,
    strength: float,
    rough: float,
) -> None:
    """Merge one spot with an irregular outline into the coverage `onto`, in place, as the pixel-wise maximum."""
    lean = rng.uniform(0.7, 1)
    turn = rng.uniform(0, np.pi)
    waves = rng.normal(0, rough, 3) / np.array([1, 1.5, 2])
    phases = rng.uniform(0, 2 * np.pi, 3)
    near_x = np.flatnonzero(np.abs(x[0] - place[0]) < 3 * radius)
    near_y = np.flatnonzero(np.abs(y[:, 0] - place[1]) < 3 * radius)
    if near_x.size == 0 or near_y.size == 0:
        return
    window = np.s_[near_y[0] : near_y[-1] + 1, near_x[0] : near_x[-1] + 1]
    right = x[:, window[1]] - place[0]
    down = y[window[0]] - place[1]
    u = (np.cos(turn) * right + np.sin(turn) * down) * lean
    v = (np.cos(turn) * down - np.sin(turn) * right) / lean
    angle = np.arctan2(v, u)
    outline = 1 + sum(w * np.cos((k + 2) * angle + p) for k, (w, p) in enumerate(zip(waves, phases, strict=True)))
    soft = 0.06 + 0.03 / radius
    spot = strength / (1 + np.exp((np.hypot(u, v) / radius - outline) / np.float32(soft)))
    np.maximum(onto[window], spot.astype(np.float32), out=onto[window])
