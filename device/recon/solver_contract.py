"""Contract of a method: what every solver must fulfil, as one function for the tests of a plug-in.

    from device.recon.solver_contract import check_method

    def test_my_method() -> None:
        check_method(METHOD)

The frames are synthetic: a uniform object of a known level in DN behind a PSF of random points, with noise of 1 %. The
thresholds hold for every built-in method.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from device.recon.installed_methods import NEEDED
from device.recon.methods import Method
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics, Solver
from device.values import Calibration, Image, Psf, Sensor

SHAPES = ((48, 64), (45, 63))  # of the sensor; even and odd
LEVEL_DN = 800.0  # mean of the object
NOISE = 0.01  # of the mean
SCALE_ERROR = 0.15  # of the picture's mean in the middle of the frame, relative to the object's
REPEAT_ERROR = 1e-4  # of the second picture of a frame, relative to the mean


@dataclass(frozen=True)
class _Planned:
    """Planned solver, its model, one frame (`light`, linear DN on the window) and the number of rounds."""

    solver: Solver
    model: Model
    light: Image
    rounds: int

    def solve(self, factor: float = 1.0) -> Image:
        """Return the picture of the frame times `factor`; the array is new and was NaN before `finish`."""
        y = self.light * np.float32(factor)
        self.solver.start(Linear(y, np.ones_like(y), float(y.mean()), saturated=0.0, missing=0.0))
        for _ in range(self.rounds):
            self.solver.step()
        out = np.full(self.model.grid.shape, np.nan, np.float32)
        self.solver.finish(out)
        return out


def check_method(method: Method) -> None:
    """Run a method on small synthetic frames; AssertionError with one sentence for the first violation.

    Checked for an even and an odd shape: every sample of the picture (grid, float32) is written and finite; the picture
    is in linear DN, so that a uniform object keeps its level and half the light gives half the picture; a second frame
    does not depend on the first; a frame without light gives a finite picture; `diagnostics` are `Diagnostics`.
    """
    for planned in _cases(method):
        first = planned.solve()
        _require(bool(np.isfinite(first).all()), "every sample of `out` is written and finite", method)
        _require(isinstance(planned.solver.diagnostics, Diagnostics), "`diagnostics` is a `Diagnostics`", method)
        level_dn = _level_dn(planned.model, first)
        _require(
            abs(level_dn / LEVEL_DN - 1) < SCALE_ERROR,
            f"the picture is in linear DN: an object of {LEVEL_DN:g} DN became {level_dn:.4g} DN",
            method,
        )
        half_dn = _level_dn(planned.model, planned.solve(0.5))
        _require(
            abs(half_dn / level_dn - 0.5) < SCALE_ERROR / 2,
            f"half the light gives half the picture, not {half_dn / level_dn:.3f} of it",
            method,
        )
        _require(bool(np.isfinite(planned.solve(0.0)).all()), "a frame without light gives a finite picture", method)
        again = float(np.abs(planned.solve() - first).max()) / LEVEL_DN
        _require(again < REPEAT_ERROR, f"a frame gives the same picture again; it changed by {again:.2g}", method)
        planned.model.refocus(planned.model.stored.copy())
        planned.solver.refocus()
        again = float(np.abs(planned.solve() - first).max()) / LEVEL_DN
        _require(again < REPEAT_ERROR, f"an equal OTF gives the same picture; it changed by {again:.2g}", method)


def _cases(method: Method) -> Iterator[_Planned]:
    rng = np.random.default_rng(0)
    planner = Planner(None, effort="FFTW_ESTIMATE", threads=1)
    for shape in SHAPES:
        calibration = Calibration((Psf(_psf(shape, rng)),), Sensor())
        model = method.model(calibration, shape, 1, planner, 0)
        light = model.blur(model.mask)[model.grid.slices] * np.float32(LEVEL_DN)
        light *= 1 + np.float32(NOISE) * rng.standard_normal(model.grid.window, np.float32)
        solver = method.build(model, calibration, planner)
        missing = [name for name in NEEDED if not hasattr(solver, name)]
        _require(not missing, f"its solver has all of the interface Solver, also {' and '.join(missing)}", method)
        yield _Planned(solver, model, light, method.rounds)


def _psf(shape: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return a PSF of 40 random points within an eighth of the shorter side around the centre, with unit sum."""
    psf = np.zeros(shape, np.float32)
    reach = min(shape) // 8
    rows, cols = rng.integers(-reach, reach + 1, (2, 40))
    np.add.at(psf, (shape[0] // 2 + rows, shape[1] // 2 + cols), 1 / 40)
    return psf


def _level_dn(model: Model, picture: Image) -> float:
    """Return the mean of the picture over the middle half of the sensor, DN."""
    rows, cols = model.grid.window
    shown = picture[model.grid.slices]
    return float(shown[rows // 4 : -(rows // 4), cols // 4 : -(cols // 4)].mean(dtype=np.float64))


def _require(holds: bool, rule: str, method: Method) -> None:
    if not holds:
        raise AssertionError(f"{method.name}: {rule}")
