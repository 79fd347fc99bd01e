"""
Saturated, dead and warm pixels
===============================

A reflex saturates pixels, some columns are dead, other pixels are warm. Each wrong count
spreads over the whole picture, unless the pixels are found and left out.
"""

# %%
# A clean frame, and the same frame with all three defects. The head file states at which
# count a pixel is saturated.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt
import numpy as np

SCENE = """
name = "Reflex"
camera = {backend = "sim", sensor = "quantalux", rows = 540, cols = 960, pitch_um = 10.08}
light = { backend = "sim" }
optics = { field_deg = 33.4 }
sim = { seed = 3, peak_e = 15000 }
"""
head = Path(mkdtemp()) / "head.toml"
head.write_text(SCENE)
scene = diffuscope.simulate(head)

# %%

white_dn, (rows, cols) = 4095, scene.raw.shape
row, col = np.ogrid[:rows, :cols]
reflex_dn = 10 * white_dn * np.exp(-((row - 226) ** 2 + (col - 547) ** 2) / (2 * 12**2))
is_warm = np.random.default_rng(1).random((rows, cols)) < 5e-4

spoilt = scene.raw + reflex_dn + 0.4 * white_dn * is_warm
spoilt[:, 620:623] = 0
spoilt = np.clip(spoilt, 0, white_dn).astype(np.uint16)
print(f"{np.mean(spoilt == white_dn):.2%} of the pixels are saturated")

# %%
# The default leaves out what it finds, and reports it as a share of the pixels that it
# reads: 540 x 640 around the field. ``tikhonov``, the paper's closed form, uses every
# pixel.

made = diffuscope.reconstruct(spoilt, scene.psf, head=head)
closed = diffuscope.reconstruct(spoilt, scene.psf, head=head, method="tikhonov")
clean = diffuscope.reconstruct(scene.raw, scene.psf, head=head)
print("\n".join(made.report.warnings) or "no warnings")

# %%
# The titles give the correlation with the truth in the middle of the field.

middle = np.s_[180:-180, 390:-390]
shown = {
    "spoilt frame": spoilt,
    "tikhonov": closed.picture,
    "default": made.picture,
    "default, clean frame": clean.picture,
}
figure, axes = plt.subplots(2, 2, figsize=(8, 8.4), layout="constrained")
for axis, (title, image) in zip(axes.flat, shown.items(), strict=True):
    likeness = np.corrcoef(image[middle].ravel(), scene.truth[middle].ravel())[0, 1]
    axis.imshow(image[105:-105, 315:-315], cmap="gray")
    title += "" if image is spoilt else f", {likeness:.3f}"
    axis.set(title=title, xticks=[], yticks=[])
