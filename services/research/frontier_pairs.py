"""`diffuscope frontier --data`: the frontier over the pairs of a data set, with the peers, as one table and one plot.

Every pair is measured as one case (`frontier.measure_frontier`). A point of the result has the median of its times and
the means of its scores over the pairs.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from device.clock import Deadline, SystemClock
from device.errors import DiffuscopeError, FrameError, SettingError
from device.recon.assessment.metrics import FIT, RANGE
from device.recon.model.fft_plans import Planner
from services.research.benchmark import calibration_of, case_of, selected, without_bad_pixels
from services.research.dataset_pairs import Dataset, Entry, Pair
from services.research.datasets import open_dataset
from services.research.fft_time import FftTime
from services.research.frontier import (
    Case,
    FrontierRequest,
    measure_frontier,
    scored_region,
    selected_methods,
    this_machine,
    versions,
)
from services.research.frontier_plot import draw_frontier
from services.research.frontier_result import Choice, Frontier, Machine, Point, pareto_front
from services.research.pair_scores import LeftOut, PairScore, PairScorer, Row, left, rows, table
from services.research.peers import LenslessPeer
from services.research.reconstruct_file import require_writable, write_or_raise

LENSLESS_ROUNDS = (10, 40, 100)
CHOICE = "choice in budget"
ProgressCallback = Callable[[str], None]


@dataclass(frozen=True)
class DatasetFrontierRequest:
    """Options of `diffuscope frontier --data`: the data set, and the others; `limit` None measures all pairs."""

    dataset: Dataset
    limit: int | None
    options: FrontierRequest


@dataclass(frozen=True)
class DatasetFrontier:
    """Frontier over pairs; the fields are the keys of the JSON file.

    `rows`: methods, instrument's choice and peers over the pairs, from fast to slow. `frontiers`: of each pair.
    """

    machine: Machine
    versions: dict[str, str]
    data_set: str
    pairs: tuple[str, ...]
    intensity_fit: str
    psnr_range: str
    channels: str
    budget_s: float
    rows: tuple[Row, ...]
    left_out: tuple[LeftOut, ...]
    frontiers: tuple[Frontier, ...]


def dataset_request(request: FrontierRequest, folder: Path, limit: int | None) -> DatasetFrontierRequest:
    """Return the options of `--data`; SettingError if the others name a frame, a scene or an output that is invalid.

    The PSF of the options replaces that of the folder.
    """
    files = {"--scene": request.scene, "--raw": request.raw, "--truth": request.truth, "--head": request.head}
    extra = [word for word, path in files.items() if path is not None]
    if extra or request.field_deg is not None:
        raise SettingError(
            f"a data set brings its own frames and truths; {', '.join(extra or ['--field-deg'])} has no place",
            "Give --data alone, or with --psf.",
        )
    for place in (request.json, request.plot):
        require_writable(place)
    Deadline.after(SystemClock(), request.budget_s)  # raises SettingError for an invalid time
    return DatasetFrontierRequest(open_dataset(folder, request.psf), limit, request)


def frontier_of_dataset(
    request: DatasetFrontierRequest, peer: LenslessPeer | None, progress: ProgressCallback
) -> DatasetFrontier:
    """Measure the frontier of every pair with a truth, write JSON file and plot, and return the result.

    A pair that fails is in `left_out`; the others go on. FrameError if none is left. StoreError for an unwritable file.
    """
    dataset, options = selected(request.dataset, request.limit), request.options
    frontiers = []
    scores = []
    left_out = []
    planner = Planner(options.plans)
    methods = selected_methods(options.methods)
    for k, entry in enumerate(dataset.entries, 1):
        progress(f"{k} of {len(dataset)}: {entry.name}")
        try:
            measured = _Measured.of(dataset, entry, planner)
            fft = FftTime.measured(planner, measured.pair.shape, SystemClock())
            found = measure_frontier(measured.case, options.plans, options.budget_s, options.repeats, progress, methods)
        except DiffuscopeError as error:
            left_out.append(left(entry.name, None, error, progress))
            continue
        frontiers.append(found)
        scores += _scores(entry.name, found, fft)
        left_out += found.left_out
        if peer is not None:
            try:
                scores += measured.peer_scores(peer, found.region.shift_px, fft, progress)
            except DiffuscopeError as error:
                left_out.append(left(entry.name, "LenslessPiCam", error, progress))
    if not frontiers:
        raise FrameError(
            f"no pair of {dataset.folder} can be measured: {'; '.join(map(str, left_out))}",
            "Give pairs with truths; `diffuscope data FOLDER --check` names what is missing.",
        )
    result = _joined(dataset.layout.title, options.budget_s, frontiers, scores, left_out)
    _write(options, result, draw_frontier(mean_frontier(result), methods))
    return result


def _joined(
    title: str, budget_s: float, frontiers: list[Frontier], scores: list[PairScore], left_out: list[LeftOut]
) -> DatasetFrontier:
    """Return the frontiers of all pairs of a data set, with the mean scores of each method."""
    return DatasetFrontier(
        this_machine(),
        versions(),
        title,
        tuple(found.scene for found in frontiers),
        FIT,
        RANGE,
        "mean of the channels",
        budget_s,
        _sorted(rows(scores)),
        tuple(left_out),
        tuple(frontiers),
    )


@dataclass(frozen=True)
class _Measured:
    """A pair that is read, and its case."""

    pair: Pair
    case: Case

    @classmethod
    def of(cls, dataset: Dataset, entry: Entry, planner: Planner) -> "_Measured":
        pair = dataset.read(entry)
        return cls(pair, case_of(pair, calibration_of(pair, planner), dataset.layout.aligned))

    def peer_scores(
        self, peer: LenslessPeer, shift: tuple[int, int], fft: FftTime, progress: ProgressCallback
    ) -> Iterator[PairScore]:
        """Yield the scores of the peer in the region and at the shift of the methods."""
        judge = PairScorer(self.case.truth, scored_region(self.case)[0], shift)
        pictures = peer(without_bad_pixels(self.pair.raw), self.case.calibration.psfs[0].pixels)
        for rounds, result in zip(peer.rounds, pictures, strict=True):
            times = fft.times(result.seconds)
            score = PairScore(self.pair.name, result.name, 1, rounds, *times, *judge(result.picture))
            progress(f"  {result.name}: {result.seconds:.3f} s, {score.psnr_db:.2f} dB")
            yield score


def _scores(pair: str, found: Frontier, fft: FftTime) -> list[PairScore]:
    """Return the scores of every point of one pair, and of the instrument's choice."""
    own = found.choice
    return [
        *(
            PairScore(pair, p.method, p.bin, p.rounds, *fft.times(p.seconds_median), p.psnr_db, p.ssim, p.pcc)
            for p in found.points
        ),
        PairScore(pair, CHOICE, 0, 0, *fft.times(own.solve_s), own.psnr_db, own.ssim, own.pcc),
    ]


