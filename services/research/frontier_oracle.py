"""Tikhonov regularisation at the best mu of the paper's range, selected by the truth; a reference for cross-validation.

The paper selects mu by eye from a small range; an instrument has no truth to compare with. The run time is that of one
solution with a given mu.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict

import numpy as np

from device.clock import Clock
from device.recon.assessment.metrics import Scores
from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resampling import to_sensor
from device.recon.solvers.wiener import TIKHONOV, ClosedForm
from device.values import Calibration, Image, Mask
from services.research.frontier_result import BestMu

MUS = tuple(float(mu) for mu in 10.0 ** np.arange(-6, -2.4, 0.5))  # the "predefined small range" of the paper


def best_mus(
    counts: Pixels,
    calibration: Calibration,
    planner: Planner,
    truth: Image,
    inside: Mask,
    bins: Iterable[int],
    score: Callable[[Image], Scores],
    moved: Callable[[Image], Image],
    clock: Clock,
) -> tuple[BestMu, ...]:
    """Return for each bin the mu of the highest correlation with the truth, and its scores.

    The result is empty for a colour frame. `counts`, `truth` and `inside` (the region of the correlation) are (rows,
    cols); `moved` registers a picture with the truth. The time of a bin is the median over the range of mu.
    """
    if counts.ndim != 2:
        return ()
    found = []
    for n in bins:
        seconds: list[float] = []
        pictures = ((mu, moved(picture)) for mu, picture in _pictures(counts, calibration, planner, n, clock, seconds))
        mu, picture = max(pictures, key=lambda candidate: float(np.corrcoef(candidate[1][inside], truth[inside])[0, 1]))
        found.append(BestMu("tikhonov", n, mu, float(np.median(seconds)), **asdict(score(picture))))
    return tuple(found)


def _pictures(
    counts: Pixels, calibration: Calibration, planner: Planner, n: int, clock: Clock, seconds: list[float]
) -> Iterator[tuple[float, Image]]:
    """Yield each mu of MUS with its solution at bin `n`, resampled to the sensor grid; append its time to `seconds`."""
    model = METHODS["tikhonov"].model(calibration, (counts.shape[0], counts.shape[1]), n, planner, 0)
    preparer = Preprocessor(calibration, model.grid)
    for mu in MUS:
        solver = ClosedForm(model, TIKHONOV, mu)
        out = np.zeros(model.grid.shape, np.float32)
        begin_s = clock.now_s()
        solver.start(preparer(counts))
        solver.finish(out)
        picture = to_sensor(out, model.grid)
        seconds.append(clock.now_s() - begin_s)
        yield mu, picture
