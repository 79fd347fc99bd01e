"""Accuracy against time on this machine: every method, bin and number of rounds, and what the instrument would choose.

Times are of one frame in memory to its picture on the sensor's grid, plans already made. Every point is run once to be
scored, then all of them take turns, so that a neighbour's burst hits all alike; the median of the turns counts.
"""

import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyfftw

from device.clock import Clock, Deadline, SystemClock
from device.errors import FrameError, SettingError
from device.images import as_raw, read_image
from device.recon.geometry import disc
from device.recon.kernels import Pixels
from device.recon.methods import METHODS
from device.recon.metrics import FIT, RANGE, Judge, Scores, shift_px
from device.recon.model import field_radius_px
from device.recon.plan import Planner, processor
from device.recon.reconstructor import Recipe, Reconstructor, ladder
from device.sim.staged import staged
from device.spec import InstrumentSpec, load_head
from device.values import Calibration, Image, Mask, Reconstruction
from services.instrument.frontier_oracle import best_mus
from services.instrument.frontier_plot import drawn
from services.instrument.once import Order, calibrated, refuse_place, written

ROUNDS = (0, 1, 2, 4, 8, 12, 20)
MOST_BIN, LEAST_SAMPLES = 4, 48
RIM_PX = 2.0  # the field's soft rim belongs to neither side
HIGHPASS_DEG, HIGHPASS_PX = 2.0, 32.0
Say = Callable[[str], None]


@dataclass(frozen=True)
class Wish:
    """What was asked for on the command line: a scene, or a raw frame with its PSF and its truth."""

    scene: Path | None
    raw: Path | None
    psf: Path | None
    truth: Path | None
    head: Path | None
    field_deg: float | None
    json: Path
    plot: Path
    budget_s: float
    repeats: int
    plans: Path


@dataclass(frozen=True)
class Case:
    """One frame with its truth: all that is in memory before the clock starts.

    `registered`: the truth comes from elsewhere, and one shift brings all pictures onto it.
    """

    name: str
    counts: Pixels
    truth: Image
    vessels: Mask | None
    calibration: Calibration
    registered: bool

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.counts.shape[0], self.counts.shape[1]


@dataclass
class Point:
    """One way to make the picture, what it scores and how long it takes; `pareto`: nothing else dominates it."""

    method: str
    bin: int
    rounds: int
    seconds_median: float
    seconds_p95: float
    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None
    pareto: bool = False


def frontier(wish: Wish, say: Say) -> dict[str, Any]:
    """Measure, write the JSON and the plot, and return what the JSON says; `say` hears how far it is."""
    _refuse(wish)
    Deadline.after(SystemClock(), wish.budget_s)  # refuses what is not a time
    found = measured(_case(wish), wish.plans, wish.budget_s, wish.repeats, say)
    text = json.dumps(found, indent=1) + "\n"
    written(wish.json, lambda: wish.json.write_text(text, encoding="utf-8"))
    picture = drawn(found)
    written(wish.plot, lambda: wish.plot.write_text(picture, encoding="utf-8"))
    return found


def measured(case: Case, plans: Path, budget_s: float, repeats: int, say: Say) -> dict[str, Any]:
    """Every point of one case, what the instrument chooses within a budget, and all that a reader needs to know."""
    bench = _Bench(case, Planner(plans), SystemClock(), say)
    points, choice = bench.measure(budget_s, repeats)
    for point, on in zip(points, on_edge([(p.seconds_median, p.psnr_db) for p in points]), strict=True):
        point.pareto = on
    kept = {point.method for point in points if point.pareto}
    return {
        "machine": {"cpu": processor(), "cores": os.cpu_count(), "system": platform.platform(), "fft_threads": 1},
        "versions": _versions(),
        "scene": case.name,
        "simulated": case.calibration.simulated,
        "frame": {"rows": case.shape[0], "cols": case.shape[1]},
        "region": bench.region(),
        "timing": f"counts in memory to picture on the sensor grid, plans made; {repeats} interleaved repeats",
        "edge": "seconds_median against psnr_db",
        "points": [asdict(point) for point in points],
        "best_mu": bench.best_mus(),
        "budget_s": budget_s,
        "choice": choice,
        "dominated": [method for method in METHODS if method not in kept],
    }


