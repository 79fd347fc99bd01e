"""The paper's closed form at the best weight of the paper's range, chosen by the truth: beside cross-validation.

The paper picks mu by eye from a small range; an instrument cannot, because nobody knows the truth of its frame. The
time is that of `tikhonov` without its cross-validation, so it is not measured again.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from device.recon.closed import TIKHONOV, ClosedForm
from device.recon.kernels import Pixels
from device.recon.methods import METHODS
from device.recon.metrics import Scores
from device.recon.plan import Planner
from device.recon.prepare import Preparer
from device.recon.upsample import to_sensor
from device.values import Calibration, Image, Mask

MUS = tuple(float(mu) for mu in 10.0 ** np.arange(-6, -2.4, 0.5))  # the paper's "predefined small range"


def best_mus(
    counts: Pixels,
    calibration: Calibration,
    planner: Planner,
    truth: Image,
    inside: Mask,
    bins: Iterable[int],
    score: Callable[[Image], Scores],
    moved: Callable[[Image], Image],
) -> list[dict[str, Any]]:
    """The best mu of each bin, by the correlation with the truth inside, and its scores; none for a frame in colours.

    `counts`, `truth` and `inside` are (rows, cols); `moved` brings a picture onto the truth.
    """
    if counts.ndim != 2:
        return []
    found = []
    for n in bins:
        pictures = ((mu, moved(picture)) for mu, picture in _pictures(counts, calibration, planner, n))
        mu, picture = max(pictures, key=lambda one: float(np.corrcoef(one[1][inside], truth[inside])[0, 1]))
        found.append({"method": "tikhonov", "bin": n, "mu": mu, **asdict(score(picture))})
    return found


def _pictures(counts: Pixels, calibration: Calibration, planner: Planner, n: int) -> Iterator[tuple[float, Image]]:
    """The solution of each weight on the sensor's grid."""
    model = METHODS["tikhonov"].model(calibration, (counts.shape[0], counts.shape[1]), n, planner, 0)
    preparer = Preparer(calibration, model.grid)
    for mu in MUS:
        solver, out = ClosedForm(model, TIKHONOV, mu), np.zeros(model.grid.shape, np.float32)
        solver.start(preparer(counts))
        solver.finish(out)
        yield mu, to_sensor(out, model.grid)
