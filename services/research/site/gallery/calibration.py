"""
Calibration of a bench: dark frame and PSF
==========================================

Three frames make a picture with a lensless camera on a bench: one without light, one of a
small bright source, and the frame itself, all of the same exposure. Here a simulated
sensor that has aged takes the place of the bench.
"""

# %%
# One sensor, three objects. The seed selects the diffuser and the flaws of the pixels,
# which thus agree.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt
import numpy as np

SCENE = """
name = "Bench"
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
seed = 17
peak_e = {peak_e}
object = {{ {thing} }}
sensor = {{ dsnu_e = 100, dark_e_per_s = 3000 }}
"""
folder = Path(mkdtemp())


def frame(name: str, thing: str, peak_e: float) -> diffuscope.SimulatedScene:
    """Return the frame of an object, with `peak_e` electrons in the brightest pixel."""
    (folder / name).write_text(SCENE.format(thing=thing, peak_e=peak_e))
    return diffuscope.simulate(folder / name)


eye = frame("eye.toml", "haemorrhages = 6", 3000)
point = frame("point.toml", 'kind = "point", dot_um = 60', 15000)
dark = frame("dark.toml", "", 1e-3)

# %%
# The dark frame is what the sensor counts without light: black level, dark current,
# differences between pixels. It belongs to the frame of the point as well; what is left
# is the PSF.

dark_dn = dark.raw.astype(np.float32)
psf = np.clip(point.raw - dark_dn, 0, None)
print(f"dark frame: mean {dark_dn.mean():.1f} DN, between pixels {dark_dn.std():.1f} DN")

# %%
# Without the dark frame its differences between pixels are part of the picture. The
# titles give the correlation with the truth in the middle of the field.

head = folder / "eye.toml"
with_dark = diffuscope.reconstruct(eye.raw, psf, dark=dark_dn, head=head)
without = diffuscope.reconstruct(eye.raw, psf, head=head)

middle = np.s_[180:-180, 390:-390]
figure, axes = plt.subplots(2, 2, figsize=(8, 8.4), layout="constrained")
shown = {
    "dark frame": dark_dn,
    "PSF (square root)": psf**0.5,
    "without the dark frame": without.picture,
    "with it": with_dark.picture,
}
for axis, (title, image) in zip(axes.flat, shown.items(), strict=True):
    if "the dark" in title or title == "with it":
        likeness = np.corrcoef(image[middle].ravel(), eye.truth[middle].ravel())[0, 1]
        title += f", {likeness:.3f}"
    axis.imshow(image[105:-105, 315:-315], cmap="gray")
    axis.set(title=title, xticks=[], yticks=[])
