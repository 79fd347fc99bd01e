r"""
A solver of your own
====================

FISTA (Beck and Teboulle 2009) for pictures that are never negative::

    min_x  1/2 |y - crop(h * x)|^2,   x >= 0 in the field, 0 outside

An installed package adds the method by an entry point in its ``pyproject.toml``, here for
a module ``own_solver``::

    [project.entry-points."diffuscope.methods"]
    fista = "own_solver:METHOD"

``diffuscope methods`` then lists it, ``diffuscope frontier`` measures it, and
``diffuscope reconstruct RAW --psf PSF -o OUT.png --method fista`` uses it. Without a
package, the file is enough: ``--method own_solver.py:METHOD``.
"""

import numpy as np

from device.recon.methods import Method
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics
from device.values import Calibration, Image


class Fista:
    """Accelerated proximal gradient descent; two real FFT pairs a round."""

    input_buffer = None  # frames are copied

    def __init__(self, model: Model, calibration: Calibration, planner: Planner) -> None:
        self.model, self.diagnostics = model, Diagnostics()
        self.refocus()

    def refocus(self) -> None:
        """Set the step length: one over the largest eigenvalue of the normal operator."""
        self.length = 1 / float(np.abs(self.model.otf).max()) ** 2

    def start(self, frame: Linear) -> None:
        """Start from a uniform field with the light of the frame."""
        self.y = frame.y  # (rows, cols) of the sensor's samples, linear DN
        self.good = frame.good  # share of usable pixels in each sample, 0 to 1
        level_dn = np.float32(frame.y.sum() / max(self.model.flat.sum(), 1e-6))
        self.x = self.z = level_dn * self.model.mask
        self.t = 1.0

    def step(self) -> None:
        """Run one round."""
        residual = np.zeros(self.model.grid.shape, np.float32)
        seen = self.model.grid.slices
        residual[seen] = (self.model.blur(self.z)[seen] - self.y) * self.good
        descent = self.length * self.model.blur_adjoint(residual)
        x = np.maximum(self.z - descent, 0) * self.model.mask
        t = (1 + (1 + 4 * self.t**2) ** 0.5) / 2
        self.z = x + (self.t - 1) / t * (x - self.x)
        self.x, self.t = x, t

    def finish(self, out: Image) -> None:
        """Write the picture, and report the length of the steps."""
        out[:] = self.x
        self.diagnostics = Diagnostics(regularisation={"step_length": self.length})


SENTENCE = "least squares with x >= 0 by FISTA"
METHOD = Method("fista", SENTENCE, Fista, start_pairs=0, round_pairs=2, rounds=100)

# %%
# The method of this file beside ``variation``, on one simulated frame. The titles give
# the correlation with the truth in the field, and the seconds from frame to picture.

if __name__ == "__main__":
    from pathlib import Path
    from tempfile import mkdtemp

    import diffuscope
    import matplotlib.pyplot as plt

    SCENE = """
    name = "Small scene"
    [camera]
    backend = "sim"
    sensor = "quantalux"
    rows = 270
    cols = 480
    pitch_um = 20.16
    [light]
    backend = "sim"
    [optics]
    field_deg = 33.4
    [sim]
    seed = 3
    peak_e = 15000
    """
    head = Path(mkdtemp()) / "small.toml"
    head.write_text(SCENE)
    scene = diffuscope.simulate(head)

    figure, axes = plt.subplots(1, 3, figsize=(10, 3.8), layout="constrained")
    field = np.s_[70:-70, 175:-175]
    for axis, method in zip(axes, ("own_solver.py:METHOD", "variation"), strict=False):
        made = diffuscope.reconstruct(scene.raw, scene.psf, head=head, method=method)
        picture, truth = made.picture[field], scene.truth[field]
        likeness = np.corrcoef(picture.ravel(), truth.ravel())[0, 1]
        axis.imshow(picture, cmap="gray")
        seconds = sum(made.report.seconds.values())
        axis.set(title=f"{made.report.method}, {likeness:.3f}, {seconds:.2f} s")
    axes[2].imshow(truth, cmap="gray")
    axes[2].set(title="truth")
    for axis in axes:
        axis.set(xticks=[], yticks=[])
