"""A stage of a reconstruction: one method at one bin, with its planned resources and its measured costs."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isinf

import numpy as np

from device.recon.durations import DurationEstimate, Pace
from device.recon.estimation.psf_warp import Wavefront
from device.recon.estimation.sensor_lines import EvenFrame
from device.recon.frames import without_sensor
from device.recon.methods import DEFAULT, Method
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.kernels import Places
from device.recon.model.preprocessing import Linear, Preprocessor
from device.recon.model.resolution import STOPBAND_SHARE, STOPBAND_SHARE_OPEN, STOPBAND_SHARE_SPOTS, working_bin
from device.recon.solvers.solver import Diagnostics, Solver
from device.values import Calibration, Image, Reconstruction

RESERVED_ROUNDS = 6  # kept free for the last stage: half of the 12 of `variation` lose just 0.02 dB


@dataclass(frozen=True)
class Recipe:
    """Settings of one stage.

    Attributes
    ----------
    method
        Name of the method.
    bin
        bin x bin sensor pixels become one sample.
    rounds
        Largest number of rounds; None: the default of the method.
    settings
        Names and values of the method's settings; what is not set is chosen from the frame.
    """

    method: str = DEFAULT
    bin: int = 1
    rounds: int | None = None
    settings: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class StageResult:
    """Result of one stage.

    Attributes
    ----------
    recipe
        Settings of the stage.
    picture
        Shown part of its picture, linear, on its grid.
    last
        True for the last stage.
    """

    recipe: Recipe
    picture: Image
    last: bool


@dataclass(frozen=True)
class Solved:
    """The last frame that a solver has solved, and its diagnostics."""

    frame: Linear
    diagnostics: Diagnostics

    @property
    def has_light(self) -> bool:
        """True if the mean is above black, and has noise."""
        return self.frame.mean_dn > 0 and self.diagnostics.noise_dn != 0

    @property
    def quality(self) -> dict[str, float | None]:
        """Figures of the frame and of the solver by their names in a report."""
        figures = {"saturated": self.frame.saturated, "missing": self.frame.missing, "mean_dn": self.frame.mean_dn}
        return {**figures, **self.diagnostics.quality}


@dataclass(frozen=True)
class QuickLook:
    """The first stage of a frame, from which `Reconstructor.steps` of the same frame goes on.

    Attributes
    ----------
    stage
        Its result.
    planes
        Its whole picture (channels, rows, cols) on its grid.
    solved
        The frame and the diagnostics.
    defects
        Flat indices of the defective pixels of each channel, None if there are none.
    even
        Counts without faults of rows and columns.
    """

    stage: StageResult
    planes: Image
    solved: Solved
    defects: Mapping[int, Places | None]
    even: EvenFrame


@dataclass(frozen=True)
class RoundDone:
    """A round of the last stage is done, or a frame of a burst joined: the consumer may do other work meanwhile."""


ROUND_DONE = RoundDone()
Step = StageResult | RoundDone | Reconstruction  # what `Reconstructor.steps` yields


def default_schedule(calibration: Calibration, shape: tuple[int, int], index: int = 0) -> tuple[Recipe, Recipe]:
    """Return the two default stages: a quick look, then the best picture at the resolution of the optics.

    `shape` is (rows, cols) of the sensor, `index` the PSF. With a known field the methods are `evidence` and
    `variation`, otherwise `gradient` and `open`. The second stage uses `working_bin`, reduced until the shorter side
    has at least 64 samples; the first uses twice that bin, or the same if the side would have fewer than 16.
    """
    is_open = isinf(field_radius_px(calibration))
    known = STOPBAND_SHARE_SPOTS if calibration.has_spots else STOPBAND_SHARE
    n = working_bin(calibration.psfs[index], STOPBAND_SHARE_OPEN if is_open else known)
    while n > 1 and min(shape) // n < 64:
        n -= 1
    coarse = 2 * n if min(shape) // (2 * n) >= 16 else n
    if is_open:
        return Recipe("gradient", coarse), Recipe("open", n)
    return Recipe("evidence", coarse), Recipe("variation", n)


class Stage:
    """Planned resources of one stage: forward model, preprocessor, solver, output arrays and cost estimates."""

    def __init__(
        self,
        recipe: Recipe,
        method: Method,
        calibration: Calibration,
        shape: tuple[int, int],
        planner: Planner,
        index: int,
        pace: Pace,
    ) -> None:
        self.recipe = recipe
        self.is_closed_form = method.rounds == 0
        self.model = method.model(calibration, shape, recipe.bin, planner, index)
        self.grid = self.model.grid
        self.eye: Wavefront | None = None  # of the PSF in use; None: the stored one
        self.solver: Solver = method.solver(self.model, calibration, planner, dict(recipe.settings))
        self.preparer = Preprocessor(calibration, self.grid, self.solver.input_buffer)
        self.joined_preparer = Preprocessor(without_sensor(calibration), self.grid, self.solver.input_buffer)
        self.most = method.rounds if recipe.rounds is None else recipe.rounds
        self.planes: Image = np.zeros((1, *self.grid.shape), np.float32)
        self.pace = pace
        self.forget_costs()

    def forget_costs(self) -> None:
        """Forget the durations of the steps."""
        self.start_cost = DurationEstimate(self.pace)
        self.round_cost = DurationEstimate(self.pace)
        self.end_cost = DurationEstimate(self.pace)  # of the solver, for one channel
        self.finish_cost = DurationEstimate(self.pace)  # of the picture on the sensor's grid and its report, for all

    def refocus(self, otf: Spectrum, eye: Wavefront | None) -> None:
        """Use `otf`, the OTF of the PSF of `eye`, from the next `solver.start` on; no-op if in use."""
        self.eye = eye
        if otf is not self.model.otf:
            self.model.refocus(otf)
            self.solver.refocus()

    @property
    def picture(self) -> Image:
        """Last solution: (rows, cols) or (rows, cols, 3) of the grid."""
        return self.planes[0] if len(self.planes) == 1 else np.moveaxis(self.planes, 0, -1)

    @property
    def least_s(self) -> float:
        """Estimated minimum duration for one channel, seconds: start, one round, end and finish."""
        ends_s = self.end_cost.seconds + self.finish_cost.seconds
        return self.start_cost.seconds + self.round_cost.seconds + ends_s

    @property
    def reserved_s(self) -> float:
        """Estimated duration for one channel with the rounds that refraction and joining must leave time for."""
        return self.least_s + max(min(RESERVED_ROUNDS, self.most) - 1, 0) * self.round_cost.typical_s

    def skipped(self, left_s: float) -> None:
        """Reduce the cost estimates after the stage was skipped because `left_s` seconds are too few."""
        costs = self.start_cost, self.round_cost, self.end_cost, self.finish_cost
        usually_fits = sum(cost.typical_s for cost in costs) <= left_s
        for cost in costs:
            cost.skipped(usually_fits)

    @property
    def shown(self) -> Image:
        """The field of view in the picture: `picture` cropped to `grid.shown`."""
        return self.picture[self.grid.shown]
