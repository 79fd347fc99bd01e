"""`diffuscope check --model-eye`: does a head show the printed retina chart as its file promises.

    check_model_eye     reconstructs a frame with the default method and compares five figures with the head's promise
    expose_model_eye    takes that frame, and a dark one, with the head itself
    table, as_json      the result as text and as JSON

A figure is promised by the head file through `device/optics`, and has a tolerance with its reason. The light decides
the promised resolution (OPTICS.md 4.3), so a dim head fails on light and not also on resolution.
"""

import json
from dataclasses import asdict, dataclass, replace
from math import exp, radians
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import Clock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import FrameError, PsfError, SpecError
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.optics import retina_chart
from device.optics.budget import optical_budget
from device.optics.illumination import MEAN_OVER_PEAK, half_period_deg
from device.optics.led_cap import LedCap, dark_deg, relative_intensity
from device.optics.light_budget import chain, log_sd
from device.optics.lit_angle import cap_of
from device.recon.assessment.quality_figures import MISMATCHES
from device.values import ExposureSettings, Illumination, Image
from services import resources
from services.research.reconstruct_file import reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions, Source, load_raw
from services.workshop.model_eye_fit import ChartFit, fit_chart, lit_diameter_px, modulation, patch
from services.workshop.optics_report import design_of

FILL_SHARE = 0.5  # of the full well, that the brightest pixel is to reach
SEEN_PX_PER_DEG = 8.0  # of the expected light of the field
WIDER = 1.2  # of the promised field: room for a field that is larger than promised
RESOLVED = 0.2  # least modulation of resolved bars; 0.15 is Rayleigh's dip of 26 %, as contrast
MIN_AGREEMENT = 0.5  # 0.95 in a good picture, 0.78 at 170 electrons per pixel of 5.04 um, 0.06 in noise
BARS_OVER_FORMULA = 0.6  # resolved period over that of the formula, which is of vessels: 0.46 to 0.6 in simulation
SCALE_TOLERANCE, FIELD_TOLERANCE, STEP, GREY_TOLERANCE = 0.025, 0.05, 1.27, 0.15
PAPER_SPREAD = 0.1  # of ln of the reflectance of printing paper (an estimate)
TWO_SIDED_95 = 1.96  # standard deviations
MAX_SATURATED = 0.01
REASONS = {
    "resolution": "one step of the chart; OPTICS.md 4.3 for this light, and bars of full contrast (simulated)",
    "scale": "lens 25.0 or 25.2 mm (0.8 %), print (0.5 %), diffuser to sensor 6.0 +- 0.05 mm (0.8 %)",
    "field": "the holes of the LED cap, printed to 0.1 mm of 2.2 mm; the penumbra of the dies is expected",
    "light": "95 % by the chain of OPTICS.md 4.6: polarisers, pupil, paper, and the LEDs' power until it is measured",
    "grey": "tone of a print: a laser printer's dots grow by up to 15 %",
}
REMEDIES = {
    "resolution": "Focus: one step ring, lens seated, diffuser to sensor as in the head file; PSF of today.",
    "scale": "Measure the chart's control line (20 mm), then the distance from diffuser to sensor and the relay.",
    "field": "Look at the LED cap, and whether the model eye's pupil is on the head's axis.",
    "light": "Look at polarisers and LEDs, and give the exposure of this frame with --exposure-s.",
    "grey": "Print the chart again without a driver's contrast, on matt white paper.",
}


@dataclass(frozen=True)
class Promise:
    """What a head file promises of the chart; `lit_e` is the mean charge per pixel of the lit disc in one exposure.

    `field_deg` is that of the head file, `seen_field_deg` what `lit_diameter_px` finds of it with the penumbra of the
    dies, `dark_deg` the full angle beyond which no light arrives.

    `light_factor` is the factor within which 95 % of such heads are, by the light's chain: less for a measured ring.
    """

    px_per_deg: float
    field_deg: float
    seen_field_deg: float
    dark_deg: float
    extent_px: float
    lit_e: float
    pitch_um: float
    light_factor: float


@dataclass(frozen=True)
class Row:
    """One figure: measured, promised, the range in which it is right, and why the range is so wide."""

    name: str
    measured: float | None
    promised: float
    low: float
    high: float
    unit: str
    reason: str
    remedy: str

    @property
    def ok(self) -> bool:
        """True if the figure was measured and lies in its range."""
        return self.measured is not None and self.low <= self.measured <= self.high


