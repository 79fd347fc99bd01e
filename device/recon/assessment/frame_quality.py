"""Verdicts: on a raw frame, with its cause, before the reconstruction, and on its picture after it (assess_picture).

A coarse, linear solution of the frame answers five questions: is it too bright or too dark, did the light come through
the field or from everywhere, is a part of the field dark, is there light that is not from the retina, is there less
detail along one direction. Causes that one frame cannot show are not reported: motion blur of more than some degrees
leaves no directional detail, and a closed lid gives the same frame as a wall.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from math import hypot, isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError
from device.recon.assessment.quality_figures import MAX_SATURATED, MIN_THROUGH
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.refraction.field import lamp_light
from device.recon.frames import plane
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.forward_model import Model, tight_model
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Preprocessor
from device.recon.solvers.tv import EvidenceWiener
from device.values import Calibration, Image, Verdict

Floats = NDArray[np.float64]
Code = Literal[
    "shot.saturated",
    "shot.dark",
    "shot.moved",
    "shot.noeye",
    "shot.pupil",
    "shot.blink",
    "shot.edge",
    "shot.halo",
    "shot.poor",
    "make.failed",
]

# Limits. Detection and false-alarm rates: tests/hard/test_frame_quality.py.
# `wide` of a saturated frame: overexposure flattens its middle; a reflex, which is small, does not.
LARGEST_SPOT, SPOT, SPOT_PER_SHARE = 0.15, 0.975, 0.6
MIN_E_PER_UM2 = 0.5  # a human eye's photon budget gives 3.0, and a PCC of 0.91; 0.3 gives 0.81, 0.1 gives 0.67
MIN_COVERAGE = 0.9  # good fields have 0.975 and more
MIN_WIDE, MAX_WIDE = 0.93, 1.025  # good fields have 0.97 to 1.005
ONE_SIDED = 0.1
MAX_SMEAR = 0.22
MAX_MEASURABLE_SATURATION = 0.25  # share of saturated pixels above which no other figure is valid
FIELD_SAMPLES = 64  # across the field, at the least
SMEAR_CYCLES = (12, 40)  # across the field: higher is noise, lower is the illumination


@dataclass(frozen=True)
class FrameFigures:
    """Figures of one raw frame; None if a figure is unknown (no field, no gain, or too much light).

    `saturated` is the share of saturated pixels; `light_e_per_um2` the mean light on the sensor in electrons per um^2,
    `through` the share of it that came through the field; `coverage` is the lit share of the field in the light of the
    lamp; `off_x` and `off_y` are the position of its centre of light in field radii, right and down; `smear` is the
    directional dependence of the detail, 0 to 1; `wide` is the rms radius of the light on the sensor over that of an
    even retina.
    """

    saturated: float
    light_e_per_um2: float | None = None
    through: float | None = None
    coverage: float | None = None
    off_x: float | None = None
    off_y: float | None = None
    smear: float | None = None
    wide: float | None = None


def assess(reading: FrameFigures, eye_before: bool = False) -> Verdict:
    """Return the verdict with the first cause that applies; `eye_before`: an eye was visible just before this frame."""
    code = _cause(reading, eye_before)
    return Verdict("good" if code is None else "again", code, _rounded(asdict(reading)))


def assess_picture(first: Verdict, residual: float | None, coverage: float | None, tries: int, retakes: int) -> Verdict:
    """Return the verdict after the reconstruction: `first`, or `shot.edge` if that was good but `coverage` is too low.

    If `tries` has reached `retakes`, any cause becomes `shot.poor` (the word stays "again"). The residual is recorded
    and does not affect the verdict: stray light and worn pixels double it in good pictures.
    """
    numbers = dict(first.numbers) | _rounded({"residual": residual, "lit": coverage})
    code = first.code
    if code is None and coverage is not None and coverage < MIN_COVERAGE:
        code = "shot.edge"
    if code is not None and tries >= retakes:
        code = "shot.poor"
    return Verdict("good" if code is None else "again", code, numbers)


def shows_eye(numbers: Mapping[str, Any]) -> bool:
    """Return whether a frame with the figures of its verdict shows a retina through the whole pupil, still or moving.

    Such a frame is evidence about the head. A pupil that cuts the beam lets a part of the diffuser form the image: the
    frame has another PSF and another field than the calibration. Light that is wider than the field is the head's.
    """
    known = {figure.name: float(numbers[figure.name]) for figure in fields(FrameFigures) if figure.name in numbers}
    if "wide" in known:
        known["wide"] = min(known["wide"], 1.0)
    seen = FrameFigures(**{"saturated": 0.0} | known)
    return _cause(seen, False) in (None, "shot.moved")


def _cause(seen: FrameFigures, eye_before: bool) -> Code | None:
    if seen.saturated > MAX_SATURATED:
        narrow = seen.wide is not None and seen.wide < SPOT + SPOT_PER_SHARE * seen.saturated
        return "shot.halo" if narrow and seen.saturated < LARGEST_SPOT else "shot.saturated"
    if seen.light_e_per_um2 is not None and seen.light_e_per_um2 < MIN_E_PER_UM2:
        return "shot.dark"
    if seen.through is not None and seen.through < MIN_THROUGH:
        return "shot.blink" if eye_before else "shot.noeye"
    if _is_cut(seen):
        return "shot.edge" if hypot(seen.off_x or 0.0, seen.off_y or 0.0) > ONE_SIDED else "shot.pupil"
    return "shot.moved" if seen.smear is not None and seen.smear > MAX_SMEAR else None


def _rounded(numbers: dict[str, float | None]) -> dict[str, Any]:
    """Return the known figures (not None), rounded to four significant digits."""
    return {key: float(f"{value:.4g}") for key, value in numbers.items() if value is not None}


def _is_cut(seen: FrameFigures) -> bool:
    """Return True if a part of the field is dark: `wide` is outside its limits, or `coverage` is too low."""
    narrow = seen.wide is not None and not MIN_WIDE < seen.wide < MAX_WIDE
    return narrow or (seen.coverage is not None and seen.coverage < MIN_COVERAGE)


class FrameQualityGate:
    """Quality figures of raw frames, planned for one calibration and one sensor shape.

    Without a known field only saturation and brightness are measured. One thread at a time.

    Parameters
    ----------
    calibration
        Calibration of the head.
    shape
        (rows, cols) of the sensor in pixels.
    planner
        Planner of the FFTs.
    index
        Index of the PSF in the calibration.
    """

    def __init__(
        self,
        calibration: Calibration,
        shape: tuple[int, int],
        planner: Planner,
        index: int = 0,
    ) -> None:
        self._sensor = calibration.sensor
        self._geometry = calibration.geometry
        radius_px = field_radius_px(calibration)
        self._field: _CoarseField | None = None
        if isfinite(radius_px):
            n = max(1, int(2 * radius_px // FIELD_SAMPLES))
            self._field = _CoarseField(calibration, tight_model(calibration, shape, n, planner, index))
        self._defects = DefectFinder(calibration, shape, index)

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> FrameFigures:
        """Return the figures of a frame, of colour that of the brightest channel.

        Parameters
        ----------
        counts
            Counts, uint16 or float32, (rows, cols) or (rows, cols, 3).
        dark
            Dark frame of the same shape; None: that of the calibration, for the brightness the black level.

        Returns
        -------
        FrameFigures
            Figures of the frame.

        Raises
        ------
        FrameError
            The frame has another shape, or too many pixels are missing but at most MAX_SATURATED are saturated.
        """
        counts, dark = brightest(counts, dark)
        saturated = float((counts >= self._sensor.white_dn).mean())
        black_dn = self._sensor.black_dn if dark is None else float(dark.mean(dtype=np.float64))
        light_dn = float(counts.mean(dtype=np.float64)) - black_dn
        brightness = FrameFigures(saturated, light_e_per_um2=self._light(light_dn))
        if self._field is None or saturated > MAX_MEASURABLE_SATURATION or light_dn <= 0:
            return brightness
        try:
            return self._field.read(brightness, counts, dark, self._defects(counts, dark))
        except FrameError:
            if saturated <= MAX_SATURATED:
                raise
            return brightness  # too few pixels are left because of the saturation

    @property
    def picture(self) -> Image | None:
        """Coarse picture of the field in the last frame that could be solved; None without a known field."""
        return None if self._field is None else self._field.shown

    @property
    def deg_per_sample(self) -> float | None:
        """Width of one sample of `picture` in degrees; None if unknown."""
        return None if self._field is None or self._geometry is None else self._field.bin / self._geometry.px_per_deg

    def _light(self, light_dn: float) -> float | None:
        if self._sensor.gain_e_per_dn is None or self._geometry is None:
            return None
        return light_dn * self._sensor.gain_e_per_dn / self._geometry.pitch_um**2


class _CoarseField:
    """Coarse solution of a frame, and the figures of its field."""

    def __init__(self, calibration: Calibration, model: Model) -> None:
        self._span_dn = calibration.sensor.white_dn - calibration.sensor.black_dn
        self._solver = EvidenceWiener(model, calibration)
        self._prepare = Preprocessor(calibration, model.grid)
        light = model.mask * lamp_light(calibration, model.grid)
        self._even_radius = _rms_radius(model.blur(light)[model.grid.slices])
        self._picture: Image = np.zeros(model.grid.shape, np.float32)
        self._shown = model.grid.shown
        self.bin = model.grid.n
        self.shown: Image = self._picture[self._shown]
        radius = model.grid.radius_samples
        rows, cols = (
            (np.arange(span.start, span.stop) - middle) / radius
            for span, middle in zip(self._shown, model.grid.centre, strict=True)
        )
        self._down, self._right = np.meshgrid(rows, cols, indexing="ij")
        away = np.hypot(self._down, self._right)
        self._inner = away < 0.9
        self._window = 0.5 - 0.5 * np.cos(np.pi * np.clip((0.85 - away) / 0.25, 0, 1))
        across, along = np.meshgrid(np.fft.fftfreq(rows.size), np.fft.rfftfreq(cols.size), indexing="ij")
        cycles = 2 * radius * np.hypot(across, along)
        self._band = (cycles > SMEAR_CYCLES[0]) & (cycles < SMEAR_CYCLES[1])
        self._weight = cycles[self._band] ** 3  # inverse of a retina's power: equal weight for every ring
        self._turn = np.exp(2j * np.arctan2(across, along))[self._band]

    def read(
        self, brightness: FrameFigures, counts: Pixels, dark: Pixels | None, defects: Places | None
    ) -> FrameFigures:
        """Return `brightness` with the figures of the field added; only `wide` if the frame is overexposed."""
        picture = self._picture
        solver = self._solver
        if brightness.saturated > MAX_SATURATED:
            frame = self._prepare(counts, dark)  # with all light, halos included
            full = (1 - frame.good) * np.float32(self._span_dn)
            return replace(brightness, wide=_rms_radius(frame.y + full) / self._even_radius)
        frame = self._prepare(counts, dark, defects)
        solver.start(frame)
        solver.finish(picture)
        shown = self.shown
        light = float(shown[self._inner].sum(dtype=np.float64))
        off_x, off_y = (
            float((shown * along)[self._inner].sum(dtype=np.float64)) / light if light > 0 else None
            for along in (self._right, self._down)
        )
        return replace(
            brightness,
            through=solver.diagnostics.quality["through"],
            coverage=solver.diagnostics.quality["coverage"],
            off_x=off_x,
            off_y=off_y,
            smear=self._smear(shown),
            wide=_rms_radius(frame.y - solver.stray) / self._even_radius,
        )

    def _smear(self, shown: Image) -> float | None:
        """Return the directional dependence of the detail's power: 0 for none, 1 for one direction; None if dark."""
        window = self._window
        mean = float((shown * self._window).sum(dtype=np.float64)) / float(self._window.sum())
        if mean <= 0:
            return None
        power = np.abs(np.fft.rfft2((shown / mean - 1) * window))[self._band] ** 2 * self._weight
        return float(np.abs((power * self._turn).sum()) / power.sum())


def brightest(counts: Pixels, dark: Pixels | None) -> tuple[Pixels, Pixels | None]:
    """Return the channel with the highest mean count, and its dark frame; a (rows, cols) frame is unchanged."""
    if counts.ndim == 2:
        return counts, dark
    c = int(np.argmax(counts.mean(axis=(0, 1))))
    return plane(counts, c), None if dark is None else plane(dark, c)


def _rms_radius(light: Image) -> float:
    """Return the rms distance of the light from its centroid in samples."""
    total = max(float(light.sum(dtype=np.float64)), 1e-9)
    squared = 0.0
    for axis in (0, 1):
        profile = light.sum(axis=1 - axis, dtype=np.float64)
        place = np.arange(light.shape[axis])
        middle = float(profile @ place) / total
        squared += float(profile @ (place - middle) ** 2) / total
    return float(max(squared, 1e-9) ** 0.5)
