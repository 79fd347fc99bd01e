"""S12: what no experiment wants and every instrument meets, and the bounds that the paper's solution keeps."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import fft

from device.recon.closed import TIKHONOV, ClosedForm
from device.recon.model import Model, periodic_model
from device.recon.prepare import Linear
from device.spec import CameraSpec
from device.values import Counts, Image, Psf
from services.instrument.hard_cases import defects
from services.instrument.paper.bench import Bench, Take
from services.instrument.paper.outcome import Claim, Experiment, Outcome, Sheet, above, below, within
from services.instrument.paper.pictures import plane

MU = 1e-4
SHIFT_PX = (3, -5)
EPSILON = 2.0**-24
BRIGHT_E = 24200.0  # of a well of 23 ke-: about 1.2 % of the pixels are full
BELIEVED, STRAY = "saturated, believed", "20 % even stray light"
LIMITS = {STRAY: 0.05, "PSF with 0.6 % background": 0.005, "PSF with 5.7 % background": 0.05}  # PCC; others 0.02
PEDESTALS = (0.006, 0.057)  # of a PSF's light, as an even background


class Paper:
    """The paper's closed form on the PSF of a take, one weight: what the bounds are about."""

    def __init__(self, bench: Bench, take: Take, psf: Psf | None = None) -> None:
        calibration = replace(take.calibration, field_deg=None)
        if psf is not None:
            calibration = replace(calibration, psfs=(psf,))
        self.model: Model = periodic_model(calibration, take.shape, take.samples_px, bench.planner, 0)
        self.model.fade = None
        self.solver = ClosedForm(self.model, TIKHONOV, MU)

    def __call__(self, y: Image) -> Image:
        """The solution for a linear frame on the samples."""
        out = np.zeros(self.model.grid.shape, np.float32)
        self.solver.start(Linear(y, np.ones_like(y), float(y.mean()), 0.0, 0.0))
        self.solver.finish(out)
        return out

    @property
    def gain(self) -> np.ndarray:
        """|F| over the whole plane of frequencies, from the PSF in double precision."""
        return np.asarray(np.abs(self._filter()))

    @property
    def loudest(self) -> Image:
        """A frame of the one frequency that is made largest: where |H|^2 is nearest to mu."""
        spectrum = np.zeros(self.model.otf.shape, np.complex64)
        inner = np.abs(self.model.otf[:, 1:-1]) ** 2
        row, col = np.unravel_index(int(np.argmin(np.abs(np.log(inner / MU)))), inner.shape)
        spectrum[row, col + 1] = 1
        return np.asarray(fft.irfft2(spectrum, self.model.grid.shape) * spectrum.size, np.float32)

    def exact(self, y: Image) -> np.ndarray:
        """The same solution in double precision."""
        cols = self.model.grid.shape[1]
        spectrum = fft.fft2(y.astype(np.float64)) * self._filter()
        return np.asarray(fft.ifft2(spectrum).real[:, :cols])

    def _filter(self) -> np.ndarray:
        half = self.model.otf.astype(np.complex128)
        rows, cols = self.model.grid.shape
        whole = fft.fft2(fft.irfft2(half, (rows, cols)))
        return np.asarray(np.conj(whole) / (np.abs(whole) ** 2 + MU))


