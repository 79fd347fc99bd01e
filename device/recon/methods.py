"""The solvers by name, with what they cost: asked before they run, printed by `diffuscope methods`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from device.errors import SettingError
from device.recon.closed import GRADIENT, TIKHONOV, ClosedForm
from device.recon.geometry import Grid, Pair
from device.recon.model import Model, periodic_model, tight_model
from device.recon.openfield import OpenField
from device.recon.plan import Planner, RealFft
from device.recon.prepare import Linear
from device.recon.variation import EvidenceWiener, Variation
from device.values import Calibration, Image


class Solver(Protocol):
    """One planned way from a linear frame to a picture; the caller owns the loop, and so the clock.

    `inbox` is where it would like to find the frame, if it matters to it: there nothing has to be copied.
    """

    model: Model
    inbox: Image | None
    facts: dict[str, Any]
    rounds: int

    def refocus(self) -> None:
        """Measure anew what depends on the model's OTF, which has changed."""

    def start(self, frame: Linear) -> None:
        """Take a frame and make a first picture."""

    def step(self) -> None:
        """Make it better by one round; called at most `rounds` times."""

    def finish(self, out: Image) -> None:
        """Write the picture on the grid into `out`."""


@dataclass(frozen=True)
class Method:
    """A way from a frame to a picture: its name, one sentence, its cost in real FFT pairs, and how it is built.

    `start_pairs` are those of the first picture, `round_pairs` those of each of `rounds` further rounds; `images`
    counts the float32 arrays of the grid that it holds.
    """

    name: str
    sentence: str
    start_pairs: int
    round_pairs: int
    rounds: int
    images: int
    periodic: bool
    build: Callable[[Model, Calibration, Planner], Solver]

    def model(self, calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
        """The model that it works on."""
        return (periodic_model if self.periodic else tight_model)(calibration, shape, n, planner, index)

    @property
    def fft_pairs(self) -> int:
        """All FFT pairs of a full solution."""
        return self.start_pairs + self.rounds * self.round_pairs

    def memory_bytes(self, grid: Grid) -> int:
        """What its arrays take on a grid: dark, gain and picture of the sensor, the plans, and its own images."""
        sensor = 4 * grid.sensor[0] * grid.sensor[1]
        plans = (1 + (self.round_pairs > 0)) * RealFft.memory_bytes(grid.shape)
        return 3 * sensor + plans + 4 * self.images * grid.size


METHODS = {
    method.name: method
    for method in (
        Method(
            "tikhonov", "the paper's closed form: periodic, L2 prior, mu by cross-validation",
            1, 0, 0, 6, True, lambda model, _, __: ClosedForm(model, TIKHONOV),
        ),
        Method(
            "gradient", "flat field taken out first, gradient prior with an L2 floor, mu by cross-validation",
            1, 0, 0, 6, False, lambda model, _, __: ClosedForm(model, GRADIENT),
        ),
        Method(
            "evidence", "shading taken out first, Wiener filter with the prior that the frame's evidence supports",
            2, 0, 0, 12, False, lambda model, calibration, _: EvidenceWiener(model, calibration),
        ),
        Method(
            "variation", "crop-aware, noise-weighted total variation, positive; starts from `evidence`",
            3, 2, Variation.rounds, 22, False,
            lambda model, calibration, planner: Variation(model, calibration, planner),
        ),
        Method(
            "open", "the same where no field is known: weights and tau from what the frame itself leaves open",
            4, 2, OpenField.rounds, 22, False,
            lambda model, calibration, planner: OpenField(model, calibration, planner),
        ),
    )
}  # fmt: skip
DEFAULT = "variation"


def method_named(name: str) -> Method:
    """The method of that name; SettingError lists what there is."""
    if name not in METHODS:
        raise SettingError(f"there is no method '{name}'", f"Choose one of: {', '.join(METHODS)}.")
    return METHODS[name]
