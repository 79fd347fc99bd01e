"""Aiming guidance: one instruction for the operator, from the frames of the live picture."""

from dataclasses import dataclass
from math import hypot
from typing import Literal

import numpy as np

from device.recon.assessment.frame_quality import MAX_WIDE, MIN_COVERAGE, MIN_WIDE, ONE_SIDED, FrameFigures
from device.recon.assessment.quality_figures import MAX_SATURATED, MIN_THROUGH
from device.values import Image

AimCode = Literal["ready", "noeye", "closer", "back", "left", "right", "up", "down", "still", "dark", "bright"]
MIN_DISPLAY_S = 0.7  # minimum display time of an instruction, so that it can be read
MIN_E_PER_UM2 = 0.1  # of a live frame, which gets less light than a picture
MAX_DEG_PER_SHOT = 0.5  # of motion during one exposure: the size of the finest resolved detail
MAX_FRAME_GAP_S = 1.0  # longest interval between two frames for an estimate of the speed
FIELD_MARGIN = 0.85
VESSELS = (4, 20)  # cycles across the picture: lower is illumination, higher is noise


@dataclass(frozen=True)
class Aim:
    """Instruction for the operator.

    Attributes
    ----------
    code
        One code of the page.
    fill
        Lit share of the field, 0 to 1; 0 for `noeye` or if unknown.
    """

    code: AimCode
    fill: float


class AimingGuide:
    """Aiming instructions from a sequence of live frames: position of the light, and motion.

    Directions are those of the picture: "right" means that the light of the pupil is on the right, and the
    camera must move there. "closer" and "back" follow the simulated relay: a pupil beyond its focus spreads
    the light on the sensor. Not thread-safe.

    Parameters
    ----------
    shot_s
        Exposure time of a capture in s.
    deg_per_sample
        Width of a sample of the pictures in degrees; None: motion is ignored.
    """

    def __init__(self, shot_s: float, deg_per_sample: float | None) -> None:
        self._most_deg_per_s = MAX_DEG_PER_SHOT / shot_s
        self._deg_per_sample = deg_per_sample
        self._before: Image | None = None
        self._before_s = self._since_s = float("-inf")
        self._moved_deg_per_s: float | None = None
        self.aim = Aim("noeye", 0.0)

    def __call__(self, reading: FrameFigures, picture: Image | None, now_s: float) -> Aim:
        """Return the instruction after one more frame.

        The code changes at most once in MIN_DISPLAY_S.

        Parameters
        ----------
        reading
            Figures of the frame.
        picture
            Coarse picture of the frame, (rows, cols); None without a known field.
        now_s
            Time of its exposure on the instrument's clock in s.

        Returns
        -------
        Aim
            Code, and lit share of the field.
        """
        self._moved_deg_per_s = self._speed_between_deg_per_s(reading, picture, now_s)
        code = _instruction(reading, (self._moved_deg_per_s or 0.0) > self._most_deg_per_s)
        fill = 0.0 if code == "noeye" else min(max(reading.coverage or 0.0, 0.0), 1.0)
        if code != self.aim.code and now_s - self._since_s < MIN_DISPLAY_S:
            code = self.aim.code
        elif code != self.aim.code:
            self._since_s = now_s
        self.aim = Aim(code, round(fill, 2))
        return self.aim

    def eye_was_visible(self, now_s: float) -> bool:
        """Return whether the last live frame showed an eye.

        Parameters
        ----------
        now_s
            Present time in s.

        Returns
        -------
        bool
            True if it did, and is less than MAX_FRAME_GAP_S before `now_s`.
        """
        return self._before is not None and now_s - self._before_s < MAX_FRAME_GAP_S

    def speed_deg_per_s(self, now_s: float) -> float | None:
        """Return the speed of the picture between the last two live frames.

        Parameters
        ----------
        now_s
            Present time in s.

        Returns
        -------
        float or None
            Speed in degrees per second; None if it is unknown, or the last live frame is MAX_FRAME_GAP_S or
            more before `now_s`.
        """
        return self._moved_deg_per_s if self.eye_was_visible(now_s) else None

    def _speed_between_deg_per_s(self, reading: FrameFigures, picture: Image | None, now_s: float) -> float | None:
        """Return the speed of the picture in degrees per second since the previous frame; None if unknown."""
        before = self._before
        before_s = self._before_s
        is_eye = picture is not None and reading.through is not None and reading.through >= MIN_THROUGH
        self._before = picture.copy() if picture is not None and is_eye else None
        self._before_s = now_s
        step_s = now_s - before_s
        if before is None or self._before is None or self._deg_per_sample is None or not 0 < step_s < MAX_FRAME_GAP_S:
            return None
        return moved_samples(before, self._before) * self._deg_per_sample / step_s


