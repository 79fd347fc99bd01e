"""`make bench-refraction DATA=folder`: refraction and field edge from textbook frames, against the acceptance lines.

Frames of photographs behind the textbook optics (`tests/textbook`), M from -6 to 6 dpt, full and a fifth of the light.
For half of them the calibrated edge is not the true one: its diameter is 0.2 deg too large or 0.1 deg too small, or the
true edge is 0.1 deg off centre, or soft over 0.3 to 2 deg. Each frame goes through the `Reconstructor` of `diffuscope
reconstruct`, and its report is scored. `picture` measures what the PSF with the cylinder gains, `bursts` the refraction
of several frames and its scatter between them, `time` the processor time of the estimates.
Exit status 1 if a line fails.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image as Photograph

from device.clock import SystemClock
from device.recon.estimation.refraction.estimator import Refraction, RefractionEstimator
from device.recon.model.fft_plans import Planner
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor
from device.values import Calibration, Geometry, Image, Psf, Reconstruction, Sensor
from tests.textbook.fundus_frame import Camera, Counts, FieldEdge, blurred, degrees, photographed
from tests.textbook.propagation import Optics, Plane, Prescription, caustic, diffuser

PHOTOGRAPHS = (
    "skimage/retina.jpg",
    "hrf/images/06_dr.JPG",
    "hrf/images/07_h.jpg",
    "hrf/images/09_g.jpg",
    "chase/Image_01L.jpg",
    "chase/Image_05R.jpg",
    "chase/Image_11L.jpg",
)
IMX296 = Camera((1088, 1456), 10000.0, 2.2, 10, 60.0)
QUANTALUX = Camera((1080, 1920), 23000.0, 1.0, 12, 64.0)
PITCH_UM = {IMX296: 3.45, QUANTALUX: 5.04}
PSF_FRAMES = 16
PLANNER = Planner(None, effort="FFTW_ESTIMATE")
PEAK = 0.85  # of the full well


@dataclass(frozen=True)
class Case:
    """One frame: sensor, calibrated field in degrees, true edge, eye, light as a share of the usual, and seed."""

    camera: Camera
    field_deg: float
    edge: FieldEdge
    eye: tuple[float, ...]  # M, J0, J45 of the correcting lens, dpt
    photo: str
    light: float
    seed: int
    zoom: float = 1.0
    turn_deg: float = 0.0

    @property
    def edge_kind(self) -> str:
        """Deviation of the calibrated edge from the true one: of its diameter, or the kind."""
        edge = self.edge
        if edge.width_deg > 0:
            return "soft"
        if edge.diameter_deg != self.field_deg:
            return f"{self.field_deg - edge.diameter_deg:+.1f} deg"
        return "off centre" if edge.right_deg or edge.down_deg else "exact"


def cases(
    camera: Camera, field_deg: float, count: int, seed: int, cylinder_dpt: float = 0.0, name: str = ""
) -> Iterator[Case]:
    """Yield `count` cases, every second with an edge that deviates from the calibration."""
    rng = np.random.default_rng((seed, *name.encode(), camera.bits, round(10 * field_deg), round(10 * cylinder_dpt)))
    for k in range(count):
        deviations = (
            FieldEdge(field_deg - 0.2),
            FieldEdge(field_deg + 0.1),
            off_centre(field_deg, rng),
            FieldEdge(field_deg, width_deg=float(rng.uniform(0.3, 2))),
        )
        turned = bool(rng.integers(2))  # the photograph's own round border is outside the field, or on it
        yield Case(
            camera,
            field_deg,
            FieldEdge(field_deg) if k % 2 else deviations[k // 2 % 4],
            (float(rng.uniform(-6, 6)), *(float(j) for j in rng.uniform(-cylinder_dpt, cylinder_dpt, 2))),
            PHOTOGRAPHS[int(rng.integers(len(PHOTOGRAPHS)))],
            1.0 if rng.random() < 2 / 3 else 0.2,
            int(rng.integers(2**31)),
            float(rng.uniform(1.15, 1.6)) if turned else 1.0,
            float(rng.uniform(0, 360)) if turned else 0.0,
        )


def off_centre(field_deg: float, rng: np.random.Generator) -> FieldEdge:
    """Return an edge 0.1 deg off centre in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return FieldEdge(field_deg, float(0.1 * np.cos(angle)), float(0.1 * np.sin(angle)))


