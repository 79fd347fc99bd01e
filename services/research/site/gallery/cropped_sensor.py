"""
Cropped sensor
==============

The caustic of a point near the field's edge runs past a small sensor. A periodic model
assumes that this light comes back on the opposite side; the default method models the
crop instead.
"""

# %%
# A sensor of 300 x 400 pixels, where the caustic of the design covers more rows. The PSF
# is as large as the frame, so it is cropped too.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt
import numpy as np

SCENE = """
name = "Small sensor"
camera = {backend = "sim", sensor = "quantalux", rows = 300, cols = 400, pitch_um = 10.08}
light = { backend = "sim" }
optics = { field_deg = 33.4 }
sim = { seed = 5, peak_e = 15000 }
"""
path = Path(mkdtemp()) / "small.toml"
path.write_text(SCENE)
scene = diffuscope.simulate(path)

# %%
# ``tikhonov`` is the paper's closed form, which is periodic. Its picture is compared with
# the default's, given the same head file.

periodic = diffuscope.reconstruct(scene.raw, scene.psf, head=path, method="tikhonov")
aware = diffuscope.reconstruct(scene.raw, scene.psf, head=path)


def likeness(picture: np.ndarray) -> float:
    """Return the correlation with the truth on the whole sensor."""
    return float(np.corrcoef(picture.ravel(), scene.truth.ravel())[0, 1])


figure, axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
shown = {
    "raw frame": scene.raw,
    "truth": scene.truth,
    f"periodic, {likeness(periodic.picture):.3f}": periodic.picture,
    f"models the crop, {likeness(aware.picture):.3f}": aware.picture,
}
for axis, (title, image) in zip(axes.flat, shown.items(), strict=True):
    axis.imshow(image, cmap="gray")
    axis.set(title=title, xticks=[], yticks=[])
