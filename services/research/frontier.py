"""Accuracy against run time on this machine, for every method, bin and number of rounds.

A time is that of one frame in memory to its picture on the sensor grid, with FFT plans already made. Every point is run
once for its score. The timed runs of all points are interleaved, so that a burst of other load affects all points
alike; the median of the repeats counts.
"""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyfftw

from device.clock import Clock, Deadline, SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.image_files import read_image
from device.errors import DiffuscopeError, FrameError, SettingError
from device.recon.assessment.metrics import FIT, RANGE, PictureScorer, Scores, shift_px
from device.recon.installed_methods import available_methods, find_method
from device.recon.methods import METHODS, Method
from device.recon.model.fft_plans import Planner, processor_name
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import disc
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe, default_schedule
from device.sim.scene_files import simulate_exposure
from device.values import Calibration, Image, Mask, Reconstruction
from services.instrument.measured_frontier import MeasuredFrontier
from services.plot import Panel
from services.research.fft_time import pair_s
from services.research.frontier_light import LightCase, light_case, measure_light, measure_presses
from services.research.frontier_oracle import best_mus
from services.research.frontier_plot import draw_frontier, drawn_points, ringed
from services.research.frontier_result import (
    BestMu,
    Choice,
    FrameSize,
    Frontier,
    LightPoint,
    Machine,
    PeerPoint,
    Point,
    PressPoint,
    ScoredRegion,
    frontier_text,
    pareto_front,
)
from services.research.frontier_thumbnails import Shown, nearest_points, thumbnail_panel
from services.research.pair_scores import LeftOut, left
from services.research.peers import LenslessPeer
from services.research.reconstruct_file import require_writable, write_or_raise
from services.research.reconstruct_inputs import (
    RawSource,
    ReconstructOptions,
    Source,
    load_calibration,
    load_raw,
    name_of,
)

ROUNDS = (0, 1, 2, 4, 8, 12, 20)
MAX_BIN, MIN_SAMPLES = 4, 48
RIM_PX = 2.0  # width of the blurred field edge, which is excluded from scores
HIGHPASS_DEG, HIGHPASS_PX = 2.0, 32.0
ProgressCallback = Callable[[str], None]


@dataclass(frozen=True)
class FrontierRequest:
    """Options of `diffuscope frontier`: a scene, or a raw frame with its PSF and its truth.

    `json` and `plot` are the output files, `plans` the folder of cached FFT plans. `methods`: names, or FILE.py:NAME;
    empty for all.
    """

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
    plans: Path | None
    methods: tuple[str, ...] = ()


@dataclass(frozen=True)
class Case:
    """One frame with its truth: the data in memory before a timed run.

    `vessels` is the mask of the vessels, None if unknown. `registered`: the truth has its own origin, and one common
    shift registers all pictures with it. `light`: bursts of a scene, None if they are not measured. `notes` are
    sentences for the user.
    """

    name: str
    counts: Pixels
    truth: Image
    vessels: Mask | None
    calibration: Calibration
    registered: bool
    light: LightCase | None = None
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.counts.shape[0], self.counts.shape[1]


def frontier(request: FrontierRequest, progress: ProgressCallback, peer: LenslessPeer | None = None) -> Frontier:
    """Measure the frontier, write the JSON file and the plot, and return the result.

    A `peer` solves the same frame. `progress` is called with one line per step. SettingError for invalid options;
    StoreError for an unwritable file.
    """
    _refuse_invalid(request)
    Deadline.after(SystemClock(), request.budget_s)  # raises SettingError for an invalid time
    methods = selected_methods(request.methods)
    bench = _Bench(_case(request), Planner(request.plans), SystemClock(), progress, methods)
    found = _measured(bench, request.budget_s, request.repeats, peer)
    text = frontier_text(found)
    write_or_raise(request.json, lambda: request.json.write_text(text, encoding="utf-8"))
    picture = draw_frontier(found, methods, bench.thumbnails(found))
    write_or_raise(request.plot, lambda: request.plot.write_text(picture, encoding="utf-8"))
    return found


