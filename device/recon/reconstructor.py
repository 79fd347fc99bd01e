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
from device.recon.prepare import Preparer
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
        self.planes: Image = np.zeros((1, *self.model.grid), np.float32)
        self.cost_s = 0.0

    def solve(self, counts: Pixels, dark: Pixels | None) -> dict[str, Any]:
        """Solve channel by channel into `planes`; one plan serves all, and the last one's facts are told."""
        channels = 1 if counts.ndim == 2 else counts.shape[2]
        if len(self.planes) != channels:
            self.planes = np.zeros((channels, *self.model.grid), np.float32)
        facts: dict[str, Any] = {}
        for c, plane in enumerate(self.planes):
            frame = self.preparer(_channel(counts, c), None if dark is None else _channel(dark, c))
            seen = {"saturated": frame.saturated, "missing": frame.missing, "mean_dn": float(frame.y.mean())}
            facts = self.solver.solve(frame, plane) | seen
        return facts

    @property
    def picture(self) -> Image:
        """What was solved last: (rows, cols) or (rows, cols, 3) of the grid."""
        return self.planes[0] if len(self.planes) == 1 else np.moveaxis(self.planes, 0, -1)


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
            report = rung.solve(counts, dark)
            rung.cost_s = self.clock.now_s() - start_s
            done = rung
            if watch is not None:
                watch(Stage(rung.recipe, rung.picture, last=rung is self.rungs[-1]))
        assert done is not None
        solved_s = self.clock.now_s()
        picture = upsample(done.picture, done.recipe.bin, self.shape, done.model.box)
        seconds = {"solve": solved_s - begin_s, "upsample": self.clock.now_s() - solved_s}
        return Reconstruction(picture, self._report(done, report, stopped, seconds), simulated)

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
    image = image if image.ndim == 2 else image[..., c]
    if image.dtype == np.uint16:
        return np.ascontiguousarray(image, np.uint16)
    return np.ascontiguousarray(image, np.float32)