@dataclass(frozen=True)
class ModelEyeResult:
    """Result of a check: head, exposure in s, figures, contrast of each bar group by its period in um, and the place.

    `warnings` are those of the reconstruction; `simulated` is true for frames of a simulated head.
    """

    head: str
    exposure_s: float
    rows: tuple[Row, ...]
    modulation: dict[int, float]
    fit: ChartFit
    warnings: tuple[str, ...]
    simulated: bool

    @property
    def ok(self) -> bool:
        """True if every figure is right."""
        return all(row.ok for row in self.rows)


@dataclass(frozen=True)
class ModelEyeFrame:
    """A frame of the chart with its PSF and dark frame, as files or arrays (rows, cols), and its exposure time, s."""

    raw: Source
    psf: Source
    dark: Source | None
    exposure_s: float


def promise_of(spec: InstrumentSpec, exposure_s: float) -> Promise:
    """Return what a head promises of the chart at full drive; SpecError for a head without [optics] or light."""
    if spec.light.backend == "none":
        raise SpecError(f"{spec.name} has no lamp, so it promises no light", "Give the file of a head with a lamp.")
    design = design_of(spec)
    field_deg = design.optics.field_deg
    reflectance = retina_chart.PAPER_REFLECTANCE * mean_tone(field_deg)
    white = replace(design, eye_mm=retina_chart.EYE_MM, led=replace(design.led, reflectance=reflectance))
    budget = optical_budget(replace(white, exposure_s=exposure_s))
    extent_px = 1000 * budget.extent_mm / design.pitch_um
    factors = [
        replace(factor, spread=PAPER_SPREAD) if factor.name == "radiance of the fundus" else factor
        for factor in chain(white)
    ]
    factor = exp(TWO_SIDED_95 * log_sd(factors))
    cap = cap_of(spec)
    magnification = design.relay.angular_magnification
    seen_deg = field_deg if cap is None else seen_field_deg(cap, magnification)
    most_deg = field_deg if cap is None else dark_deg(cap, magnification)
    return Promise(
        budget.px_per_deg, field_deg, seen_deg, most_deg, extent_px, budget.electrons_per_px, design.pitch_um, factor
    )


def seen_field_deg(cap: LedCap, magnification: float) -> float:
    """Return the diameter of the lit field that `lit_diameter_px` finds of the chart behind such a cap, degrees.

    It depends on the chart: half of the lit level is reached in the penumbra, where the rings are.
    """
    half_deg = dark_deg(cap, magnification) / 2
    steps = np.arange(-half_deg - 2, half_deg + 2, 1 / SEEN_PX_PER_DEG)
    off = np.radians(np.hypot(steps[:, None], steps[None, :]))
    per_deg = 1000 * retina_chart.EYE_MM * np.tan(off) / np.maximum(np.degrees(off), 1e-9)
    chart = _tones((steps[None, :] * per_deg).astype(np.float32), (steps[:, None] * per_deg).astype(np.float32))
    light = np.vstack([relative_intensity(cap, magnification, steps, down) for down in steps])
    return lit_diameter_px((chart * light * np.cos(off) ** 3).astype(np.float32), SEEN_PX_PER_DEG) / SEEN_PX_PER_DEG


def mean_tone(field_deg: float) -> float:
    """Return the mean tone of the chart within a field, paper 1."""
    half_um = 1000 * retina_chart.EYE_MM * np.tan(radians(field_deg / 2))
    steps = np.linspace(-half_um, half_um, 301, dtype=np.float32)
    x, y = np.meshgrid(steps, steps)
    return float(_tones(x, y)[np.hypot(x, y) <= half_um].mean())


def _tones(right_um: Image, down_um: Image) -> Image:
    """Return the tones of the chart at places on it, paper 1."""
    plane = np.ones(right_um.shape, np.float32)
    for tone in (retina_chart.INK, retina_chart.GREY):
        plane[retina_chart.signed_distance_um(retina_chart.of_tone(tone), right_um, down_um) < 0] = tone
    return plane


def usual_exposure_s(spec: InstrumentSpec) -> float:
    """Return the exposure at which the brightest pixel reaches half of the full well, at most that of the head, s."""
    lit_e = promise_of(spec, spec.camera.exposure_s).lit_e
    share = FILL_SHARE * spec.camera.full_well_e * MEAN_OVER_PEAK / lit_e
    return float(spec.camera.exposure_s * min(1.0, share))