@cache
def surface(pitch_um: float, head: int) -> Plane:
    """Return the diffuser of one head."""
    return diffuser(Optics(pitch_um), 1280 if pitch_um < 4 else 960, head)


@cache
def measured_psf(pitch_um: float, head: int) -> Psf:
    """Return the PSF as calibrated: the mean of PSF_FRAMES noisy frames of a point source with a peak of 8000 e-."""
    light, rng = caustic(Optics(pitch_um), surface(pitch_um, head), Prescription()), np.random.default_rng(head)
    electrons = light / light.max() * 8000 * PSF_FRAMES
    noisy = rng.poisson(np.maximum(electrons, 0)) + rng.normal(0, 2 * PSF_FRAMES**0.5, light.shape)
    return Psf((noisy / noisy.sum()).astype(np.float32))


@cache
def photograph(path: Path) -> Plane:
    """Return the green channel of a photograph, 0 to 1, cut to the square around its lit circle."""
    green = np.asarray(Photograph.open(path), np.float64)[..., 1] / 255
    lit = green > 0.08
    rows, cols = np.flatnonzero(lit.mean(axis=1) > 0.02), np.flatnonzero(lit.mean(axis=0) > 0.02)
    side = int(cols[-1] - cols[0] + 1)
    middle = ((rows[0] + rows[-1]) // 2, (cols[0] + cols[-1]) // 2)
    padded = np.pad(green, side)
    r, c = middle[0] + side, middle[1] + side
    return padded[r - side // 2 : r + side // 2, c - side // 2 : c + side // 2]


@dataclass(frozen=True)
class Scored:
    """A case and what the report says: errors and sds of M, J0, J45 in dpt; NaN and the reason if it was refused."""

    case: Case
    errors_dpt: tuple[float, ...]
    sds_dpt: tuple[float, ...]
    refused: str | None

    @property
    def line(self) -> str:
        """One line of text."""
        case, edge = self.case, self.case.edge
        found = self.refused or " ".join(
            f"{error:+.2f}({sd:.2f})" for error, sd in zip(self.errors_dpt, self.sds_dpt, strict=True)
        )
        return (
            f"{case.camera.bits} bit {case.field_deg:g} deg {case.photo[-14:]:>14} zoom {case.zoom:.2f} "
            f"light {case.light:g} eye {' '.join(f'{value:+.1f}' for value in case.eye)} edge "
            f"{edge.diameter_deg - case.field_deg:+.1f} {edge.right_deg:+.2f} {edge.down_deg:+.2f} "
            f"{edge.width_deg:.1f}: {found}"
        )


def score(case: Case, data: Path) -> Scored:
    """Return the score of one frame."""
    retina, right_deg, down_deg = scene_of(case, data)
    counts = expose(case, retina * case.edge.light(right_deg, down_deg))
    return scored(case, counts, calibrated(case.camera, case.field_deg, head_of(case)))


def scored(case: Case, counts: Counts, reconstruct: Reconstructor) -> Scored:
    """Return the score of counts that a reconstructor is given."""
    report = reconstruct(counts).report.refraction_dpt
    assert report is not None
    refused = report["refused"]
    if isinstance(refused, str):
        return Scored(case, (np.nan,) * 3, (np.nan,) * 3, refused)
    numbers = {name: float(value) for name, value in report.items() if isinstance(value, float)}
    names = ("sphere", "j0", "j45")
    errors = tuple(numbers[name] - true for name, true in zip(names, case.eye, strict=True))
    return Scored(case, errors, (numbers["sd"], numbers["j0_sd"], numbers["j45_sd"]), None)


def interval_score(error: Plane, sd: Plane, alpha: float = 0.05) -> float:
    """Return the mean interval score (Gneiting and Raftery 2007) of the central 95 % intervals, dpt; small is good."""
    half = 1.96 * sd
    return float(np.mean(2 * half + 2 / alpha * np.maximum(np.abs(error) - half, 0)))


@dataclass(frozen=True)
class Limits:
    """Acceptance lines of one group: largest RMS error and median sd, dpt."""

    rms_dpt: float
    sd_dpt: float


def summarise(title: str, scored: list[Scored], k: int, limits: Limits) -> bool:
    """Print the figures of one component of one group beside its lines; return True if all hold."""
    known = [result for result in scored if result.refused is None]
    error, sd = (
        np.array([values[k] for values in column])
        for column in ([result.errors_dpt for result in known], [result.sds_dpt for result in known])
    )
    z = np.abs(error / sd)
    rms, median_sd, refused = float(np.sqrt(np.mean(error**2))), float(np.median(sd)), 1 - len(known) / len(scored)
    within, near = float(np.mean(z < 2)), float(np.mean(z < 1))
    holds = (
        rms <= limits.rms_dpt
        and median_sd <= limits.sd_dpt
        and refused <= 0.1
        and 0.93 <= within <= 0.99
        and 0.62 <= near <= 0.76
    )
    print(
        f"{'ok  ' if holds else 'MISS'} {title}: {len(scored)} frames, RMS {rms:.3f} (at most {limits.rms_dpt:g}), "
        f"mean {error.mean():+.3f}, below 2 sd {within:.0%} (93 to 99), below 1 sd {near:.0%} (62 to 76), "
        f"refused {refused:.0%} (at most 10), median sd {median_sd:.3f} (at most {limits.sd_dpt:g}), "
        f"rms z {float(np.sqrt(np.mean(z**2))):.2f}, beyond 3 sd {int((z > 3).sum())}, "
        f"interval score {interval_score(error, sd):.2f} dpt",
        flush=True,
    )
    return holds


def tabulate(scored: list[Scored]) -> None:
    """Print a Markdown table of the error of M and its coverage by light, field edge and object of one group."""
    cells: dict[tuple[str, str], list[Scored]] = {}
    for result in scored:
        case = result.case
        for key in (("light", f"{case.light:g}"), ("edge", case.edge_kind), ("object", case.photo)):
            cells.setdefault(key, []).append(result)
    print("| by | value | frames | refused | RMS M, dpt | below 1 sd | below 2 sd |\n|---|---|---|---|---|---|---|")
    for (by, value), results in sorted(cells.items()):
        known = [result for result in results if result.refused is None]
        error, sd = (
            np.array([column[0] for column in columns])
            for columns in ([result.errors_dpt for result in known], [result.sds_dpt for result in known])
        )
        shares = [f"{np.mean(np.abs(error) < k * sd):.0%}" if known else "-" for k in (1, 2)]
        rms = f"{np.sqrt(np.mean(error**2)):.3f}" if known else "-"
        print(
            f"| {by} | {value} | {len(results)} | {len(results) - len(known)} | {rms} | {' | '.join(shares)} |",
            flush=True,
        )


@dataclass(frozen=True)
class Group:
    """Frames of one sensor and field, with cylinders of up to `cylinder_dpt` in J0 and J45, and their lines."""

    camera: Camera
    field_deg: float
    cylinder_dpt: float
    limits: tuple[Limits, ...]


GROUPS = {
    "imx296-33": Group(IMX296, 33.4, 0.0, (Limits(0.15, 0.12),)),
    "imx296-45": Group(IMX296, 45.0, 0.0, (Limits(0.2, 0.18),)),
    "paper-33": Group(QUANTALUX, 33.4, 0.0, (Limits(0.08, 0.12),)),
    "paper-48": Group(QUANTALUX, 48.3, 0.0, (Limits(0.08, 0.12),)),
    "imx296-33-cylinder": Group(IMX296, 33.4, 1.5, (Limits(0.2, 0.2), Limits(0.15, 0.2), Limits(0.1, 0.2))),
    "paper-33-cylinder": Group(QUANTALUX, 33.4, 1.5, (Limits(0.08, 0.2), Limits(0.08, 0.2), Limits(0.08, 0.2))),
}


def head_of(case: Case) -> int:
    """Return the seed of the diffuser of a case, 1 to 4."""
    return int(np.random.default_rng(case.seed).integers(1, 5))


@cache
def calibrated(camera: Camera, field_deg: float, head: int) -> Reconstructor:
    """Return the reconstructor of `diffuscope reconstruct` for a head."""
    return Reconstructor(calibration_of(camera, field_deg, head), camera.shape, PLANNER, SystemClock(), timed=False)


def calibration_of(camera: Camera, field_deg: float, head: int) -> Calibration:
    """Return the calibration of a head with this camera and field."""
    optics = Optics(PITCH_UM[camera])
    sensor = Sensor(camera.black_dn, camera.gain_e_per_dn, camera.read_noise_e, 2.0**camera.bits - 1)
    geometry = Geometry(optics.pitch_um, optics.distance_um, optics.magnification)
    return Calibration((measured_psf(optics.pitch_um, head),), sensor, geometry, field_deg)


def scene_of(case: Case, data: Path, shift_deg: tuple[float, float] = (0.0, 0.0)) -> tuple[Plane, Plane, Plane]:
    """Return the retina of a case without its edge, and the field angles (right, down) in degrees."""
    optics = Optics(PITCH_UM[case.camera])
    reach_deg = case.edge.diameter_deg + case.edge.width_deg + 3
    right_deg, down_deg = degrees(optics, round(reach_deg * optics.px_per_deg / 2) * 2)
    zoom = case.zoom * case.field_deg / float(np.ptp(right_deg))
    place = data / "fundus" / case.photo
    return photographed(photograph(place), right_deg, down_deg, zoom, case.turn_deg, shift_deg), right_deg, down_deg


def expose(case: Case, scene: Plane, exposure: float = PEAK, number: int = 1) -> Counts:
    """Return the counts of a lit scene; its brightest pixel has `exposure` of the full well, times the case's light.

    `number`: that of the frame, which selects its noise.
    """
    optics = Optics(PITCH_UM[case.camera])
    psf = caustic(optics, surface(optics.pitch_um, head_of(case)), Prescription.of_power_vector(*case.eye))
    light = blurred(scene, psf, case.camera.shape)
    electrons = light / max(float(light.max()), 1e-9) * exposure * case.camera.full_well_e * case.light
    return case.camera.read(electrons, np.random.default_rng((case.seed, number)))


def faults(seed: int, count: int, data: Path) -> Iterator[tuple[str, Scored]]:
    """Yield the scores of frames that must be refused or carry their error, by kind, `count` of each."""
    for k, case in enumerate(cases(IMX296, 33.4, count, seed, name="faults")):
        case = replace(case, edge=FieldEdge(33.4), light=1.0)
        retina, right_deg, down_deg = scene_of(case, data)
        field, radius_deg = case.edge.light(right_deg, down_deg), np.hypot(right_deg, down_deg)
        second = FieldEdge(12.0, 10.0, 0.0).light(right_deg, down_deg)
        ring = np.exp(-(((radius_deg - 12) / 0.2) ** 2))
        oval = FieldEdge(33.4).light(right_deg, down_deg * 1.03)
        decentred = FieldEdge(33.4, 1.0, 0.0).light(right_deg, down_deg)
        whole = np.ones_like(field)
        head = head_of(case)
        own = calibrated(IMX296, 33.4, head)
        scenes = {
            "uniform field": field,
            "empty disc": field * 1e-3 + 1,
            "open scene, no edge": retina * whole,
            "half a lid": retina * field * np.where(down_deg < 0, 0.08, 1.0),
            "two discs": retina * (field + second),
            "stray ring": retina * field + 0.5 * ring,
            "elliptical edge": retina * oval,
            "disc 1 deg off": retina * decentred,
        }
        for kind, scene in scenes.items():
            yield kind, scored(case, expose(case, scene), own)
        lit = retina * field
        yield "saturated edge", scored(case, expose(case, lit, 1.5), own)
        yield "1/50 of the light", scored(case, expose(replace(case, light=0.02), lit), own)
        yield "PSF of another head", scored(case, expose(case, lit), calibrated(IMX296, 33.4, head % 4 + 1))
        wrong_deg = 33.4 * (1.2 if k % 2 else 0.8)
        yield "field wrong by 20 %", scored(case, expose(case, lit), calibrated(IMX296, wrong_deg, head))


def judge_faults(seed: int, count: int, data: Path) -> bool:
    """Print each frame that must be refused or carry its error; return True if the lines hold."""
    z: list[float] = []
    refused = 0
    for kind, result in faults(seed, count, data):
        refused += result.refused is not None
        if result.refused is None:
            z.append(abs(result.errors_dpt[0] / result.sds_dpt[0]))
        print(f"{kind}: {result.line}", flush=True)
    beyond = [sum(value > limit for value in z) for limit in (3, 4)]
    holds = beyond[0] <= 1 and beyond[1] == 0
    print(
        f"{'ok  ' if holds else 'MISS'} faults: {len(z) + refused} frames, {refused} refused, {beyond[0]} beyond 3 sd "
        f"(at most 1), {beyond[1]} beyond 4 sd (none)",
        flush=True,
    )
    return holds


CYLINDERS_DPT = (0.0, -1.0, -2.0, -4.0)
MIN_GAIN_DB = 0.1  # mean, by a cylinder of -2 dpt


def astigmatic_cases(camera: Camera, field_deg: float, seed: int) -> Iterator[Case]:
    """Yield one case for each photograph, cylinder and light: exact edge, M from -4 to 4 dpt, any axis."""
    rng = np.random.default_rng((seed, camera.bits, round(10 * field_deg)))
    for photo in PHOTOGRAPHS[:4]:
        for cylinder_dpt in CYLINDERS_DPT:
            for light in (1.0, 0.2):
                turn, m_dpt = 2 * rng.uniform(0, np.pi), float(rng.uniform(-4, 4))
                j0_dpt, j45_dpt = (-cylinder_dpt / 2 * float(part) for part in (np.cos(turn), np.sin(turn)))
                eye = (m_dpt, j0_dpt, j45_dpt)
                yield Case(camera, field_deg, FieldEdge(field_deg), eye, photo, light, int(rng.integers(2**31)))


def psnr_db(case: Case, picture: Image, truth: Plane) -> float:
    """Return the PSNR of a picture without the outer 0.7 degrees of its field, after the best scale and offset."""
    shape = case.camera.shape
    radius_px = (case.field_deg / 2 - 0.7) * Optics(PITCH_UM[case.camera]).px_per_deg
    inside = disc(shape, ((shape[0] - 1) / 2, (shape[1] - 1) / 2), radius_px) > 0.5
    true = blurred(truth, np.pad(np.ones((1, 1)), 1), shape)[inside]
    columns = np.stack([picture[inside].astype(np.float64), np.ones(true.size)], axis=1)
    error = columns @ np.linalg.lstsq(columns, true, rcond=None)[0] - true
    return float(10 * np.log10(true.max() ** 2 / np.mean(error**2)))


def picture_gain(case: Case, data: Path) -> tuple[float, float | None]:
    """Return the gain of the picture in dB by the cylinder, and the predicted one; None if the PSF has no cylinder."""
    retina, right_deg, down_deg = scene_of(case, data)
    scene = retina * case.edge.light(right_deg, down_deg)
    counts, own = expose(case, scene), calibrated(case.camera, case.field_deg, head_of(case))
    made = own(counts)
    *_, without = own.steps(counts, refraction=own.begin_refraction(counts, with_cylinder=False))
    assert isinstance(without, Reconstruction)
    stated = made.report.psf_cylinder
    gain_db = psnr_db(case, made.picture, scene) - psnr_db(case, without.picture, scene)
    return gain_db, None if stated is None else stated["gain_db"]


def judge_pictures(seed: int, data: Path) -> bool:
    """Print the gain by the cylinder for each sensor, cylinder and light; return True if the mean at -2 dpt holds."""
    gains_db: list[float] = []
    for camera, field_deg in ((IMX296, 33.4), (IMX296, 45.0), (QUANTALUX, 33.4)):
        found: dict[tuple[float, float], list[tuple[float, float | None]]] = {}
        for case in astigmatic_cases(camera, field_deg, seed):
            cylinder_dpt = -2 * float(np.hypot(*case.eye[1:]))
            found.setdefault((round(cylinder_dpt, 1), case.light), []).append(picture_gain(case, data))
        for (cylinder_dpt, light), pairs in found.items():
            measured, predicted = (
                " ".join("   -" if gain_db is None else f"{gain_db:+.2f}" for gain_db in part)
                for part in zip(*pairs, strict=True)
            )
            print(
                f"{camera.bits} bit {field_deg:g} deg, cylinder {cylinder_dpt:+.0f} dpt, light {light:g}: gain "
                f"{measured} dB, predicted {predicted}",
                flush=True,
            )
            gains_db += [gain for gain, _ in pairs if cylinder_dpt == CYLINDERS_DPT[2]]
    mean_db = float(np.mean(gains_db))
    holds = mean_db >= MIN_GAIN_DB
    print(f"{'ok  ' if holds else 'MISS'} picture: mean gain {mean_db:+.2f} dB at {CYLINDERS_DPT[2]:g} dpt", flush=True)
    return holds


BURST = 4  # frames
DRIFT_DEG, ACCOMMODATION_DPT = 0.15, 0.3  # sd of each frame
CHI2_OF_ONE_PERCENT = 11.34  # of BURST - 1 degrees of freedom
MAX_ALARMS = 0.1  # share of the bursts of an eye that does not accommodate


def burst_of(case: Case, data: Path, accommodation_dpt: float) -> tuple[list[Counts], Plane]:
    """Return the frames of a moving eye and their true M in dpt; M of each has this sd around that of the case."""
    rng = np.random.default_rng((case.seed, 2))
    frames, spheres_dpt = [], case.eye[0] + accommodation_dpt * rng.standard_normal(BURST)
    for k, sphere_dpt in enumerate(spheres_dpt):
        right, down = DRIFT_DEG * rng.standard_normal(2)
        retina, right_deg, down_deg = scene_of(case, data, (float(right), float(down)))
        moved = replace(case, eye=(float(sphere_dpt), *case.eye[1:]))
        frames.append(expose(moved, retina * case.edge.light(right_deg, down_deg), number=k + 3))
    return frames, spheres_dpt


def judge_bursts(seed: int, count: int, data: Path) -> bool:
    """Print errors of M of the first frame and of the burst, and the scatter, of `count` bursts of each sensor.

    Return True if chi^2 is above its 99th percentile in at most MAX_ALARMS of the bursts without accommodation.
    """
    alarms: list[bool] = []
    for name in ("imx296-33", "imx296-45", "paper-33"):
        group = GROUPS[name]
        for case in list(cases(group.camera, group.field_deg, 2 * count, seed, 0.5, name="burst"))[1::2]:
            for accommodation_dpt in (0.0, ACCOMMODATION_DPT):
                frames, spheres_dpt = burst_of(case, data, accommodation_dpt)
                estimator = calibrated(case.camera, case.field_deg, head_of(case)).refractor
                assert estimator is not None
                found = estimator.find(frames[0])
                first = estimator.add_cylinder(found) if isinstance(found, Refraction) else found
                whole = estimator.join(first, frames, None) if isinstance(first, Refraction) else first
                if not (isinstance(first, Refraction) and isinstance(whole, Refraction) and whole.scatter is not None):
                    print(f"{name} light {case.light:g}: refused", flush=True)
                    continue
                if accommodation_dpt == 0:
                    alarms.append(whole.scatter.chi2 > CHI2_OF_ONE_PERCENT)
                print(
                    f"{name} light {case.light:g}: error of the first {-first.m_dpt - spheres_dpt[0]:+.3f} (sd "
                    f"{first.sd_dpt:.3f}), of the burst {-whole.m_dpt - spheres_dpt.mean():+.3f} (sd "
                    f"{whole.sd_dpt:.3f}) dpt; scatter true {np.std(spheres_dpt, ddof=1):.3f}, found "
                    f"{whole.scatter.sd_dpt:.3f} dpt, chi2 {whole.scatter.chi2:.1f}",
                    flush=True,
                )
    share = float(np.mean(alarms))
    holds = share <= MAX_ALARMS
    print(
        f"{'ok  ' if holds else 'MISS'} bursts: {len(alarms)} of one M, {share:.0%} beyond chi2 (at most 10)",
        flush=True,
    )
    return holds


REPEATS = 5
MAX_CYLINDER_RATIO = 3.0


def processor_s(act: Callable[[], object]) -> float:
    """Return the median processor time of a call, of all threads of this process."""
    times = []
    for _ in range(REPEATS):
        begin_s = time.process_time()
        act()
        times.append(time.process_time() - begin_s)
    return float(np.median(times))


def times_s(case: Case, planner: Planner, data: Path) -> tuple[float, float, float, float]:
    """Return the processor times of a planned FFT pair of the sensor, M with edge, cylinder, and a frame of a burst."""
    retina, right_deg, down_deg = scene_of(case, data)
    counts = expose(case, retina * case.edge.light(right_deg, down_deg))
    calibration = calibration_of(case.camera, case.field_deg, head_of(case))
    estimator, pair = RefractionEstimator(calibration, case.camera.shape, planner, 0), planner.plan(case.camera.shape)
    found = estimator.find(counts)
    assert isinstance(found, Refraction), found.reason
    whole = estimator.add_cylinder(found)  # compiles
    assert isinstance(whole, Refraction), whole.reason
    return (
        processor_s(lambda: (pair.forward(), pair.inverse())),
        processor_s(lambda: estimator.find(counts)),
        processor_s(lambda: estimator.add_cylinder(found)),
        processor_s(lambda: estimator.join(whole, [counts] * BURST, None)) / BURST,
    )


def judge_times(seed: int, data: Path) -> bool:
    """Print the processor time of M with edge and of the cylinder beside that of a planned full-size FFT pair.

    Return True if the cylinder takes at most three times M.
    """
    holds, planner = True, Planner(None)
    for name, group in GROUPS.items():
        if group.cylinder_dpt:
            continue
        for case in list(cases(group.camera, group.field_deg, 4, seed, 1.0, name="time"))[1::2]:
            pair_s, m_s, cylinder_s, frame_s = times_s(case, planner, data)
            is_fast = cylinder_s <= MAX_CYLINDER_RATIO * m_s
            holds &= is_fast
            print(
                f"{'ok  ' if is_fast else 'MISS'} {name} {case.photo[-14:]} light {case.light:g}: pair {pair_s:.3f} s, "
                f"M with edge {m_s:.3f} s ({m_s / pair_s:.1f} pairs), cylinder {cylinder_s:.3f} s "
                f"({cylinder_s / pair_s:.1f} pairs, {cylinder_s / m_s:.1f} of M; at most {MAX_CYLINDER_RATIO:g}), a "
                f"frame of a burst {frame_s:.3f} s",
                flush=True,
            )
    return holds


def main() -> None:
    """Score the groups; exit status 1 if a line fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with fundus/")
    parser.add_argument("--frames", type=int, default=60, help="frames of each group")
    parser.add_argument("--seed", type=int, default=1)
    others: dict[str, Callable[[], bool]] = {
        "faults": lambda: judge_faults(arguments.seed, max(arguments.frames // 12, 1), arguments.data),
        "picture": lambda: judge_pictures(arguments.seed, arguments.data),
        "bursts": lambda: judge_bursts(arguments.seed, max(arguments.frames // 12, 1), arguments.data),
        "time": lambda: judge_times(arguments.seed, arguments.data),
    }
    parser.add_argument("--only", nargs="*", choices=[*GROUPS, *others], default=[*GROUPS, *others])
    arguments = parser.parse_args()
    held = []
    for name in arguments.only:
        if name in others:
            held.append(others[name]())
            continue
        group, found = GROUPS[name], []
        for case in cases(group.camera, group.field_deg, arguments.frames, arguments.seed, group.cylinder_dpt):
            found.append(score(case, arguments.data))
            print(found[-1].line, flush=True)
        tabulate(found)
        for k, limits in enumerate(group.limits):
            held.append(summarise(f"{name} {('M', 'J0', 'J45')[k]}", found, k, limits))
    raise SystemExit(0 if all(held) else 1)


if __name__ == "__main__":
    main()