def _instruction(seen: FrameFigures, is_moving: bool) -> AimCode:
    """Return the code of the first rule that applies: dark, bright, no eye, direction, distance, motion, ready."""
    if seen.light_e_per_um2 is not None and seen.light_e_per_um2 < MIN_E_PER_UM2 and seen.saturated == 0:
        return "noeye" if seen.through is None or seen.through < MIN_THROUGH else "dark"
    if seen.saturated > MAX_SATURATED:
        return "bright"
    if seen.through is not None and seen.through < MIN_THROUGH:
        return "noeye"
    if (direction := _direction(seen)) is not None:
        return direction
    return "still" if is_moving else "ready"


def _direction(seen: FrameFigures) -> AimCode | None:
    """Return the direction in which the camera must move, sideways before "closer" or "back"; None if none."""
    right = seen.off_x or 0.0
    down = seen.off_y or 0.0
    if hypot(right, down) > ONE_SIDED:
        if abs(right) > abs(down):
            return "right" if right > 0 else "left"
        return "down" if down > 0 else "up"
    if seen.wide is not None and seen.wide > MAX_WIDE:
        return "closer"
    if seen.wide is not None and seen.wide < MIN_WIDE:
        return "back"
    return "closer" if seen.coverage is not None and seen.coverage < MIN_COVERAGE else None


def moved_samples(before: Image, now: Image) -> float:
    """Return the length in samples of the shift between two pictures: the correlation peak in the band of vessels."""
    rows, cols = before.shape
    cycles = np.hypot(np.fft.fftfreq(rows, 1 / rows)[:, None], np.fft.rfftfreq(cols, 1 / cols)[None])
    band = (cycles > VESSELS[0]) & (cycles < VESSELS[1])
    cross = np.fft.rfft2(_detail(before)) * np.conj(np.fft.rfft2(_detail(now))) * band
    surface = np.fft.irfft2(cross, before.shape)
    row, col = (int(at) for at in np.unravel_index(int(np.argmax(surface)), before.shape))
    down = _top(surface[(row - 1) % rows, col], surface[row, col], surface[(row + 1) % rows, col])
    right = _top(surface[row, (col - 1) % cols], surface[row, col], surface[row, (col + 1) % cols])
    return hypot(
        row + down if row < rows / 2 else rows - row - down, col + right if col < cols / 2 else cols - col - right
    )


def _top(before: float, peak: float, after: float) -> float:
    """Return where the parabola through a maximum and its neighbours has its top, -0.5 to 0.5 samples."""
    curve = before - 2 * peak + after
    return float(np.clip(0.5 * (before - after) / curve, -0.5, 0.5)) if curve < 0 else 0.0


def _detail(picture: Image) -> Image:
    """Return the picture minus its mean, tapered to 0 before the field edge: the edge does not move with the eye."""
    rows, cols = (np.linspace(-1, 1, size) for size in picture.shape)
    away = np.hypot(rows[:, None], cols[None])
    window = 0.5 - 0.5 * np.cos(np.pi * np.clip((FIELD_MARGIN - away) / 0.25, 0, 1))
    mean = float((picture * window).sum()) / float(window.sum())
    detail: Image = ((picture - mean) * window).astype(np.float32)
    return detail