def measure_frontier(
    case: Case,
    plans: Path | None,
    budget_s: float,
    repeats: int,
    progress: ProgressCallback,
    methods: Mapping[str, Method] = METHODS,
    peer: LenslessPeer | None = None,
) -> Frontier:
    """Measure every point of one case with each of `methods`, and the instrument's choice within `budget_s`.

    A `peer` solves the same frame; the bursts of a case that has them follow.
    """
    return _measured(_Bench(case, Planner(plans), SystemClock(), progress, methods), budget_s, repeats, peer)


def selected_methods(names: Sequence[str]) -> Mapping[str, Method]:
    """Return the methods of these names (or FILE.py:NAME) by name; all, the installed ones too, without names.

    SettingError for an unknown method.
    """
    return {method.name: method for method in map(find_method, names)} or available_methods()


def _measured(bench: "_Bench", budget_s: float, repeats: int, peer: LenslessPeer | None) -> Frontier:
    case = bench.case
    for note in case.notes:
        bench.progress(f"note: {note}")
    presses = bench.press_points()  # first: the arrays of 70 other solvers would slow them down
    light = bench.light_points()
    points, choice = bench.measure(budget_s, repeats)
    front = pareto_front([(p.seconds_median, p.psnr_db) for p in points])
    points = tuple(replace(point, pareto=on) for point, on in zip(points, front, strict=True))
    kept = {point.method for point in points if point.pareto}
    return Frontier(
        machine=this_machine(),
        versions=versions(),
        scene=case.name,
        simulated=case.calibration.simulated,
        frame=FrameSize(case.shape[0], case.shape[1]),
        region=bench.region(),
        timing=f"counts in memory to picture on the sensor grid, plans made; {repeats} interleaved repeats",
        fft_pair_s=pair_s(bench.planner, case.shape, bench.clock),
        edge="seconds_median against psnr_db",
        points=points,
        best_mu=bench.best_mus(),
        budget_s=budget_s,
        choice=choice,
        dominated=tuple(method for method in bench.methods if method not in kept),
        peers=() if peer is None else bench.peer_points(peer),
        light=light,
        presses=presses,
        left_out=tuple(bench.left_out),
    )


def scene_case(spec: InstrumentSpec, bursts: bool = False) -> Case:
    """Return one exposure of a simulated head, with its truth; with `bursts` the frames of its bursts, too."""
    scene = simulate_exposure(spec)
    light = light_case(spec) if bursts else None
    return Case(spec.name, scene.counts, scene.truth, scene.vessels, scene.calibration, False, light)


def measure_scene(
    spec: InstrumentSpec, plans: Path, budget_s: float, repeats: int, progress: ProgressCallback
) -> tuple[MeasuredFrontier, str]:
    """Return the frontier of one simulated head with its bursts and presses, and its plot as SVG.

    Without the method for an unknown field: a simulated head knows it.
    """
    methods = {name: method for name, method in METHODS.items() if name != "open"}
    bench = _Bench(scene_case(spec, bursts=True), Planner(plans), SystemClock(), progress, methods)
    found = _measured(bench, budget_s, repeats, None)
    plot = draw_frontier(found, methods, bench.thumbnails(found))
    return MeasuredFrontier.model_validate_json(frontier_text(found)), plot