def _sorted(found: Sequence[Row]) -> tuple[Row, ...]:
    return tuple(sorted(found, key=lambda row: row.seconds_median))


def mean_frontier(found: DatasetFrontier) -> Frontier:
    """Return the frontier that the plot shows: points of all pairs with median times and mean scores.

    The choice is that of the pair with the median PSNR.
    """
    common = set.intersection(*({_key(p) for p in frontier.points} for frontier in found.frontiers))
    groups = {
        key: [p for frontier in found.frontiers for p in frontier.points if _key(p) == key]
        for key in dict.fromkeys(map(_key, found.frontiers[0].points))
        if key in common
    }
    points = [_mean_point(group) for group in groups.values()]
    front = pareto_front([(p.seconds_median, p.psnr_db) for p in points])
    points = [replace(point, pareto=on) for point, on in zip(points, front, strict=True)]
    first = found.frontiers[0]
    kept = {point.method for point in points if point.pareto}
    return replace(
        first,
        scene=f"{found.data_set}, {len(found.frontiers)} pairs",
        points=tuple(points),
        best_mu=(),
        choice=_median_choice([frontier.choice for frontier in found.frontiers]),
        dominated=tuple(name for name in dict.fromkeys(p.method for p in points) if name not in kept),
    )


def _key(point: Point) -> tuple[str, int, int]:
    return point.method, point.bin, point.rounds


def _mean_point(group: Sequence[Point]) -> Point:
    first = group[0]
    return Point(
        first.method,
        first.bin,
        first.rounds,
        float(np.median([p.seconds_median for p in group])),
        float(np.median([p.seconds_p95 for p in group])),
        float(np.mean([p.pcc for p in group])),
        float(np.mean([p.psnr_db for p in group])),
        float(np.mean([p.ssim for p in group])),
        float(np.mean([p.highpass_pcc for p in group])),
        None,
    )


def _median_choice(choices: Sequence[Choice]) -> Choice:
    return sorted(choices, key=lambda choice: choice.psnr_db)[len(choices) // 2]


def dataset_table(found: DatasetFrontier) -> str:
    """Return the rows as text, from fast to slow, with the budget of the instrument's choice."""
    return f"{table(found.rows)}\n{CHOICE}: what the instrument chooses within {found.budget_s:g} s"


def _write(options: FrontierRequest, result: DatasetFrontier, picture: str) -> None:
    text = json.dumps(asdict(result), indent=1) + "\n"
    write_or_raise(options.json, lambda: options.json.write_text(text, encoding="utf-8"))
    write_or_raise(options.plot, lambda: options.plot.write_text(picture, encoding="utf-8"))
