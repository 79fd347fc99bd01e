"""Linear filter of the product, by which the proofs of the simulator's plan measure eta (OPTICS.md 3.1).

eta = ||F dY|| / ||F noise||, with F the product's own linear step, its apodisation included, and the best common gain
removed from dY. Pixels are twice as wide, which is the product's working bin on the paper's sensor.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from device.recon.methods import METHODS
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resolution import working_bin
from device.recon.solvers.tv import EvidenceWiener
from device.sim.world import World
from device.values import Calibration
from tests import scenes
from tests.simulated import exposed_counts

COARSER = 2


class Filter:
    """Linear step of the product: apodisation, spectrum, conj(H) / (|H|^2 + s2 / g), with the prior of one frame."""

    def __init__(self, calibration: Calibration, of: World) -> None:
        counts = exposed_counts(of)
        method = METHODS["evidence"]
        model = method.model(calibration, counts.shape, working_bin(calibration.psfs[0]), scenes.PLANNER, 0)
        solver = method.build(model, calibration, scenes.PLANNER)
        assert isinstance(solver, EvidenceWiener)
        solver.start(Preprocessor(calibration, model.grid)(counts))
        self.grid, self.fade = model.grid, solver.fade
        self.gain = np.conj(model.otf) / (np.abs(model.otf) ** 2 + solver.detail.reg)
        self.read_e = of.spec.camera.read_noise_e

    def eta(self, with_it: NDArray[np.float64], without: NDArray[np.float64]) -> float:
        """Return the change of the picture over its noise for this change of the frame's expected electrons."""
        seen, ideal = self.binned(with_it), self.binned(without)
        change = seen - (seen * ideal).sum() / (ideal * ideal).sum() * ideal
        padded = np.zeros(self.grid.shape)
        padded[self.grid.slices] = change * self.fade
        changed = self.energy(fft.rfft2(padded) * self.gain)
        noise = (ideal.mean() + (self.grid.n * self.read_e) ** 2) * float((self.fade**2).sum())
        return float(np.sqrt(changed / (noise * self.energy(self.gain))))

    def energy(self, spectrum: NDArray[np.complex128]) -> float:
        """Return the sum of squares over the whole plane from a half spectrum."""
        twice = np.full(spectrum.shape[1], 2.0)
        twice[0] = 1
        if self.grid.shape[1] % 2 == 0:
            twice[-1] = 1
        return float((np.abs(spectrum) ** 2 * twice).sum())

    def binned(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        n, (rows, cols), (top, left) = self.grid.n, self.grid.window, self.grid.first_px
        return image[top : top + n * rows, left : left + n * cols].reshape(rows, n, cols, n).sum((1, 3))