def table(found: Frontier) -> str:
    """Return as text the points from fast to slow (*: Pareto front), the best mus and the instrument's choice."""
    lines = [
        f"{'':2}{'method':<10} {'bin':>3} {'rounds':>6} {'ms':>8} {'p95':>8} {'PSNR':>6} {'PCC':>6} {'SSIM':>6} "
        f"{'detail':>6} {'vessel':>6}"
    ]
    for p in sorted(found.points, key=lambda p: p.seconds_median):
        vessel = "-" if p.vessel_contrast is None else f"{p.vessel_contrast:.3f}"
        lines.append(
            f"{'* ' if p.pareto else '  '}{p.method:<10} {p.bin:>3} {p.rounds:>6} "
            f"{p.seconds_median * 1e3:>8.1f} {p.seconds_p95 * 1e3:>8.1f} {p.psnr_db:>6.2f} {p.pcc:>6.3f} "
            f"{p.ssim:>6.3f} {p.highpass_pcc:>6.3f} {vessel:>6}"
        )
    for best in found.best_mu:
        lines.append(
            f"  tikhonov with the best mu, {best.mu:.0e}, chosen by the truth: bin {best.bin}, "
            f"{best.psnr_db:.2f} dB, PCC {best.pcc:.3f}"
        )
    choice = found.choice
    lines.append(
        f"within {found.budget_s:g} s the instrument chooses {choice.method}, bin {choice.bin}, "
        f"{choice.rounds} rounds: {choice.psnr_db:.2f} dB in {choice.solve_s:.3f} s, "
        f"{choice.db_below_edge:.2f} dB below the edge; and {choice.refract_s:.3f} s for the eye's refraction"
    )
    for press in found.presses:
        lines.append(
            f"  a press within {press.budget_s:g} s ({press.choice}, {press.frames} lit): {press.psnr_db:.2f} dB in "
            f"{press.seconds_median:.3f} s"
        )
    for peer in found.peers:
        lines.append(f"  {peer.name}: {peer.psnr_db:.2f} dB in {peer.seconds:.3f} s")
    for burst in found.light:
        lines.append(
            f"  {burst.length} ({burst.used} used), {burst.dose_j_per_cm2:.2g} J/cm2: {burst.psnr_db:.2f} dB in "
            f"{burst.seconds_median:.3f} s; linear bound {burst.bound_psnr_db:.2f} dB"
        )
    return "\n".join([*lines, *(f"left out: {left_out}" for left_out in found.left_out)])