def bounds(bench: Bench, take: Take) -> tuple[Claim, ...]:
    """The bounds of optics.md 5.4 that hold for every PSF."""
    paper, rng = Paper(bench, take), np.random.default_rng(12)
    y = take.raw
    x = paper(y)
    noise = rng.standard_normal(y.shape).astype(np.float32)
    spike = np.zeros_like(y)
    spike[y.shape[0] // 3, y.shape[1] // 3] = 1000
    worst = paper.loudest
    norm = np.linalg.norm
    gain = paper.gain
    rolled = Psf(np.roll(take.calibration.psfs[0].pixels, [take.samples_px * s for s in SHIFT_PX], (0, 1)))
    moved = np.roll(Paper(bench, take, rolled)(y), SHIFT_PX, (0, 1))
    bound = EPSILON / (2 * np.sqrt(MU))
    return (
        within("||x|| over its bound ||y|| / (2 sqrt mu), worst frame", _norm_ratio(paper, worst), 0.95, 1.0001, "", 4),
        below("the same for a retina", _norm_ratio(paper, y), 1.0),
        within("noise in the picture, measured over predicted", float(paper(noise).std() / _rms(gain)), 0.98, 1.02),
        within("one bad pixel's error, measured over predicted", float(norm(paper(spike)) / (1000 * _rms(gain))),
               0.999, 1.001, "", 4),
        below("a shifted PSF shifts the picture, and what else", float(norm(moved - x) / norm(x)), 1e-4, "", 6),
        below("single over double precision, of 4 bounds", float(norm(x - paper.exact(y)) / norm(y) / 4 / bound), 1.0),
    )  # fmt: skip


def _norm_ratio(paper: Paper, y: Image) -> float:
    return float(np.linalg.norm(paper(y)) * 2 * np.sqrt(MU) / np.linalg.norm(y))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def pedestal(take: Take, share: float) -> Take:
    """The take with an even background in its PSF."""
    pixels = take.calibration.psfs[0].pixels
    psf = Psf(pixels + np.float32(share / pixels.size))
    return Take(take.name, replace(take.staged, calibration=replace(take.calibration, psfs=(psf,))))


def gaps(clean: Take, camera: CameraSpec) -> dict[str, Take]:
    """The clean frame with contiguous gaps: dead columns and a blob, declared and not, and a clipped reflex."""
    counts = clean.staged.counts
    takes = {"a reflex, clipped in 0.3 % of the pixels": _with(clean, defects.glare(counts, camera, 0.003))}
    for name, where in (("12 dead columns", defects.dead_columns), ("a dead blob", defects.blob)):
        mask = where(clean.shape)
        dead = defects.read_as(counts, mask, 0)
        takes[f"{name}, declared"] = _with(clean, dead, bad=mask)
        takes[f"{name}, not declared"] = _with(clean, dead)
    takes["0.1 % warm pixels, not declared"] = _with(clean, defects.warm(counts, camera, 0.001, 1500 / 4095))
    return takes


def _with(take: Take, counts: Counts, **calibration: Any) -> Take:
    return Take(take.name, replace(take.staged, counts=counts, calibration=replace(take.calibration, **calibration)))


def run_hard(bench: Bench) -> Outcome:
    """Bad pixels, too much light, stray light, a background in the PSF, an empty frame: as shipped, and beside it."""
    bench.say("S12: bounds")
    clean = bench.take("paper_heine")
    claims = list(bounds(bench, clean))
    bench.say("S12: bad pixels, saturation, stray light")
    cases = _cases(bench, clean)
    solvers: dict[str, Callable[[Take], Image]] = {"the instrument's ladder": lambda take: bench.shipped(take)[0],
               "flat-sub": lambda take: bench.solve(take, "gradient"),
               "paper's solver": lambda take: bench.best(take)[1]}  # fmt: skip
    pictures = {name: {said: solve(take) for said, solve in solvers.items()} for name, take in cases.items()}
    pcc = {name: {said: cases[name].score(x).pcc for said, x in row.items()} for name, row in pictures.items()}
    ours = {name: row["the instrument's ladder"] for name, row in pcc.items()}
    claims += [
        below(f"PCC lost: {name}", ours["clean"] - ours[name], LIMITS.get(name, 0.02), "", 4)
        for name in cases if name not in ("clean", BELIEVED)
    ]  # fmt: skip
    claims += [
        above("PCC that believing saturated pixels costs", ours["clean"] - ours[BELIEVED], 0.05),
        below("brightest value of an empty frame's picture, DN", _of_nothing(bench, clean), 1e-3, "", 5),
    ]
    rows = tuple((name, *(f"{value:.3f}" for value in row.values())) for name, row in pcc.items())
    shown = tuple(
        plane(name, np.where(clean.inside, row["the instrument's ladder"], 0), clean.inside)
        for name, row in pictures.items()
    )
    return Outcome(tuple(claims), shown, (Sheet(("case, PCC", *solvers), rows),))


def _cases(bench: Bench, clean: Take) -> dict[str, Take]:
    hot = bench.take("paper_heine", {"sim.sensor.hot_pixels": 0.01})
    bright = bench.take("paper_heine", {"sim.peak_e": BRIGHT_E})
    sensor = replace(bright.calibration.sensor, white_dn=65535.0)
    return {
        "clean": clean, "1 % hot pixels, known": hot,
        "1 % hot pixels, not declared": _with(hot, hot.staged.counts, bad=None),
        "saturated, left out": bright, BELIEVED: _with(bright, bright.staged.counts, sensor=sensor),
        **gaps(clean, bench.scene("paper_heine").camera),
        STRAY: bench.take("paper_heine", {"sim.light.stray": 0.2}),
        "PSF with 0.6 % background": pedestal(clean, PEDESTALS[0]),
        "PSF with 5.7 % background": pedestal(clean, PEDESTALS[1]),
    }  # fmt: skip


def _of_nothing(bench: Bench, clean: Take) -> float:
    """An empty frame: counts at the black level and nothing else."""
    black = np.full(clean.shape, round(clean.calibration.sensor.black_dn), np.uint16)
    return float(np.abs(bench.shipped(_with(clean, black))[0]).max())


EXPERIMENTS = (
    Experiment(
        "S12", "Hard cases", "The bounds that a Tikhonov solution keeps, and frames that are bad in known ways.",
        "Not in the paper.", run_hard,
    ),
)  # fmt: skip
