"""
Wrong refraction
================

A short-sighted eye bends the light before it meets the diffuser, and its caustic is
smaller than that of the calibration. The frame itself shows by how much: the
reconstruction scales the PSF, and reports the refraction.
"""

# %%
# Two eyes in front of the same instrument: the seed selects the diffuser and the retina.
# The PSF is measured on the eye without refraction, the frame is that of an eye with 4
# dpt of myopia.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt
import numpy as np

SCENE = """
name = "Eye"
[camera]
backend = "sim"
sensor = "quantalux"
rows = 540
cols = 960
pitch_um = 10.08
[light]
backend = "sim"
[optics]
field_deg = 33.4
[sim]
seed = 3
peak_e = 15000
eye.m_dpt = {m_dpt}
"""


def eye(m_dpt: float) -> tuple[diffuscope.SimulatedScene, Path]:
    path = Path(mkdtemp()) / "eye.toml"
    path.write_text(SCENE.format(m_dpt=m_dpt))
    return diffuscope.simulate(path), path


calibrated, head = eye(0.0)
short_sighted, _ = eye(4.0)

# %%
# With ``head`` the scale of the PSF becomes dioptres. Refraction is reported as the
# spectacle correction, so myopia is negative.

made = diffuscope.reconstruct(short_sighted.raw, calibrated.psf, head=head)
print(f"the PSF is {made.report.psf_scale:.4f} times as large as the calibrated one")
print("refraction_dpt:", made.report.refraction_dpt)

# %%
# The closed form of the paper (``tikhonov``) uses the PSF as it was measured.

raw, psf, truth = short_sighted.raw, calibrated.psf, short_sighted.truth
plain = diffuscope.reconstruct(raw, psf, head=head, method="tikhonov")


def likeness(picture: np.ndarray) -> float:
    """Return the correlation with the truth in the middle of the field."""
    middle = np.s_[170:-170, 380:-380]
    return float(np.corrcoef(picture[middle].ravel(), truth[middle].ravel())[0, 1])


figure, axes = plt.subplots(1, 3, figsize=(11, 4), layout="constrained")
shown = {
    f"PSF as measured, {likeness(plain.picture):.3f}": plain.picture,
    f"PSF scaled to the frame, {likeness(made.picture):.3f}": made.picture,
    "truth": truth,
}
for axis, (title, image) in zip(axes, shown.items(), strict=True):
    axis.imshow(image[130:-130, 340:-340], cmap="gray")
    axis.set(title=title, xticks=[], yticks=[])
