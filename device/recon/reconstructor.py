"""From counts to a picture in stages of rising cost: each shown at once, none begun that cannot finish in time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from device.clock import Clock, Deadline
from device.errors import FrameError, SettingError
from device.recon.closed import ClosedForm
from device.recon.kernels import Pixels
from device.recon.methods import DEFAULT, method_named
from device.recon.model import Model
from device.recon.plan import Planner
from device.recon.prepare import Linear, Preparer
from device.recon.upsample import upsample
from device.values import Calibration, Image, Reconstruction, Report, check_image_shape


@dataclass(frozen=True)
class Recipe:
    """One rung of the ladder: a method and how many sensor pixels make one sample, n x n."""

    method: str = DEFAULT
    bin: int = 1


@dataclass(frozen=True)
class Stage:
    """A picture on the way: the recipe that made it, (rows, cols) on its own binned grid, linear."""

    recipe: Recipe
    picture: Image
    last: bool


Watcher = Callable[[Stage], None]
QUICK, FULL = Recipe(bin=4), Recipe(bin=1)


class _Rung:
    """Everything that one recipe needs, planned: its preparer, its solver, its output."""

    def __init__(self, recipe: Recipe, calibration: Calibration, shape: tuple[int, int], planner: Planner, index: int):
        self.recipe = recipe
        self.preparer = Preparer(calibration, shape, recipe.bin)
        self.model = Model(calibration, shape, recipe.bin, planner, index)
        self.solver = ClosedForm(self.model, method_named(recipe.method).prior)
        self.picture: Image = np.zeros(self.model.grid, np.float32)
        self.cost_s = 0.0


class Reconstructor:
    """Plans once for a calibration and a sensor shape; then turns frames into pictures within a deadline.

    `recipes` run in order; the last is the wanted picture, those before it are quick looks. One thread at a time.
    """

    def __init__(
        self, calibration: Calibration, shape: tuple[int, int], planner: Planner, clock: Clock,
        recipes: tuple[Recipe, ...] = (QUICK, FULL), psf_index: int = 0,
    ) -> None:  # fmt: skip
        if not recipes or min(recipe.bin for recipe in recipes) < 1:
            raise SettingError("a reconstruction needs a recipe, with a bin of 1 or more")
        self.calibration, self.shape, self.clock, self.psf_index = calibration, shape, clock, psf_index
        self.rungs = [_Rung(recipe, calibration, shape, planner, psf_index) for recipe in recipes]
        self._warm_up()

    def _warm_up(self) -> None:
        """Run once on noise, so that the first press meets compiled code, touched memory and a known cost."""
        noise = np.random.default_rng(0).integers(0, 200, self.shape, dtype=np.uint16)
        self(noise)
        self(noise)

    def __call__(
        self, counts: Pixels, dark: Pixels | None = None, *, simulated: bool = False,
        deadline: Deadline | None = None, watch: Watcher | None = None,
    ) -> Reconstruction:  # fmt: skip
        """The best picture that fits: linear float32, rows x cols (x 3) of the sensor.

        `counts` and `dark` are uint16 or float32 (rows, cols) or (rows, cols, 3). The first rung always runs.
        """
        check_image_shape(counts.shape)
        if counts.shape[:2] != self.shape:
            raise FrameError(
                f"the frame has {counts.shape[:2]} pixels, the calibration {self.shape}", "Use the head's own PSF."
            )
        begin_s, done, stopped, report = self.clock.now_s(), None, "done", {}
        for rung in self.rungs:
            if done is not None and deadline is not None and not deadline.fits(rung.cost_s):
                stopped = "deadline"
                break
            start_s = self.clock.now_s()
            report = self._run(rung, counts, dark)
            rung.cost_s = self.clock.now_s() - start_s
            done = rung
            if watch is not None:
                watch(Stage(rung.recipe, self._result(rung, counts.ndim), last=rung is self.rungs[-1]))
        assert done is not None
        solved_s = self.clock.now_s()
        picture = upsample(self._result(done, counts.ndim), done.recipe.bin, self.shape)
        seconds = {"solve": solved_s - begin_s, "upsample": self.clock.now_s() - solved_s}
        return Reconstruction(picture, self._report(done, report, stopped, seconds), simulated)

    def _run(self, rung: _Rung, counts: Pixels, dark: Pixels | None) -> dict[str, Any]:
        if counts.ndim == 2:
            return self._solve(rung, counts, dark, rung.picture)
        if rung.picture.shape != (3, *rung.model.grid):
            rung.picture = np.zeros((3, *rung.model.grid), np.float32)
        facts = {}
        for c in range(3):  # one plan serves all three channels; the last one's facts are reported
            facts = self._solve(rung, _channel(counts, c), None if dark is None else _channel(dark, c), rung.picture[c])
        return facts

    @staticmethod
    def _solve(rung: _Rung, counts: Pixels, dark: Pixels | None, out: Image) -> dict[str, Any]:
        frame: Linear = rung.preparer(counts, dark)
        facts = rung.solver.solve(frame, out)
        return facts | {"saturated": frame.saturated, "missing": frame.missing, "mean_dn": float(frame.y.mean())}

    @staticmethod
    def _result(rung: _Rung, ndim: int) -> Image:
        return rung.picture if ndim == 2 else np.moveaxis(rung.picture, 0, -1)

    def _report(self, rung: _Rung, facts: dict[str, Any], stopped: str, seconds: dict[str, float]) -> Report:
        quality = {key: facts[key] for key in ("saturated", "missing", "mean_dn")}
        warnings = []
        if facts["noise_dn"] == 0:
            warnings.append("There is no signal in this frame.")
        if facts["saturated"] > 0.001:
            warnings.append(f"{facts['saturated']:.1%} of the pixels are too bright.")
        chosen = {key: facts[key] for key in ("mu", "gcv", "psf_error", "flat_dn", "background_dn")}
        return Report(
            method=rung.recipe.method, bin=rung.recipe.bin, stopped=stopped, seconds=seconds,
            psf_index=self.psf_index, regularisation=chosen, noise_dn=facts["noise_dn"] * rung.recipe.bin,
            residual=facts["residual"], quality=quality, warnings=tuple(warnings),
        )  # fmt: skip


def _channel(image: Pixels, c: int) -> Pixels:
    if image.dtype == np.uint16:
        return np.ascontiguousarray(image[..., c], np.uint16)
    return np.ascontiguousarray(image[..., c], np.float32)
