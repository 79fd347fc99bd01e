"""`diffuscope bench`: every method and the peers on the pairs of a data set, as one table with spread over the pairs.

A method runs as `diffuscope reconstruct --method NAME` would: without a time limit, at the bin of the default
schedule; but a colour PSF is averaged over its channels. A time is that of one frame in memory to its picture, planning
excluded. Both hold for methods and peers alike.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from device.clock import Clock
from device.config.image_files import Raw
from device.errors import DiffuscopeError, FrameError
from device.recon.assessment.metrics import FIT, RANGE, shift_px
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.methods import Method
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe, default_schedule
from device.values import Calibration, Image, Sensor
from services.research.dataset_pairs import Dataset, Pair
from services.research.fft_time import FftTime
from services.research.frontier import Case, scored_region, selected_methods, this_machine, versions
from services.research.frontier_result import Machine
from services.research.pair_scores import PLANES, LeftOut, PairScore, PairScorer, Row, grey, left, rows
from services.research.peers import LenslessPeer
from services.research.reconstruct_file import require_writable, write_or_raise

LENSLESS_ROUNDS = (100,)  # the default of LenslessPiCam
TIMING = "one frame in memory to its picture, planning excluded; median of the repeats (peers: one run), then of pairs"
ProgressCallback = Callable[[str], None]


@dataclass(frozen=True)
class BenchmarkRequest:
    """Options of `diffuscope bench`: the first `limit` pairs (None: all), the methods (empty: all), timed repeats.

    `json` is the output file, None for none; `plans` the folder of cached FFT plans.
    """

    dataset: Dataset
    limit: int | None
    methods: tuple[str, ...]
    repeats: int
    json: Path | None
    plans: Path | None


@dataclass(frozen=True)
class Benchmark:
    """Result of a benchmark; the fields are the keys of the JSON file. `data_set` is the title of the layout."""

    machine: Machine
    versions: dict[str, str]
    data_set: str
    pairs: tuple[str, ...]
    timing: str
    intensity_fit: str
    psnr_range: str
    channels: str
    rows: tuple[Row, ...]
    scores: tuple[PairScore, ...]
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True)
class Made:
    """Picture of one method with its settings and its time in s."""

    method: str
    bin: int
    rounds: int
    seconds: float
    picture: Image


def calibration_of(pair: Pair, planner: Planner) -> Calibration:
    """Return the calibration of a pair with one PSF: of a stack, that which the frame makes most likely."""
    raw = pair.raw
    calibration = Calibration(pair.psfs, Sensor(white_dn=raw.white_dn), bad=raw.bad, simulated=pair.simulated)
    index, _ = most_likely_psf(calibration, raw.pixels, planner)
    return replace(calibration, psfs=(pair.psfs[index],))


def case_of(pair: Pair, calibration: Calibration, aligned: bool) -> Case:
    """Return a pair as a case of the frontier, with a grey truth; FrameError for a pair without a truth."""
    if pair.truth is None:
        raise FrameError(f"{pair.name} has no truth", "Give a pair with a truth; `diffuscope bench` times all pairs.")
    return Case(pair.name, pair.raw.pixels, grey(pair.truth), None, calibration, not aligned)


def without_bad_pixels(raw: Raw) -> Pixels:
    """Return the counts with bad pixels set to the median, for peers that take no mask."""
    pixels, bad = raw.pixels, raw.bad
    if not bad.any():
        return pixels
    filled = pixels.copy()
    filled[bad] = np.median(pixels[~bad], axis=0).astype(pixels.dtype)
    return filled


def selected(dataset: Dataset, limit: int | None) -> Dataset:
    """Return the data set with its first `limit` pairs, None for all."""
    return dataset if limit is None else replace(dataset, entries=dataset.entries[:limit])


def benchmark(
    request: BenchmarkRequest, peer: LenslessPeer | None, clock: Clock, progress: ProgressCallback
) -> Benchmark:
    """Measure every method, and the peer if given, on every pair; write the JSON file and return the result.

    A pair that cannot be read, and a method that fails on a pair, are in `left_out`; the others go on. `progress` is
    called with one line per picture. SettingError for an unknown method or an invalid output, StoreError for an
    unwritable file.
    """
    methods = selected_methods(request.methods)
    if request.json is not None:
        require_writable(request.json)
    dataset = selected(request.dataset, request.limit)
    run = _Run(dataset, methods, request.repeats, Planner(request.plans), clock, peer)
    for k, entry in enumerate(dataset.entries, 1):
        progress(f"{k} of {len(dataset)}: {entry.name}")
        try:
            run.measure(dataset.read(entry), progress)
        except DiffuscopeError as error:
            run.leave_out(entry.name, None, error, progress)
    found = Benchmark(
        this_machine(),
        versions(),
        dataset.layout.title,
        tuple(entry.name for entry in dataset.entries),
        TIMING,
        FIT,
        RANGE,
        PLANES,
        rows(run.scores),
        tuple(run.scores),
        tuple(run.left_out),
    )
    if request.json is not None:
        place = request.json
        text = json.dumps(asdict(found), indent=1) + "\n"
        write_or_raise(place, lambda: place.write_text(text, encoding="utf-8"))
    return found


class _Run:
    """Measurement of one data set: scores so far, and the reconstructors planned for its last pair."""

    def __init__(
        self,
        dataset: Dataset,
        methods: Mapping[str, Method],
        repeats: int,
        planner: Planner,
        clock: Clock,
        peer: LenslessPeer | None,
    ) -> None:
        self.layout = dataset.layout
        self.methods = methods
        self.repeats = repeats
        self.planner, self.clock, self.peer = planner, clock, peer
        self.scores: list[PairScore] = []
        self.left_out: list[LeftOut] = []
        self._planned: dict[str, Reconstructor] = {}

    def measure(self, pair: Pair, progress: ProgressCallback) -> None:
        """Reconstruct one pair with every method and the peer, and score the pictures."""
        calibration = calibration_of(pair, self.planner)
        judge: PairScorer | None = None
        fft = FftTime.measured(self.planner, pair.shape, self.clock)
        for made in self._pictures(pair, calibration, progress):
            if pair.truth is not None and judge is None:
                judge = self._judge(pair, calibration, made.picture)
            psnr_db, ssim, pcc = (None, None, None) if judge is None else judge(made.picture)
            times = fft.times(made.seconds)
            self.scores.append(PairScore(pair.name, made.method, made.bin, made.rounds, *times, psnr_db, ssim, pcc))
            accuracy = "" if psnr_db is None else f", {psnr_db:.2f} dB, PCC {pcc:.3f}"
            progress(f"  {made.method}: {made.seconds:.3f} s{accuracy}")

    def leave_out(self, pair: str, method: str | None, error: DiffuscopeError, progress: ProgressCallback) -> None:
        """Record and report a pair, or a method on it, that failed."""
        self.left_out.append(left(pair, method, error, progress))

    def _judge(self, pair: Pair, calibration: Calibration, first: Image) -> PairScorer:
        """Return the scorer of a pair; the first picture gives the shift that all of its pictures share."""
        assert pair.truth is not None
        case = case_of(pair, calibration, self.layout.aligned)
        shift = shift_px(grey(first), case.truth) if case.registered else (0, 0)
        return PairScorer(pair.truth, scored_region(case)[0], shift)

    def _pictures(self, pair: Pair, calibration: Calibration, progress: ProgressCallback) -> Iterator[Made]:
        """Yield the picture of every method, the default one first, then those of the peer."""
        recipe = default_schedule(calibration, pair.shape)[1]
        for name in sorted(self.methods, key=lambda name: name != recipe.method):
            try:
                n = 1 if self.methods[name].periodic else recipe.bin
                yield self._ours(pair, calibration, Recipe(name, n))
            except DiffuscopeError as error:
                self.leave_out(pair.name, name, error, progress)
        if self.peer is not None:
            try:
                pictures = self.peer(without_bad_pixels(pair.raw), calibration.psfs[0].pixels)
            except DiffuscopeError as error:
                self.leave_out(pair.name, "LenslessPiCam", error, progress)
                return
            yield from (
                Made(result.name, 1, rounds, result.seconds, result.picture)
                for rounds, result in zip(self.peer.rounds, pictures, strict=True)
            )

    def _ours(self, pair: Pair, calibration: Calibration, recipe: Recipe) -> Made:
        make = self._reconstructor(pair, calibration, recipe)
        seconds = []
        for _ in range(self.repeats):
            begin_s = self.clock.now_s()
            made = make(pair.raw.pixels, simulated=pair.simulated)
            seconds.append(self.clock.now_s() - begin_s)
        return Made(recipe.method, recipe.bin, made.report.rounds, float(np.median(seconds)), made.picture)

    def _reconstructor(self, pair: Pair, calibration: Calibration, recipe: Recipe) -> Reconstructor:
        """Return the reconstructor of a method; that of the pair before serves if nothing differs but the counts."""
        kept = self._planned.get(recipe.method)
        if kept is None or kept.shape != pair.shape or not _equal(kept.calibration, calibration):
            kept = Reconstructor(
                calibration,
                pair.shape,
                self.planner,
                self.clock,
                (recipe,),
                refract=False,
                timed=False,
                methods=self.methods,
            )
            kept(pair.raw.pixels, rounds=1)  # untimed: the first frame of a type compiles its kernels
            self._planned[recipe.method] = kept
        return kept


def _equal(first: Calibration, second: Calibration) -> bool:
    """Return whether two calibrations of a data set share PSF (read once), sensor and bad pixels."""
    assert first.bad is not None
    assert second.bad is not None
    return first.psfs[0] is second.psfs[0] and first.sensor == second.sensor and np.array_equal(first.bad, second.bad)
