r"""
An effect of your own
=====================

Bubbles in the cement of a cover glass: dark discs at places that the scene's seed fixes.

An installed package adds the effect by an entry point in its ``pyproject.toml``, here for
a module ``own_effect``::

    [project.entry-points."diffuscope.effects"]
    bubbles = "own_effect:EFFECT"

A scene uses it with a table of its name. ``diffuscope simulate SCENE.toml --explain``
then decides on it by its eta, as on every other effect, and ``plan.json`` lists it::

    [sim.effects.bubbles]
    spots = 12
    depth = 0.5
"""

from math import pi, sqrt

import numpy as np
from pydantic import Field

from device.config.toml_file import Table
from device.sim.optical_setup import OpticalSetup, Scene, Size


class BubbleSettings(Table):
    """Table [sim.effects.bubbles]; the defaults are the absence of the effect."""

    spots: int = Field(default=0, ge=0, le=1000)
    diameter_px: float = Field(default=12.0, gt=0, le=500)
    depth: float = Field(default=0.5, ge=0, le=1)  # share of the light that a disc takes


class Bubbles:
    """Bubbles in a cover glass: `spots` discs that take a share `depth` of the light."""

    name = "bubbles"

    def size(self, scene: Scene) -> Size:
        """Return the rms of the missing light over the noise of a pixel."""
        bubbles = scene.sim.effect_settings(self.name, BubbleSettings)
        camera = scene.spec.camera
        covered = (
            bubbles.spots * pi / 4 * bubbles.diameter_px**2 / (camera.rows * camera.cols)
        )
        eta = bubbles.depth * sqrt(min(covered, 1)) * scene.lit_e / scene.noise_e
        return Size(eta, f"{bubbles.spots} discs cover {covered:.2%}")

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the response of the pixels by the shadows of the discs."""
        bubbles = setup.scene.sim.effect_settings(self.name, BubbleSettings)
        rng = np.random.default_rng((setup.scene.seed, 71))
        rows, cols = np.indices(setup.shape)
        shadow = np.ones(setup.shape, np.float32)
        for row, col in rng.uniform((0, 0), setup.shape, (bubbles.spots, 2)):
            is_covered = np.hypot(rows - row, cols - col) < bubbles.diameter_px / 2
            shadow[is_covered] = 1 - bubbles.depth
        setup.multiply_response(shadow)


EFFECT = Bubbles()

# %%
# The entry point takes two small files beside the module, which installing a package
# writes. A scene then has the effect as soon as it names it. The solver does not model
# the bubbles: the picture is wrong, and its report says so.

if __name__ == "__main__":
    import sys
    from pathlib import Path
    from tempfile import mkdtemp

    import diffuscope
    import matplotlib.pyplot as plt

    folder = Path(mkdtemp())
    (info := folder / "own_effect-0.1.dist-info").mkdir()
    metadata = "Metadata-Version: 2.1\nName: own-effect\nVersion: 0.1\n"
    entry_point = "[diffuscope.effects]\nbubbles = own_effect:EFFECT\n"
    (info / "METADATA").write_text(metadata)
    (info / "entry_points.txt").write_text(entry_point)
    sys.path[:0] = [str(folder), str(Path.cwd())]  # this folder has own_effect.py

    SCENE = """
    name = "Scene with bubbles"
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
    effects.bubbles = { spots = 40, depth = 0.6 }
    """
    (folder / "bubbly.toml").write_text(SCENE)
    scene = diffuscope.simulate(folder / "bubbly.toml")
    print(scene.explain().splitlines()[-1])

    made = diffuscope.reconstruct(scene.raw, scene.psf, head=folder / "bubbly.toml")
    print("\n".join(made.report.warnings) or "no warnings")

    (folder / "clean.toml").write_text(SCENE.replace("spots = 40", "spots = 0"))
    clean = diffuscope.simulate(folder / "clean.toml")
    without = diffuscope.reconstruct(clean.raw, clean.psf, head=folder / "clean.toml")
    shown = {
        "raw frame": scene.raw,
        "picture": made.picture,
        "without bubbles": without.picture,
    }
    figure, axes = plt.subplots(1, 3, figsize=(11, 4), layout="constrained")
    for axis, (title, image) in zip(axes, shown.items(), strict=True):
        axis.imshow(image[130:-130, 340:-340], cmap="gray")
        axis.set(title=title, xticks=[], yticks=[])
