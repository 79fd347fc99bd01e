"""
Own raw frame and PSF
=====================

One raw frame and its point spread function (PSF) become a picture, without a parameter.
Here a simulated scene takes the place of the recording; with your own files only the two
paths change.
"""

# %%
# Two files, as a camera gives them: the counts of a frame, and the frame of one bright
# point behind the same diffuser.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt
import numpy as np
import tifffile

folder = Path(mkdtemp())
scene = diffuscope.simulate("healthy")
tifffile.imwrite(folder / "raw.tiff", scene.raw)
tifffile.imwrite(folder / "psf.tiff", scene.psf)

# %%
# One call reads both, estimates noise, regularisation and defective pixels from the
# frame, and deconvolves.

made = diffuscope.reconstruct(folder / "raw.tiff", folder / "psf.tiff")
report = made.report
print(made.picture.shape, made.picture.dtype)
print(f"method {report.method}, bin {report.bin}, {report.rounds} rounds")
print("warnings:", report.warnings or "none")

# %%
# The PSF is a pattern of bright lines, the caustic of the diffuser. The frame is the sum
# of one such pattern per point of the retina, so that no detail can be seen in it before
# the deconvolution.

middle = np.s_[190:-190, 610:-610]
figure, axes = plt.subplots(2, 2, figsize=(8, 8.4), layout="constrained")
for axis, image, title in zip(
    axes.flat,
    (scene.psf**0.5, scene.raw, made.picture, scene.truth),
    ("PSF (square root)", "raw frame", "picture", "truth"),
    strict=True,
):
    axis.imshow(image[middle], cmap="gray")
    axis.set(title=title, xticks=[], yticks=[])
