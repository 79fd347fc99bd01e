"""Accuracy against light: bursts of one scene, their dose, and the bound of a linear filter with as much light.

And what a press makes of one scene within each time budget.

The bound is the Wiener filter that an oracle gives the object's own radial power, the noise and the even part of the
picture, on a frame of a still eye behind exactly the calibrated PSF. A linear filter with less knowledge stays below
it; total variation is not linear, and gets above it where the object has edges.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy import fft

from device.clock import Clock, Deadline, VirtualClock
from device.config.head_file import InstrumentSpec
from device.head import hazard_of
from device.recon.assessment.metrics import PictureScorer
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.frame_run import EyePsf
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor
from device.sim.render import crop_or_pad
from device.sim.scene_files import lit_frames
from device.sim.world import World
from device.values import Calibration, Counts, Illumination, Image, Reconstruction
from services.instrument.time_budget import PACES_S, is_of_one_frame
from services.records.capture_target import FRAMES
from services.research.frontier_result import LightPoint, PressPoint

NUMBERS = (1, 2, 4, 8)  # of frames
REPEATS = 3
ProgressCallback = Callable[[str], None]


@dataclass(frozen=True)
class LightCase:
    """Frames of one burst of a scene, and the dose of one of them.

    `mean_dn`: mean of a frame above dark. `dose_j_per_cm2`: retinal dose of one frame, weighted with the photochemical
    hazard, in the worst case where the head's light is not measured.
    """

    frames: tuple[Counts, ...]
    mean_dn: float
    dose_j_per_cm2: float


def light_case(spec: InstrumentSpec) -> LightCase:
    """Return a burst of the largest of NUMBERS, exposed with the lamp on throughout; SpecError as `World`."""
    world = World(spec, VirtualClock())
    exposure_s = spec.camera.exposure_s
    lamp = Illumination(spec.light.colour)
    world.present_eye("OD")
    frames = lit_frames(world, max(NUMBERS))
    mean_dn = float(frames[0].mean(dtype=np.float64)) - spec.camera.black_dn
    return LightCase(frames, mean_dn, hazard_of(spec).dose_j_per_cm2(lamp, exposure_s))


def measure_light(
    case: LightCase,
    instrument: Reconstructor,
    planner: Planner,
    clock: Clock,
    truth: Image,
    judge: PictureScorer,
    progress: ProgressCallback,
) -> tuple[LightPoint, ...]:
    """Return what the instrument makes of bursts of NUMBERS frames; `judge` scores a picture.

    The time is the median of REPEATS, with that of the refraction.
    """
    burst = BurstReconstructor(instrument, planner)
    found = []
    for n in NUMBERS:
        seconds = []
        for _ in range(REPEATS):
            begin_s = clock.now_s()
            (last,) = deque(burst.steps(case.frames[:n], simulated=True), maxlen=1)
            seconds.append(clock.now_s() - begin_s)
            assert isinstance(last, Reconstruction)
            made = last
        scores = judge(made.picture)
        bound = linear_bound(instrument.calibration, case.mean_dn, n, truth)
        used = sum(frame.used for frame in made.report.frames) if n > 1 else 1
        point = LightPoint(
            n,
            used,
            n * case.dose_j_per_cm2,
            float(np.median(seconds)),
            scores.pcc,
            scores.psnr_db,
            scores.ssim,
            scores.highpass_pcc,
            scores.vessel_contrast,
            judge(bound).psnr_db,
        )
        progress(f"{point.length}: {point.psnr_db:.2f} dB, linear bound {point.bound_psnr_db:.2f} dB")
        found.append(point)
    return tuple(found)


def measure_presses(
    case: LightCase,
    instrument: Reconstructor,
    planner: Planner,
    clock: Clock,
    judge: PictureScorer,
    progress: ProgressCallback,
) -> tuple[tuple[PressPoint, ...], Image]:
    """Return what a press makes of its lit frames within each time budget, and the last picture; `judge` scores it.

    As in a press, a burst is joined before the time begins, beside the exposure in red; a single frame is prepared
    within the time.
    """
    burst = BurstReconstructor(instrument, planner)
    found = []
    for choice, budget_s in PACES_S.items():
        alone = is_of_one_frame(budget_s)
        frames = case.frames[: 1 if alone else FRAMES]
        seconds = []
        for _ in range(REPEATS):
            prepared = {} if alone else {k: burst.prepare(frame, refract=k == 0) for k, frame in enumerate(frames)}
            joined = None if alone else burst.join(frames, None, {}, prepared)
            begin_s = clock.now_s()
            steps = burst.steps(
                frames,
                simulated=True,
                deadline=Deadline.after(clock, budget_s),
                prepared=prepared or {0: burst.prepare(frames[0], alone=True)},
                joined=joined,
                eye_psf=EyePsf.STORED if alone else EyePsf.ESTIMATED,
            )
            (last,) = deque(steps, maxlen=1)
            seconds.append(clock.now_s() - begin_s)
            assert isinstance(last, Reconstruction)
            made = last
        scores = judge(made.picture)
        point = PressPoint(
            choice,
            budget_s,
            len(frames),
            made.report.method,
            made.report.bin,
            made.report.rounds,
            float(np.median(seconds)),
            max(seconds) <= budget_s,
            **asdict(scores),
        )
        progress(f"a press within {budget_s:g} s: {point.psnr_db:.2f} dB in {point.seconds_median:.2f} s")
        found.append(point)
    return tuple(found), made.picture


def linear_bound(calibration: Calibration, mean_dn: float, n: int, truth: Image) -> Image:
    """Return the Wiener solution (rows, cols) with the object's own radial power, noise and even part known.

    The frame is that of a still `truth` (rows, cols) behind exactly the calibrated PSF, periodic, with `n` frames of a
    mean of `mean_dn` above dark.
    """
    shape = (truth.shape[0], truth.shape[1])
    sensor = calibration.sensor
    field = disc(shape, ((shape[0] - 1) / 2, (shape[1] - 1) / 2), field_radius_px(calibration))
    otf = fft.rfft2(fft.ifftshift(crop_or_pad(calibration.psfs[0].pixels, shape)))
    seen = np.where(np.isfinite(truth), truth, 0) * field
    seen *= np.float32(mean_dn / max(float(seen.mean()), 1e-30))
    detail = seen - field * np.float32(seen.sum(dtype=np.float64) / field.sum(dtype=np.float64))
    power = _ring_mean(np.abs(fft.rfft2(detail)) ** 2, shape)
    gain = sensor.gain_e_per_dn or 1.0
    read_e = sensor.read_noise_e or 0.0
    blurred = np.maximum(fft.irfft2(otf * fft.rfft2(seen), shape), 0)
    variance_dn2 = (blurred / gain + (read_e / gain) ** 2) / n
    noise = np.random.default_rng(n).standard_normal(shape) * np.sqrt(variance_dn2)
    spectrum = otf * fft.rfft2(detail) + fft.rfft2(noise)
    noise_power = float(variance_dn2.sum(dtype=np.float64))
    solved = fft.irfft2(np.conj(otf) * spectrum / (np.abs(otf) ** 2 + noise_power / np.maximum(power, 1e-30)), shape)
    return np.asarray((solved + seen - detail) * field, np.float32)


def _ring_mean(power: Image, shape: Sequence[int]) -> Image:
    """Return each value of a half spectrum replaced by the mean over frequencies of its radius."""
    radius = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None])
    ring = np.round(radius * max(shape)).astype(np.int64)
    total = np.bincount(ring.ravel(), power.ravel().astype(np.float64))
    count = np.bincount(ring.ravel())
    return np.asarray((total / np.maximum(count, 1))[ring], np.float32)