def scene_case(spec: InstrumentSpec) -> Case:
    """One exposure of a simulated head, with its truth."""
    scene = staged(spec)
    return Case(spec.name, scene.counts, scene.truth, scene.vessels, scene.calibration, False)


def on_edge(places: Sequence[tuple[float, float]]) -> list[bool]:
    """Which (cost, worth) no other place dominates: none is at most as dear and at least as good, and better in one."""
    order = sorted(range(len(places)), key=lambda k: (places[k][0], -places[k][1]))
    on, best, at_s = [False] * len(places), -np.inf, -np.inf
    for k in order:
        cost, worth = places[k]
        on[k] = worth > best or (worth == best and cost == at_s)  # twins dominate each other not
        if worth > best:
            best, at_s = worth, cost
    return on


def table(found: dict[str, Any]) -> str:
    """The points from fast to slow as text; the edge is marked with a star."""
    lines = [f"{'':2}{'method':<10} {'bin':>3} {'rounds':>6} {'ms':>8} {'p95':>8} {'PSNR':>6} {'PCC':>6} {'SSIM':>6} "
             f"{'detail':>6} {'vessel':>6}"]  # fmt: skip
    for p in sorted(found["points"], key=lambda p: p["seconds_median"]):
        vessel = "-" if p["vessel_contrast"] is None else f"{p['vessel_contrast']:.3f}"
        lines.append(
            f"{'* ' if p['pareto'] else '  '}{p['method']:<10} {p['bin']:>3} {p['rounds']:>6} "
            f"{p['seconds_median'] * 1e3:>8.1f} {p['seconds_p95'] * 1e3:>8.1f} {p['psnr_db']:>6.2f} {p['pcc']:>6.3f} "
            f"{p['ssim']:>6.3f} {p['highpass_pcc']:>6.3f} {vessel:>6}"
        )
    for p in found["best_mu"]:
        lines.append(f"  tikhonov with the best mu, {p['mu']:.0e}, chosen by the truth: bin {p['bin']}, "
                     f"{p['psnr_db']:.2f} dB, PCC {p['pcc']:.3f}")  # fmt: skip
    choice = found["choice"]
    lines.append(
        f"within {found['budget_s']:g} s the instrument chooses {choice['method']}, bin {choice['bin']}, "
        f"{choice['rounds']} rounds: {choice['psnr_db']:.2f} dB in {choice['solve_s']:.3f} s, "
        f"{choice['db_below_edge']:.2f} dB below the edge; and {choice['refract_s']:.3f} s for the eye's refraction"
    )
    return "\n".join(lines)


