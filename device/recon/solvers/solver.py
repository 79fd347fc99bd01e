"""Interface of a solver, and the figures that it reports: all that a method of one's own has to provide."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from device.recon.estimation.ghost import Ghost, GhostTrace
from device.recon.estimation.spots import Spots
from device.recon.estimation.uneven_light import UnevenLight
from device.recon.model.preprocessing import Linear
from device.values import Image

Figures = Mapping[str, float | None]


@dataclass(frozen=True)
class Diagnostics:
    """Parameters and figures of the last frame, for the report.

    What a solver does not know stays at its default. The keys of `quality` that the report interprets are
    in `assessment/quality_figures.py`.

    Attributes
    ----------
    noise_dn
        Standard deviation of the noise of one sample in DN; None if the solver does not estimate it, 0 for
        a frame without signal.
    residual
        Rms residual in units of the noise.
    regularisation
        Parameters, most of them chosen from the frame.
    quality
        Figures of frame and picture.
    find_spots
        Search for parts of the frame that no object explains, also after the next frame; None: it cannot be searched.
    unevenness
        Smooth part of the residual in units of its noise; None if it is unknown.
    find_uneven
        Search for what may be uneven in the light of the frame, the most probable first, also after the next frame;
        None: nothing is uneven.
    ghost_trace
        What the residual shows of a displaced second image; None if it is unknown.
    ghost
        A displaced second image; None: none, or not searched for.
    """

    noise_dn: float | None = None
    residual: float | None = None
    regularisation: Figures = field(default_factory=dict)
    quality: Figures = field(default_factory=dict)
    find_spots: Callable[[], Spots | None] | None = None
    unevenness: float | None = None
    find_uneven: Callable[[], Sequence[UnevenLight]] | None = None
    ghost_trace: GhostTrace | None = None
    ghost: Ghost | None = None


class Solver(Protocol):
    """Interface of a planned solver: input is a frame in linear DN, output a picture on the grid of its model.

    The caller calls `start`, `step` once per round, and `finish`, and thus controls the time; `start` begins the next
    frame. `solver_contract.check_method` tests an implementation.
    """

    @property
    def input_buffer(self) -> Image | None:
        """Array (the grid's window, float32, C order) to which the frame may be written directly; None: no such array.

        `start` need not copy a frame whose `y` is this array.
        """

    @property
    def diagnostics(self) -> Diagnostics:
        """Parameters and figures of the last frame, complete after `finish`."""

    def refocus(self) -> None:
        """Recompute all quantities that depend on the OTF of the model; called after the OTF has changed."""

    def start(self, frame: Linear) -> None:
        """Take a frame and compute the solution before the first round; a closed form is then complete."""

    def step(self) -> None:
        """Run one round of the iteration; not called for a closed form."""

    def finish(self, out: Image) -> None:
        """Write the picture to `out`: the shape of the grid, float32, linear DN, finite in every sample."""