def expose_model_eye(spec: InstrumentSpec, exposure_s: float | None, clock: Clock) -> ModelEyeFrame:
    """Take a lit and a dark frame with the head, whose light reaches no person: the model eye stands before it.

    `exposure_s` None: as `usual_exposure_s`. Errors of the head's parts, its calibration and the light guard.
    """
    shot = ExposureSettings(exposure_s or usual_exposure_s(spec))
    head = open_head(spec, clock, MemoryLedger(clock))
    try:
        head.check()
        dark = head.camera.expose(shot)
        with head.light.on(Illumination(spec.light.colour)):
            lit = head.camera.expose(shot)
        psf = head.calibration.for_colour(spec.light.colour).psfs[0]
        return ModelEyeFrame(lit.counts, psf.pixels, dark.counts, shot.exposure_s)
    finally:
        head.close()


def check_model_eye(head: Path, frame: ModelEyeFrame) -> ModelEyeResult:
    """Return the five figures of a frame of the chart against the promise of a head file.

    FrameError for a frame that is too dark, saturated or without the chart; PsfError for a PSF of another head; errors
    of `reconstruct_file`.
    """
    spec = load_head(head)
    promise = promise_of(spec, frame.exposure_s)
    mean_e, peak_e = _electrons(spec, frame, promise)
    options = ReconstructOptions(psfs=(frame.psf,), dark=frame.dark, head=head, plans=resources.fft_plans())
    made = reconstruct_file(frame.raw, options)
    if found := [warning for warning in made.report.warnings if warning in MISMATCHES.values()]:
        raise PsfError(found[0], "Calibrate the head, or give the PSF that was measured with this head and this mode.")
    wide_deg = min(max(WIDER * promise.field_deg, promise.dark_deg), 120.0)
    wide = reconstruct_file(frame.raw, replace(options, field_deg=wide_deg)).picture
    fit = fit_chart(wide, promise.px_per_deg, promise.field_deg)
    if fit.agreement < MIN_AGREEMENT:
        raise FrameError(
            f"there is no chart of the model eye in this frame (agreement {fit.agreement:.2f} of 1)",
            "Put the chart into the model eye, ink towards the lens, with one step ring; light it, and keep its pupil "
            "on the head's axis. If it is there, the PSF may be that of another head.",
        )
    groups = sorted(retina_chart.BAR_GROUPS, key=lambda group: group.period_um)
    contrast = {int(group.period_um): modulation(made.picture, fit, group) for group in groups}
    rows = (
        _resolution(contrast, peak_e, promise),
        _scale(fit, promise),
        _field(wide, fit, promise),
        light_row(mean_e, promise),
        _grey(made.picture, fit),
    )
    return ModelEyeResult(spec.name, frame.exposure_s, rows, contrast, fit, made.report.warnings, made.simulated)


def table(found: ModelEyeResult) -> str:
    """Return the result as text: one line per figure, with the reason of its tolerance and the remedy of a miss."""
    mark = ", simulated" if found.simulated else ""
    lines = [f"{found.head}: the model eye in {1000 * found.exposure_s:.3g} ms{mark}"]
    for row in found.rows:
        measured = "none" if row.measured is None else f"{row.measured:.4g}"
        allowed = f"{row.low:.4g} to {row.high:.4g}" if row.low > 0 else f"at most {row.high:.4g}"
        lines.append(
            f"{'ok  ' if row.ok else 'FAIL'}  {row.name:<10} {measured:>8} {row.unit:<11}"
            f" promised {row.promised:<8.4g} {allowed:<18} {row.reason}"
        )
        if not row.ok:
            lines.append(f"{'':<6}{row.remedy}")
    bars = ", ".join(f"{period} um {value:.2f}" for period, value in found.modulation.items())
    lines.append(f"      contrast of the bars, by period: {bars}")
    lines.append(f"      chart turned by {found.fit.turn_deg:.1f} deg, agreement {found.fit.agreement:.2f}")
    return "\n".join([*lines, *(f"note: {warning}" for warning in found.warnings)])


def as_json(found: ModelEyeResult) -> str:
    """Return the result as JSON: the fields of ModelEyeResult, with `ok` for each figure and for all."""
    rows = [{**asdict(row), "ok": row.ok} for row in found.rows]
    return json.dumps({**asdict(found), "rows": rows, "ok": found.ok}, indent=1)


