"""What to do so that a picture can be taken, told from the frames of the live picture: one word at a time."""

from dataclasses import dataclass
from math import hypot
from typing import Literal

import numpy as np

from device.recon.quality import LEAST_THROUGH, MOST_SATURATED
from device.recon.verdict import (
    LEAST_COVERAGE,
    LEAST_WIDE,
    MOST_WIDE,
    ONE_SIDED,
    Reading,
)
from device.values import Image

AimCode = Literal["ready", "noeye", "closer", "back", "left", "right", "up", "down", "still", "dark", "bright"]
HELD_S = 0.7  # a word stays so long, so that it can be read
LEAST_E_PER_UM2 = 0.1  # of a live frame, which gets less light than a picture
MOST_DEG_PER_SHOT = 0.5  # of way in one exposure: as much as the finest detail that is resolved
LATELY_S = 1.0  # two frames farther apart say nothing about a movement
FIELD_MARGIN = 0.85
VESSELS = (4, 20)  # cycles across the picture: coarser is the light's own shape, finer is noise


@dataclass(frozen=True)
class Aim:
    """One word for whoever aims, and how much of the field is lit, 0 to 1."""

    code: AimCode
    fill: float


class Aimer:
    """Follows the live picture: where the light is, and whether it stands still; one thread at a time.

    Directions are those of the picture: "right" means that the pupil's light is at the right, and the camera must go
    there. "closer" and "back" follow the simulated relay: a pupil beyond its focus spreads the light on the sensor.
    """

    def __init__(self, shot_s: float, deg_per_sample: float | None) -> None:
        self._most_deg_per_s, self._deg_per_sample = MOST_DEG_PER_SHOT / shot_s, deg_per_sample
        self._before: Image | None = None
        self._before_s = self._since_s = float("-inf")
        self.aim = Aim("noeye", 0.0)

    def __call__(self, reading: Reading, picture: Image | None, now_s: float) -> Aim:
        """The word after one more frame, exposed at `now_s` on the instrument's clock; at most one in 0.7 s."""
        code = _wanted(reading, self._speed_deg_per_s(reading, picture, now_s) > self._most_deg_per_s)
        fill = 0.0 if code == "noeye" else min(max(reading.coverage or 0.0, 0.0), 1.0)
        if code != self.aim.code and now_s - self._since_s < HELD_S:
            code = self.aim.code
        elif code != self.aim.code:
            self._since_s = now_s
        self.aim = Aim(code, round(fill, 2))
        return self.aim

    def saw_an_eye(self, now_s: float) -> bool:
        """Whether the live picture showed an eye just before `now_s`."""
        return self._before is not None and now_s - self._before_s < LATELY_S

    def _speed_deg_per_s(self, reading: Reading, picture: Image | None, now_s: float) -> float:
        """How fast the picture moves since the frame before; 0 where nobody can tell."""
        before, before_s = self._before, self._before_s
        is_eye = picture is not None and reading.through is not None and reading.through >= LEAST_THROUGH
        self._before, self._before_s = (picture.copy() if picture is not None and is_eye else None), now_s
        step_s = now_s - before_s
        if before is None or self._before is None or self._deg_per_sample is None or not 0 < step_s < LATELY_S:
            return 0.0
        return moved_samples(before, self._before) * self._deg_per_sample / step_s


def _wanted(seen: Reading, moves: bool) -> AimCode:
    """The most useful word for a frame: no eye, distance, direction, brightness, stillness, ready."""
    if seen.light_e_per_um2 is not None and seen.light_e_per_um2 < LEAST_E_PER_UM2 and seen.saturated == 0:
        return "noeye" if seen.through is None or seen.through < LEAST_THROUGH else "dark"
    if seen.saturated > MOST_SATURATED:
        return "bright"
    if seen.through is not None and seen.through < LEAST_THROUGH:
        return "noeye"
    if (way := _way(seen)) is not None:
        return way
    return "still" if moves else "ready"


def _way(seen: Reading) -> AimCode | None:
    """Where the camera must go; None if the field is lit as it should be."""
    right, down = seen.off_x or 0.0, seen.off_y or 0.0
    if hypot(right, down) > ONE_SIDED:
        if abs(right) > abs(down):
            return "right" if right > 0 else "left"
        return "down" if down > 0 else "up"
    if seen.wide is not None and seen.wide > MOST_WIDE:
        return "closer"
    if seen.wide is not None and seen.wide < LEAST_WIDE:
        return "back"
    return "closer" if seen.coverage is not None and seen.coverage < LEAST_COVERAGE else None


def moved_samples(before: Image, now: Image) -> float:
    """How far what two pictures show has moved, in samples: the peak of their correlation in the band of vessels."""
    rows, cols = before.shape
    cycles = np.hypot(np.fft.fftfreq(rows, 1 / rows)[:, None], np.fft.rfftfreq(cols, 1 / cols)[None])
    band = (cycles > VESSELS[0]) & (cycles < VESSELS[1])
    cross = np.fft.rfft2(_detail(before)) * np.conj(np.fft.rfft2(_detail(now))) * band
    row, col = np.unravel_index(int(np.argmax(np.fft.irfft2(cross, before.shape))), before.shape)
    return hypot(min(row, rows - row), min(col, cols - col))


def _detail(picture: Image) -> Image:
    """What is in the field, without its mean and its rim, which do not move with the eye."""
    rows, cols = (np.linspace(-1, 1, size) for size in picture.shape)
    away = np.hypot(rows[:, None], cols[None])
    window = 0.5 - 0.5 * np.cos(np.pi * np.clip((FIELD_MARGIN - away) / 0.25, 0, 1))
    mean = float((picture * window).sum()) / float(window.sum())
    detail: Image = ((picture - mean) * window).astype(np.float32)
    return detail
