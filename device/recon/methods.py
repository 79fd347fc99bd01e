"""Table of the built-in deconvolution methods: name, description, cost in FFT pairs, memory (`diffuscope methods`).

The methods of installed packages are added by `installed_methods`, and only where a researcher's command asks for them.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from device.errors import SettingError
from device.recon.method_settings import (
    MU,
    PRIOR_LOG_POWER,
    PRIOR_SLOPE,
    TAU,
    ConfigurableSolver,
    Setting,
    Settings,
    check_settings,
)
from device.recon.model.fft_plans import Planner, RealFft
from device.recon.model.forward_model import Model, periodic_model, tight_model
from device.recon.model.grid import Grid, Pair
from device.recon.solvers.solver import Solver
from device.recon.solvers.tv import EvidenceWiener, TotalVariation
from device.recon.solvers.tv_open_field import OpenFieldTotalVariation
from device.recon.solvers.wiener import GRADIENT, TIKHONOV, ClosedForm
from device.values import Calibration


@dataclass(frozen=True)
class Method:
    """Description of one method: name, one sentence, cost in real FFT pairs, and the constructor of its solver.

    An FFT pair is one forward and one inverse FFT.

    Attributes
    ----------
    name
        Name of the method.
    sentence
        What it does, in one sentence.
    build
        Constructor of the solver, called once per stage, before the first frame.
    start_pairs
        FFT pairs of `Solver.start`.
    round_pairs
        FFT pairs of each round; 0 for a closed form.
    rounds
        Default number of rounds; 0 for a closed form.
    images
        Number of float32 arrays of the grid's shape that the solver holds.
    periodic
        True: the grid has the size of the sensor (`periodic_model`). False: it has a margin
        (`tight_model`).
    settings
        Parameters that a user may set; the solver of a method with settings has `configure`.
    """

    name: str
    sentence: str
    build: Callable[[Model, Calibration, Planner], Solver]
    start_pairs: int = 1
    round_pairs: int = 0
    rounds: int = 0
    images: int = 6
    periodic: bool = False
    settings: tuple[Setting, ...] = ()

    def solver(self, model: Model, calibration: Calibration, planner: Planner, settings: Settings) -> Solver:
        """Return the planned solver with these settings.

        Parameters
        ----------
        model
            Forward model of the stage.
        calibration
            Calibration of the model.
        planner
            Planner of the FFTs.
        settings
            Values by name.

        Returns
        -------
        Solver
            Solver, planned for the grid of `model`.

        Raises
        ------
        SettingError
            A name is unknown, or a value out of range.
        """
        check_settings(self.name, self.settings, settings)
        solver = self.build(model, calibration, planner)
        if settings:
            if not isinstance(solver, ConfigurableSolver):
                raise SettingError(f"the solver of '{self.name}' takes no settings", "Leave the settings out.")
            solver.configure(settings)
        return solver

    def model(self, calibration: Calibration, shape: Pair, n: int, planner: Planner, index: int) -> Model:
        """Return the forward model of the method for a sensor.

        Parameters
        ----------
        calibration
            Calibration with the PSF and the lit field.
        shape
            (rows, cols) of the sensor in pixels.
        n
            n x n pixels become one sample.
        planner
            Planner of the FFTs.
        index
            Index of the PSF in the calibration.

        Returns
        -------
        Model
            Forward model on the grid of the method.
        """
        return (periodic_model if self.periodic else tight_model)(calibration, shape, n, planner, index)

    @property
    def fft_pairs(self) -> int:
        """Number of real FFT pairs (forward plus inverse) of a solution with all `rounds` rounds."""
        return self.start_pairs + self.rounds * self.round_pairs

    def memory_bytes(self, grid: Grid) -> int:
        """Return the bytes of all arrays on a grid.

        Parameters
        ----------
        grid
            Grid of the stage.

        Returns
        -------
        int
            Bytes of dark, gain and picture of the sensor, the FFT plans and the images of the solver.
        """
        sensor = 4 * grid.sensor[0] * grid.sensor[1]
        plans = (1 + (self.round_pairs > 0)) * RealFft.memory_bytes(grid.shape)
        return 3 * sensor + plans + 4 * self.images * grid.size


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(
            "tikhonov",
            "the paper's closed form: periodic, L2 prior, mu by cross-validation",
            lambda model, _, __: ClosedForm(model, TIKHONOV),
            start_pairs=1,
            images=6,
            periodic=True,
            settings=(MU,),
        ),
        Method(
            "gradient",
            "flat field taken out first, gradient prior with an L2 floor, mu by cross-validation",
            lambda model, _, __: ClosedForm(model, GRADIENT),
            start_pairs=1,
            images=6,
            settings=(MU,),
        ),
        Method(
            "evidence",
            "shading taken out first, Wiener filter with the prior that the frame's evidence supports",
            lambda model, calibration, _: EvidenceWiener(model, calibration),
            start_pairs=2,
            images=12,
            settings=(PRIOR_SLOPE, PRIOR_LOG_POWER),
        ),
        Method(
            "variation",
            "crop-aware, noise-weighted total variation, positive; starts from `evidence`",
            lambda model, calibration, planner: TotalVariation(model, calibration, planner),
            start_pairs=3,
            round_pairs=2,
            rounds=TotalVariation.rounds,
            images=22,
            settings=(TAU, PRIOR_SLOPE, PRIOR_LOG_POWER),
        ),
        Method(
            "open",
            "the same where no field is known: weights and tau from what the frame itself leaves open",
            lambda model, calibration, planner: OpenFieldTotalVariation(model, calibration, planner),
            start_pairs=4,
            round_pairs=2,
            rounds=OpenFieldTotalVariation.rounds,
            images=22,
            settings=(TAU, PRIOR_SLOPE, PRIOR_LOG_POWER),
        ),
    )
}
DEFAULT = "variation"


def method_named(name: str, methods: Mapping[str, Method] = METHODS) -> Method:
    """Return the method with that name from a table; SettingError lists the names of the table."""
    if name not in methods:
        raise unknown_method_error(name, methods)
    return methods[name]


def unknown_method_error(name: str, known: Iterable[str]) -> SettingError:
    """Return the error for a method that does not exist; its remedy lists the `known` names."""
    return SettingError(f"there is no method '{name}'", f"Choose one of: {', '.join(known)}.")