def _electrons(spec: InstrumentSpec, frame: ModelEyeFrame, promise: Promise) -> tuple[float, float]:
    """Return mean over the lit disc and peak of the frame's electrons; FrameError if too dark or saturated."""
    loaded = load_raw(frame.raw)
    camera = spec.camera
    pixels = np.asarray(loaded.raw.pixels, np.float64)
    if pixels.shape != (camera.rows, camera.cols):
        raise FrameError(
            f"{loaded.name} has {' x '.join(map(str, pixels.shape))} values, the head {camera.rows} x {camera.cols}",
            "Give a monochrome frame of this head in its own mode.",
        )
    saturated = float((pixels >= min(camera.white_dn, loaded.raw.white_dn)).mean())
    if saturated > MAX_SATURATED:
        raise FrameError(
            f"{loaded.name} is too bright: {saturated:.0%} of its pixels are saturated",
            f"Take it with a shorter exposure than {1000 * frame.exposure_s:g} ms.",
        )
    black_dn: float | NDArray[Any] = float(camera.black_dn)
    if frame.dark is not None:
        black_dn = np.asarray(load_raw(frame.dark, checked=False).raw.pixels, np.float64)
    charge_e = camera.gain_e_per_dn * (pixels - black_dn)
    mean_e = float(charge_e[_lit(charge_e.shape, promise)].mean())
    peak_e = float(np.quantile(charge_e, 0.9995))
    coarsest_um = retina_chart.PERIODS_UM[-1]
    if mean_e <= camera.read_noise_e or _period_um(peak_e, promise) > coarsest_um:
        raise FrameError(
            f"{loaded.name} is too dark: {max(mean_e, 0):.0f} electrons a pixel, of which no bars of the chart are "
            "promised to be resolved",
            f"Take it at full drive with a longer exposure than {1000 * frame.exposure_s:g} ms; look whether the chart "
            "is lit, and whether the dark frame has the same exposure.",
        )
    return mean_e, peak_e


def _lit(shape: tuple[int, ...], promise: Promise) -> NDArray[np.bool_]:
    """Return the mask of the promised light on the sensor, (rows, cols)."""
    rows, cols = (np.arange(size) - (size - 1) / 2 for size in shape)
    return np.asarray(np.hypot(rows[:, None], cols[None, :]) <= promise.extent_px / 2)


def _period_um(peak_e: float, promise: Promise) -> float:
    """Return the finest bar period on the chart that this light promises, at least two pixels, um."""
    if peak_e <= 0:
        return float("inf")
    formula_deg = half_period_deg(peak_e, promise.pitch_um)
    half_deg = max(BARS_OVER_FORMULA * formula_deg, 1 / promise.px_per_deg)
    return 2000 * retina_chart.EYE_MM * radians(half_deg)


def _resolution(contrast: dict[int, float], peak_e: float, promise: Promise) -> Row:
    finest: int | None = None
    for period in sorted(contrast, reverse=True):
        if contrast[period] < RESOLVED:
            break
        finest = period
    promised_um = max(_period_um(peak_e, promise), float(retina_chart.PERIODS_UM[0]))
    return _row("resolution", finest, promised_um, 0.0, STEP * promised_um, "um period")


def _scale(fit: ChartFit, promise: Promise) -> Row:
    px = promise.px_per_deg
    return _row("scale", fit.px_per_deg, px, px * (1 - SCALE_TOLERANCE), px * (1 + SCALE_TOLERANCE), "px/deg")


def _field(wide: Image, fit: ChartFit, promise: Promise) -> Row:
    measured = lit_diameter_px(wide, fit.px_per_deg) / fit.px_per_deg
    field = promise.seen_field_deg
    return _row("field", measured, field, field * (1 - FIELD_TOLERANCE), field * (1 + FIELD_TOLERANCE), "deg")


def light_row(mean_e: float, promise: Promise) -> Row:
    """Return the figure of the light: mean electrons of a pixel of the lit disc against the promise."""
    light = promise.lit_e
    factor = promise.light_factor
    return _row("light", mean_e, light, light / factor, light * factor, "e-/pixel")


def _grey(picture: Image, fit: ChartFit) -> Row:
    paper, grey, ink = (
        patch(picture, fit, disc)
        for disc in (retina_chart.PAPER_PATCH, retina_chart.GREY_PATCH, retina_chart.INK_PATCH)
    )
    measured = (grey - ink) / (paper - ink) if paper > ink else None
    wanted = (retina_chart.GREY - retina_chart.INK) / (1 - retina_chart.INK)
    return _row("grey", measured, wanted, wanted - GREY_TOLERANCE, wanted + GREY_TOLERANCE, "of paper")


def _row(name: str, measured: float | None, promised: float, low: float, high: float, unit: str) -> Row:
    return Row(name, measured, promised, low, high, unit, REASONS[name], REMEDIES[name])