class _Bench:
    """Planned reconstructors of one case, and the scorer of their pictures."""

    def __init__(
        self, case: Case, planner: Planner, clock: Clock, progress: ProgressCallback, methods: Mapping[str, Method]
    ) -> None:
        self.case, self.planner, self.clock, self.progress = case, planner, clock, progress
        self.methods = methods
        self.last: Shown | None = None  # thumbnail of the press, or of the choice
        geometry = case.calibration.geometry
        self.detail_px = HIGHPASS_DEG * geometry.px_per_deg if geometry else HIGHPASS_PX
        self.inside, self.where = scored_region(case)
        self.judge = PictureScorer(case.truth, self.inside, self.detail_px, case.vessels)
        steps = default_schedule(case.calibration, case.shape)
        progress(f"{case.name}: planning the instrument's own ladder")
        self.instrument = Reconstructor(case.calibration, case.shape, planner, clock, steps)
        self.shift = (0, 0)
        if case.registered:  # the truth of a scene is aligned with its frame
            self.shift = shift_px(_grey(self.instrument(case.counts).picture), case.truth)
        self.left_out: list[LeftOut] = []
        self.recipes = _recipes(case.shape, steps[-1].bin, methods)
        self.makers: dict[tuple[str, int], Reconstructor] = {}

    def _reconstruct(self, recipe: Recipe) -> Reconstruction:
        """Return the picture of a point; a method is planned at each bin for the largest number of its rounds."""
        key = recipe.method, recipe.bin
        if key not in self.makers:
            self.progress(f"{self.case.name}: planning {recipe.method}, bin {recipe.bin}")
            rounds = [
                candidate.rounds
                for candidate in self.recipes
                if (candidate.method, candidate.bin) == key and candidate.rounds is not None
            ]
            most = Recipe(*key, max(rounds, default=None))
            self.makers[key] = Reconstructor(
                self.case.calibration,
                self.case.shape,
                self.planner,
                self.clock,
                (most,),
                refract=False,
                timed=False,
                methods=self.methods,
            )
        return self.makers[key](self.case.counts, rounds=recipe.rounds)

    def _scored(self) -> list[tuple[Recipe, int, Scores]]:
        """Return each point with the number of rounds that were run, and its scores.

        A point whose solver fails is left out.
        """
        found = []
        for k, recipe in enumerate(self.recipes, 1):
            place = f"{k:>3}/{len(self.recipes)}"
            try:
                made = self._reconstruct(recipe)
                scores = self.score(made)
            except DiffuscopeError as error:
                self.left_out.append(left(self.case.name, _name(recipe), error, self.progress))
                continue
            found.append((recipe, made.report.rounds, scores))
            self.progress(f"{place} {_name(recipe)}: {scores.psnr_db:.2f} dB, PCC {scores.pcc:.3f}")
        if not found:
            raise FrameError("no method gave a picture of this frame", str(self.left_out[0]))
        return found

    def score(self, made: Reconstruction) -> Scores:
        """Return the scores of a picture after the shift that all pictures of this case share."""
        return self.judge(self.moved(_grey(made.picture)))

    def moved(self, picture: Image) -> Image:
        """Return a picture moved back by `shift` (rows, cols), the offset that all pictures of this case share."""
        return np.roll(picture, (-self.shift[0], -self.shift[1]), axis=(0, 1))

    def best_mus(self) -> tuple[BestMu, ...]:
        """Return for each bin the best mu of Tikhonov regularisation in the paper's range, and its scores.

        The truth selects mu: an oracle for comparison, not a usable method.
        """
        self.progress("tikhonov at the best mu of its range")
        case = self.case
        bins = sorted({recipe.bin for recipe in self.recipes if recipe.method == "tikhonov"})
        return best_mus(
            case.counts,
            case.calibration,
            self.planner,
            case.truth,
            self.inside,
            bins,
            self.judge,
            self.moved,
            self.clock,
        )

    def thumbnails(self, found: Frontier) -> Panel:
        """Return the thumbnails of the best pictures within some times and of the ring, after `measure`."""
        assert self.last is not None
        shown = []
        for p in nearest_points(drawn_points(found), ringed(found)[-1].seconds_median):
            recipe = next(
                candidate
                for candidate in self.recipes
                if (candidate.method, candidate.bin, candidate.rounds or 0) == (p.method, p.bin, p.rounds)
            )
            shown.append(Shown(_label(p, self.methods), self.moved(_grey(self._reconstruct(recipe).picture))))
        return thumbnail_panel([*shown, self.last], self.case.truth, self.inside, self.case.calibration.simulated)

    def light_points(self) -> tuple[LightPoint, ...]:
        """Return the bursts of the case; none if it has no frames for them."""
        case = self.case
        if case.light is None:
            return ()
        return measure_light(
            case.light, self.instrument, self.planner, self.clock, case.truth, self.judge, self.progress
        )

    def press_points(self) -> tuple[PressPoint, ...]:
        """Return what a press makes of the case within each time budget; none if it has no frames for it."""
        case = self.case
        if case.light is None:
            return ()
        points, picture = measure_presses(
            case.light, self.instrument, self.planner, self.clock, self.judge, self.progress
        )
        lines = _label(points[-1], METHODS)
        self.last = Shown((lines[0], lines[1], f"{points[-1].frames} frames, standard"), picture)
        return points

    def peer_points(self, peer: LenslessPeer) -> tuple[PeerPoint, ...]:
        """Return the pictures of a peer, scored as ours are."""
        found = []
        for result in peer(self.case.counts, self.case.calibration.psfs[0].pixels):
            scores = self.judge(self.moved(_grey(result.picture)))
            self.progress(f"{result.name}: {result.seconds:.3f} s, {scores.psnr_db:.2f} dB")
            found.append(PeerPoint(result.name, result.seconds, scores.pcc, scores.psnr_db, scores.ssim))
        return tuple(found)

    def measure(self, budget_s: float, repeats: int) -> tuple[tuple[Point, ...], Choice]:
        """Return every point, and the instrument's choice within `budget_s`."""
        scored = self._scored()
        times, own, made = self._times([recipe for recipe, _, _ in scored], budget_s, repeats)
        last = sorted(made, key=lambda each: (each.report.rounds, -each.report.bin))[len(made) // 2]  # the median run
        points = tuple(
            Point(recipe.method, recipe.bin, rounds, *_summary(seconds), **asdict(scores))
            for (recipe, rounds, scores), seconds in zip(scored, times, strict=True)
        )
        report = last.report
        refract_s = float(np.median([each.report.seconds["refract"] for each in made]))
        solve_s = _summary(own)[0] - refract_s
        scores = self.score(last)
        lead_db = (p.psnr_db - scores.psnr_db for p in points if p.seconds_median <= solve_s)
        choice = Choice(
            method=report.method,
            bin=report.bin,
            rounds=report.rounds,
            stopped=report.stopped,
            seconds_median=_summary(own)[0],
            seconds_p95=_summary(own)[1],
            within_budget=max(own) <= budget_s,
            refract_s=refract_s,
            solve_s=solve_s,
            db_below_edge=max(0.0, *lead_db, 0.0),
            **asdict(scores),
        )
        if self.last is None:
            lines = _label(choice, METHODS)  # the instrument chooses among the built-in methods
            self.last = Shown((lines[0], lines[1], f"{lines[2]}, chosen"), self.moved(_grey(last.picture)))
        return points, choice

    def _times(
        self, recipes: Sequence[Recipe], budget_s: float, repeats: int
    ) -> tuple[list[list[float]], list[float], list[Reconstruction]]:
        """Return interleaved times in s: of every point, and of the instrument within its budget; and its results."""
        times: list[list[float]] = [[] for _ in recipes]
        own: list[float] = []
        made: list[Reconstruction] = []
        for turn in range(repeats):
            self.progress(f"timing, turn {turn + 1} of {repeats}")
            for recipe, seconds in zip(recipes, times, strict=True):
                begin_s = self.clock.now_s()
                self._reconstruct(recipe)
                seconds.append(self.clock.now_s() - begin_s)
            begin_s = self.clock.now_s()
            made.append(self.instrument(self.case.counts, deadline=Deadline.after(self.clock, budget_s)))
            own.append(self.clock.now_s() - begin_s)
        return times, own, made

    def region(self) -> ScoredRegion:
        """Return the scored region and the settings of the scores."""
        return ScoredRegion(
            what=self.where,
            field_known=bool(np.isfinite(field_radius_px(self.case.calibration))),
            pixels=int(self.judge.inside.sum()),
            intensity_fit=FIT,
            psnr_range=RANGE,
            truth_variance=self.judge.truth_variance,
            ssim="sigma 1.5 px, 11 x 11, K1 0.01, K2 0.03, on the region eroded by 5 px",
            highpass_sigma_px=self.detail_px,
            shift_px=self.shift,
            truth_vessel_contrast=self.judge.truth_contrast,
        )


def _summary(seconds: list[float]) -> tuple[float, float]:
    return float(np.median(seconds)), float(np.quantile(seconds, 0.95))


def _label(made: Point | Choice | PressPoint, methods: Mapping[str, Method]) -> tuple[str, str, str]:
    """Return the lines below a thumbnail: time and accuracy, method and bin, rounds."""
    ms = made.seconds_median * 1e3
    rounds = f"{made.rounds} round{'' if made.rounds == 1 else 's'}" if methods[made.method].round_pairs else ""
    return (
        f"{ms:.{0 if ms >= 10 else 1}f} ms, {made.psnr_db:.1f} dB",
        f"{made.method}, bin {made.bin}",
        rounds or "closed form",
    )


def _name(recipe: Recipe) -> str:
    rounds = "" if recipe.rounds is None else f", {recipe.rounds} rounds"
    return f"{recipe.method}, bin {recipe.bin}{rounds}"


def _recipes(shape: tuple[int, int], working: int, methods: Mapping[str, Method]) -> list[Recipe]:
    """Return every method at every usable bin, iterative ones at each number in ROUNDS and at their default number.

    Bins go up to MAX_BIN, or to the `working` bin of the default schedule if that is larger.
    """
    bins = [n for n in range(1, max(MAX_BIN, working) + 1) if n == 1 or min(shape) // n >= MIN_SAMPLES]
    wanted = []
    for method in methods.values():
        rounds = sorted({*ROUNDS, method.rounds}) if method.round_pairs else (None,)
        wanted += [Recipe(method.name, n, k) for n in bins for k in rounds]
    return wanted


def scored_region(case: Case) -> tuple[Mask, str]:
    """Return the compared region and its description.

    The region is the lit field without its edge. If the field is unknown, it is all pixels with a non-zero truth, or
    the whole frame if these are at most 5 %. Pixels with an unknown truth (NaN) are left out.
    """
    radius_px = field_radius_px(case.calibration)
    if np.isfinite(radius_px):
        centre = ((case.shape[0] - 1) / 2, (case.shape[1] - 1) / 2)
        inside = disc(case.shape, centre, radius_px - RIM_PX) > 0.5
        return inside & _known(case.truth), f"the illuminated field less {RIM_PX:g} px of its rim"
    lit = _known(case.truth) & (case.truth != 0)
    if lit.mean() > 0.05:
        return lit, "no field is known: wherever the truth is not zero"
    return _known(case.truth), "no field is known: the whole frame"


def _known(truth: Image) -> Mask:
    return np.isfinite(truth)


def _grey(picture: Image) -> Image:
    return picture if picture.ndim == 2 else np.asarray(picture.mean(axis=2), np.float32)


def this_machine() -> Machine:
    """Return this computer, as a measurement states it."""
    return Machine(processor_name(), os.cpu_count(), platform.platform(), fft_threads=1)


def versions() -> dict[str, str]:
    """Return the versions of the program, its libraries, Python and FFTW by name."""
    names = ("diffuscope", "numpy", "scipy", "pyfftw", "numba")
    found = {name: version(name) for name in names}
    return found | {"python": platform.python_version(), "fftw": str(pyfftw.fftw_version)}


def _refuse_invalid(request: FrontierRequest) -> None:
    """Raise SettingError for options that cannot be measured, before any computation."""
    files = {"--raw": request.raw, "--psf": request.psf, "--truth": request.truth}
    if request.scene is not None:
        extra = [word for word, path in {**files, "--head": request.head}.items() if path is not None]
        if extra or request.field_deg is not None:
            raise SettingError(
                f"a scene brings its own frame, truth and field; {', '.join(extra or ['--field-deg'])} has no place",
                "Give --scene alone, or --raw with --psf and --truth.",
            )
    elif missing := [word for word, path in files.items() if path is None]:
        raise SettingError(
            f"there is nothing to measure: {', '.join(missing)} and --scene are missing",
            "Give --scene SCENE.toml, or --raw, --psf and --truth together.",
        )
    if request.repeats < 1:
        raise SettingError(f"{request.repeats} repeats measure nothing", "Give --repeats of at least 5.")
    for place, kind in ((request.json, ".json"), (request.plot, ".svg")):
        if place.suffix.lower() != kind:
            raise SettingError(f"{place} would hold another kind of file than it says", f"Choose a name in {kind}.")
        require_writable(place)


def _case(request: FrontierRequest) -> Case:
    if request.scene is not None:
        return scene_case(load_head(request.scene), bursts=True)
    assert request.raw is not None
    assert request.psf is not None
    assert request.truth is not None
    return recorded_case(request.raw, request.psf, request.truth, request.head, request.field_deg, request.plans)


def recorded_case(
    raw: RawSource,
    psf: Source,
    truth: Source,
    head: Path | InstrumentSpec | None,
    field_deg: float | None,
    plans: Path | None,
) -> Case:
    """Return a recorded frame with its truth, files or arrays; FrameError for a mosaic, or a truth of another shape.

    `head`, `field_deg`: as in `ReconstructOptions`. `plans`: folder of cached FFT plans.
    """
    pixels = _grey((read_image(truth) if isinstance(truth, Path) else np.asarray(truth)).astype(np.float32))
    frame = load_raw(raw)
    if frame.bayer is not None:
        raise FrameError(
            f"{frame.name} is a colour mosaic ({frame.bayer}), and a frontier measures one channel",
            "Give raw, PSF and truth of a monochrome sensor, or of one colour plane, as npy.",
        )
    if pixels.shape != frame.shape:
        raise FrameError(
            f"{name_of(truth, 'the truth')} has {pixels.shape[0]} x {pixels.shape[1]} pixels, "
            f"the raw {frame.shape[0]} x {frame.shape[1]}",
            "Give the truth on the sensor's grid: one value per pixel of the raw frame.",
        )
    options = ReconstructOptions(psfs=(psf,), head=head, field_deg=field_deg, plans=plans)
    name = raw.name if isinstance(raw, Path) else frame.name
    return Case(name, frame.raw.pixels, pixels, None, load_calibration(options, frame), True, notes=frame.notes)
