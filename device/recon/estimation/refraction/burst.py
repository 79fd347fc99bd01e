"""Refraction of a burst: a step of each of its frames from the refraction of the first, and the scatter between them.

The step of frame k from the eye T of the first frame is that of the crop-aware refinement, V (D' K^-1 r_k), with the
covariance V of the first frame. At the true eye the mean of a step is not 0 (NUMERICS.md 7.7), but it is the same for
all frames. So T plus the mean of (step k - step 1) is the refraction of the joined frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.refraction.crop_model import CropModel
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.model.kernels import Pixels, Places

MIN_FRAMES = 3  # for a scatter
LARGEST_STEP_DPT = 1.4  # beyond it a step is no estimate
MAX_SCATTER_DPT = 0.7  # half of the largest step

Floats = NDArray[np.float64]
BurstFrame = tuple[Pixels, Pixels | None, Places | None]  # counts, dark frame, defective pixels


@dataclass(frozen=True)
class FrameScatter:
    """Scatter of M between `count` frames: its sd, the sd stated by one, and chi^2, count - 1 degrees of freedom."""

    count: int
    sd_dpt: float
    stated_sd_dpt: float

    @classmethod
    def of(cls, m_dpt: Floats, stated_sd_dpt: float) -> "FrameScatter":
        """Return the scatter of M of frames, (count,), each with this sd."""
        return cls(m_dpt.size, float(np.std(m_dpt, ddof=1)), stated_sd_dpt)

    @property
    def chi2(self) -> float:
        """Sum of the squared deviations from the mean over the stated variance."""
        return (self.count - 1) * (self.sd_dpt / self.stated_sd_dpt) ** 2

    @property
    def growth(self) -> float:
        """Factor of the sd of M by the scatter, at least 1: the Birge ratio (Birge 1932)."""
        return max(1.0, self.sd_dpt / self.stated_sd_dpt)


def frame_steps(
    edges: EdgeLikelihood, model: CropModel, eye_dpt: Floats, edge: FieldEdge, frames: Sequence[BurstFrame]
) -> Floats:
    """Return the step of each frame from an eye (M, J0, J45), within an edge that is held, (frames, 3) in dpt.

    Likelihood and model then hold the state of the last frame. LinAlgError if a frame determines nothing.
    """
    steps: list[Floats] = []
    for counts, dark, defects in frames:
        edges.start(counts, dark, defects)
        edges.edge = edges.prior.in_samples(edge)
        edges.fit_smooth(eye_dpt)
        edges.set_noise(eye_dpt)
        model.start(eye_dpt)
        model.focus(eye_dpt)
        fit = model.fit(edges.frame.y, None)
        if not steps:
            covariance = model.covariance(fit.derivatives)
        steps.append(covariance @ fit.score)
    return np.array(steps)