class _Bench:
    """All reconstructors of one case, planned, and the judge of what they make."""

    def __init__(self, case: Case, planner: Planner, clock: Clock, say: Say) -> None:
        self.case, self.planner, self.clock, self.say = case, planner, clock, say
        geometry = case.calibration.geometry
        self.detail_px = HIGHPASS_DEG * geometry.px_per_deg if geometry else HIGHPASS_PX
        self.inside, self.where = _region(case)
        self.judge = Judge(case.truth, self.inside, self.detail_px, case.vessels)
        steps = ladder(case.calibration, case.shape)
        say(f"{case.name}: planning the instrument's own ladder")
        self.instrument = Reconstructor(case.calibration, case.shape, planner, clock, steps)
        self.shift = (0, 0)
        if case.registered:  # a scene's truth stands where its frame does
            self.shift = shift_px(_grey(self.instrument(case.counts).picture), case.truth)
        self.recipes = _recipes(case.shape, steps[-1].bin)
        self.makers: dict[tuple[str, int], Reconstructor] = {}
        for recipe in self.recipes:
            key = recipe.method, recipe.bin
            if key not in self.makers:
                say(f"{case.name}: planning {recipe.method}, bin {recipe.bin}")
                most = Recipe(recipe.method, recipe.bin, max(ROUNDS))
                self.makers[key] = Reconstructor(case.calibration, case.shape, planner, clock, (most,), refract=False)

    def _make(self, recipe: Recipe) -> Reconstruction:
        return self.makers[recipe.method, recipe.bin](self.case.counts, rounds=recipe.rounds)

    def score(self, made: Reconstruction) -> Scores:
        """What a picture scores, after the one shift that all pictures of this case share."""
        return self.judge(self.moved(_grey(made.picture)))

    def moved(self, picture: Image) -> Image:
        """A picture moved by the one shift that all pictures of this case share."""
        return np.roll(picture, (-self.shift[0], -self.shift[1]), axis=(0, 1))

    def best_mus(self) -> list[dict[str, Any]]:
        """The paper's closed form at the best mu of its range, for each bin; an oracle, not a way to make a picture."""
        self.say("tikhonov at the best mu of its range")
        case = self.case
        bins = sorted({recipe.bin for recipe in self.recipes if recipe.method == "tikhonov"})
        return best_mus(
            case.counts, case.calibration, self.planner, case.truth, self.inside, bins, self.judge, self.moved
        )

    def measure(self, budget_s: float, repeats: int) -> tuple[list[Point], dict[str, Any]]:
        """Every point and the instrument's choice."""
        scored = []
        for k, recipe in enumerate(self.recipes, 1):
            scores = self.score(self._make(recipe))
            scored.append(scores)
            self.say(f"{k:>3}/{len(self.recipes)} {_name(recipe)}: {scores.psnr_db:.2f} dB, PCC {scores.pcc:.3f}")
        times, own, made = self._turns(budget_s, repeats)
        last = sorted(made, key=lambda each: (each.report.rounds, -each.report.bin))[len(made) // 2]  # the usual one
        points = [
            Point(recipe.method, recipe.bin, recipe.rounds or 0, *_summary(seconds), **asdict(scores))
            for recipe, seconds, scores in zip(self.recipes, times, scored, strict=True)
        ]
        report = last.report
        refract_s = float(np.median([each.report.seconds["refract"] for each in made]))
        solve_s = _summary(own)[0] - refract_s
        psnr_db = self.score(last).psnr_db
        choice = {
            "method": report.method, "bin": report.bin, "rounds": report.rounds, "stopped": report.stopped,
            "seconds_median": _summary(own)[0], "seconds_p95": _summary(own)[1], "within_budget": max(own) <= budget_s,
            "refract_s": refract_s, "solve_s": solve_s,
            "db_below_edge": max(0.0, *(p.psnr_db - psnr_db for p in points if p.seconds_median <= solve_s), 0.0),
            **asdict(self.score(last)),
        }  # fmt: skip
        return points, choice

    def _turns(self, budget_s: float, repeats: int) -> tuple[list[list[float]], list[float], list[Reconstruction]]:
        """Times of every point and of the instrument within its budget, taken in turns."""
        times: list[list[float]] = [[] for _ in self.recipes]
        own: list[float] = []
        made: list[Reconstruction] = []
        for turn in range(repeats):
            self.say(f"timing, turn {turn + 1} of {repeats}")
            for recipe, seconds in zip(self.recipes, times, strict=True):
                begin_s = self.clock.now_s()
                self._make(recipe)
                seconds.append(self.clock.now_s() - begin_s)
            begin_s = self.clock.now_s()
            made.append(self.instrument(self.case.counts, deadline=Deadline.after(self.clock, budget_s)))
            own.append(self.clock.now_s() - begin_s)
        return times, own, made

    def region(self) -> dict[str, Any]:
        """Where and how pictures are compared."""
        return {
            "what": self.where, "pixels": int(self.judge.inside.sum()), "intensity_fit": FIT, "psnr_range": RANGE,
            "truth_variance": self.judge.truth_variance, "ssim": "sigma 1.5 px, 11 x 11, "
            "K1 0.01, K2 0.03, on the region eroded by 5 px", "highpass_sigma_px": self.detail_px,
            "shift_px": list(self.shift), "truth_vessel_contrast": self.judge.truth_contrast,
        }  # fmt: skip


def _summary(seconds: list[float]) -> tuple[float, float]:
    return float(np.median(seconds)), float(np.quantile(seconds, 0.95))


def _name(recipe: Recipe) -> str:
    rounds = "" if recipe.rounds is None else f", {recipe.rounds} rounds"
    return f"{recipe.method}, bin {recipe.bin}{rounds}"


def _recipes(shape: tuple[int, int], working: int) -> list[Recipe]:
    """Every method at every bin that leaves a picture; the methods that iterate at several numbers of rounds."""
    bins = [n for n in range(1, max(MOST_BIN, working) + 1) if n == 1 or min(shape) // n >= LEAST_SAMPLES]
    wanted = []
    for method in METHODS.values():
        rounds = ROUNDS if method.round_pairs else (None,)
        wanted += [Recipe(method.name, n, k) for n in bins for k in rounds]
    return wanted


def _region(case: Case) -> tuple[Mask, str]:
    """The field without its rim; where no field is known, wherever the truth is not zero."""
    radius_px = field_radius_px(case.calibration)
    if np.isfinite(radius_px):
        middle = ((case.shape[0] - 1) / 2, (case.shape[1] - 1) / 2)
        inside = disc(case.shape, middle, radius_px - RIM_PX) > 0.5
        return inside & _known(case.truth), f"the illuminated field less {RIM_PX:g} px of its rim"
    lit = _known(case.truth) & (case.truth != 0)
    if lit.mean() > 0.05:
        return lit, "no field is known: wherever the truth is not zero"
    return _known(case.truth), "no field is known: the whole frame"


def _known(truth: Image) -> Mask:
    return np.isfinite(truth)


def _grey(picture: Image) -> Image:
    return picture if picture.ndim == 2 else np.asarray(picture.mean(axis=2), np.float32)


def _versions() -> dict[str, str]:
    names = ("diffuscope", "numpy", "scipy", "pyfftw", "numba")
    found = {name: version(name) for name in names}
    return found | {"python": platform.python_version(), "fftw": str(pyfftw.fftw_version)}


def _refuse(wish: Wish) -> None:
    """Refuse what cannot be measured before anything is computed."""
    files = {"--raw": wish.raw, "--psf": wish.psf, "--truth": wish.truth}
    if wish.scene is not None:
        extra = [word for word, path in {**files, "--head": wish.head}.items() if path is not None]
        if extra or wish.field_deg is not None:
            raise SettingError(
                f"a scene brings its own frame, truth and field; {', '.join(extra or ['--field-deg'])} has no place",
                "Give --scene alone, or --raw with --psf and --truth.",
            )
    elif missing := [word for word, path in files.items() if path is None]:
        raise SettingError(
            f"there is nothing to measure: {', '.join(missing)} and --scene are missing",
            "Give --scene SCENE.toml, or --raw, --psf and --truth together.",
        )
    if wish.repeats < 1:
        raise SettingError(f"{wish.repeats} repeats measure nothing", "Give --repeats of at least 5.")
    for place in (wish.json, wish.plot):
        refuse_place(place)


def _case(wish: Wish) -> Case:
    if wish.scene is not None:
        return scene_case(load_head(wish.scene))
    assert wish.raw is not None
    assert wish.psf is not None
    assert wish.truth is not None
    truth = _grey(read_image(wish.truth).astype(np.float32))
    raw = as_raw(read_image(wish.raw))
    if truth.shape != raw.pixels.shape[:2]:
        raise FrameError(
            f"{wish.truth} has {truth.shape[0]} x {truth.shape[1]} pixels, "
            f"the raw {raw.pixels.shape[0]} x {raw.pixels.shape[1]}",
            "Give the truth on the sensor's grid: one value per pixel of the raw frame.",
        )
    order = Order(
        wish.raw, (wish.psf,), wish.plot, None, None, None, None, wish.head, wish.field_deg, False, wish.plans
    )
    return Case(wish.raw.name, raw.pixels, truth, None, calibrated(order, raw), True)
