"""Search for the cylinder of an eye: M, J0 and J45 of the highest likelihood, from the M of `estimator` on.

The fine structure of |H|^2 is stretched differently along the two meridians. Without a cylinder in the model M itself
is off where the eye has one (NUMERICS.md 7).
"""

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.refraction.edge import Candidate, EdgeLikelihood
from device.recon.estimation.refraction.uncertainty import Quadratic, quadratic_model

CIRCLES_DPT = (0.7, 1.4)  # |J| of the first candidates
AXES = 8
STEPS_DPT = (0.5, 0.3)  # of descent and quadratic model, in this order
MAX_DESCENTS = 6
MAX_CYLINDER_DPT = 3.0  # |J|

Floats = NDArray[np.float64]


def find_cylinder(edges: EdgeLikelihood, m_dpt: float, blocks: NDArray[np.int64]) -> Quadratic | None:
    """Return the quadratic model of the likelihood at the best M, J0 and J45; None without a clear minimum.

    `edges` is the likelihood of a frame whose field edge was found with `m_dpt`; the edge is estimated further.
    """
    turns = 2 * np.pi * np.arange(AXES) / AXES
    first = [np.array([m_dpt, 0.0, 0.0])]
    first += [np.array([m_dpt, j_dpt * np.cos(turn), j_dpt * np.sin(turn)]) for j_dpt in CIRCLES_DPT for turn in turns]
    near = _Near(edges, first[0])
    eye_dpt = min(first, key=lambda eye_dpt: near(eye_dpt).nats)
    for step_dpt in STEPS_DPT:
        edges.fit_smooth(eye_dpt)
        near = _Near(edges, eye_dpt)
        lowest_dpt = _descend(near, eye_dpt, step_dpt)
        if lowest_dpt is not eye_dpt:
            near = _Near(edges, lowest_dpt)  # the Hessian needs the linear model of the edge at its own place
        found = quadratic_model(near, lowest_dpt, step_dpt, blocks)
        eye_dpt = found.minimum
        if not found.is_minimum or np.hypot(*eye_dpt[1:]) > MAX_CYLINDER_DPT:
            return None
        edges.move_edge(edges(eye_dpt).step)
    return found


class _Near:
    """Likelihood of the eyes around one, with the linear model of the edge there, computed once for each eye."""

    def __init__(self, edges: EdgeLikelihood, eye_dpt: Floats) -> None:
        self._edges = edges
        self._model = edges.edge_model(eye_dpt)
        self._known: dict[tuple[float, ...], Candidate] = {}

    def __call__(self, eye_dpt: Floats) -> Candidate:
        key = tuple(np.round(eye_dpt, 6).tolist())
        if key not in self._known:
            self._known[key] = self._edges.near(eye_dpt, self._model)
        return self._known[key]


def _descend(near: _Near, eye_dpt: Floats, step_dpt: float) -> Floats:
    """Return the point downhill from an eye in steps along the three axes, at most MAX_DESCENTS of them."""
    steps = [sign * step_dpt * axis for axis in np.eye(eye_dpt.size) for sign in (-1, 1)]
    for _ in range(MAX_DESCENTS):
        least, k = min((near(eye_dpt + step).nats, k) for k, step in enumerate(steps))
        if least >= near(eye_dpt).nats:
            break
        eye_dpt = eye_dpt + steps[k]
    return eye_dpt
