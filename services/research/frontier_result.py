"""Result of a frontier measurement and its text as JSON, whose keys are the fields in this order; the Pareto front."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf

from services.research.pair_scores import LeftOut


@dataclass(frozen=True)
class Machine:
    """Computer of a measurement; `cpu` is empty and `cores` None if unknown."""

    cpu: str
    cores: int | None
    system: str
    fft_threads: int


@dataclass(frozen=True)
class FrameSize:
    """Size of the frame in pixels."""

    rows: int
    cols: int


@dataclass(frozen=True)
class ScoredRegion:
    """Scored region of the frame and settings of the scores.

    `what`: description of the region, with `pixels` pixels; `field_known`: it is that of the known illuminated field.
    `truth_variance`: of the truth, scaled to the range 0 to 1.
    `shift_px`: (rows, cols) by which every picture is moved back. `truth_vessel_contrast` is None if the vessels are
    unknown. `intensity_fit`, `psnr_range` and `ssim` describe the scores in words.
    """

    what: str
    field_known: bool
    pixels: int
    intensity_fit: str
    psnr_range: str
    truth_variance: float
    ssim: str
    highpass_sigma_px: float
    shift_px: tuple[int, int]
    truth_vessel_contrast: float | None


@dataclass(frozen=True)
class Point:
    """One method, bin (bin x bin pixels per sample) and number of rounds run (0: closed form) with scores and times.

    `pareto`: no other point is at least as fast and at least as accurate (PSNR), and better in one of both.
    """

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


@dataclass(frozen=True)
class LightPoint:
    """Burst of `frames` frames as the instrument solves it, with its dose, median time and scores.

    `used`: frames that entered the picture. `dose_j_per_cm2`: retinal dose of all frames, weighted with the
    photochemical hazard; in the worst case where the head's light is not measured. `bound_psnr_db`: of the oracle's
    Wiener filter on a frame of a still eye with as much light. The time includes that of the refraction.
    """

    frames: int
    used: int
    dose_j_per_cm2: float
    seconds_median: float
    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None
    bound_psnr_db: float

    @property
    def length(self) -> str:
        """Number of frames in words: `1 frame`, `2 frames`."""
        return f"{self.frames} frame{'s' if self.frames > 1 else ''}"


@dataclass(frozen=True)
class PressPoint:
    """What a press makes of its lit frames in green with one choice of the time budget, `budget_s`, named `choice`.

    `frames`: lit frames that it takes. `method`, `bin`, `rounds`: of the picture. `seconds_median`: from the last
    read-out to the picture in green, with the refraction (`measure_presses`). `within_budget`: in every run.
    """

    choice: str
    budget_s: float
    frames: int
    method: str
    bin: int
    rounds: int
    seconds_median: float
    within_budget: bool
    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None


@dataclass(frozen=True)
class PeerPoint:
    """Picture of a peer on the same frame: its name with version and rounds, time in seconds and scores."""

    name: str
    seconds: float
    pcc: float
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class BestMu:
    """Best mu of a method at one bin, selected by the truth, with the median time of a solution and its scores."""

    method: str
    bin: int
    mu: float
    seconds_median: float
    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None


@dataclass(frozen=True)
class Choice:
    """The instrument's choice within the time budget: settings, times in seconds and scores.

    `stopped`: reason of the end. `within_budget`: of every run. `solve_s`: median time without `refract_s`, that of the
    refraction. `db_below_edge`: PSNR below that of the best point which is at least as fast, dB, not negative.
    """

    method: str
    bin: int
    rounds: int
    stopped: str
    seconds_median: float
    seconds_p95: float
    within_budget: bool
    refract_s: float
    solve_s: float
    db_below_edge: float
    pcc: float
    psnr_db: float
    ssim: float
    highpass_pcc: float
    vessel_contrast: float | None


@dataclass(frozen=True)
class Frontier:
    """Points of one scene on one machine, and the instrument's choice within a time budget.

    Attributes
    ----------
    machine
        Computer of the measurement.
    versions
        Versions of the program and its libraries, by name.
    scene
        Name of the scene or of the frame.
    simulated
        True for a frame of the simulator.
    frame
        Size of the frame in pixels.
    region
        Part of the picture that is scored.
    timing
        How times were measured, in words.
    fft_pair_s
        Duration of one planned FFT pair of the frame's size in s.
    edge
        What the Pareto front is, in words.
    points
        Each method, bin and number of rounds with time and scores.
    best_mu
        Best regularisation of each closed form; empty for a colour frame.
    budget_s
        Time budget of the choice in s.
    choice
        What the instrument chooses within the budget.
    dominated
        Methods without a point on the Pareto front.
    light
        Bursts of a scene, from one frame on; empty for a recorded frame.
    presses
        What a press does with each choice of the time budget; empty for a recorded frame.
    left_out
        Points without a result, with the reason.
    peers
        Other people's solvers on the same frame.
    """

    machine: Machine
    versions: Mapping[str, str]
    scene: str
    simulated: bool
    frame: FrameSize
    region: ScoredRegion
    timing: str
    fft_pair_s: float
    edge: str
    points: tuple[Point, ...]
    best_mu: tuple[BestMu, ...]
    budget_s: float
    choice: Choice
    dominated: tuple[str, ...]
    light: tuple[LightPoint, ...] = ()
    presses: tuple[PressPoint, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    peers: tuple[PeerPoint, ...] = ()


def pareto_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each (cost, worth) whether it is on the Pareto front.

    A pair dominates another if its cost is at most as high, its worth at least as high, and one of both is better.
    """
    order = sorted(range(len(points)), key=lambda k: (points[k][0], -points[k][1]))
    on = [False] * len(points)
    best = -inf
    at_s = -inf
    for k in order:
        cost, worth = points[k]
        on[k] = worth > best or (worth == best and cost == at_s)  # equal pairs do not dominate each other
        if worth > best:
            best, at_s = worth, cost
    return on


def frontier_text(found: Frontier) -> str:
    """Return the content of the JSON file of a measurement."""
    return json.dumps(asdict(found), indent=1) + "\n"
