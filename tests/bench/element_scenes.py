"""Scenes of the benches of elements: a head, its element at the iris, and an eye at the light of its budget."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ObjectSpec
from device.errors import SpecError
from device.optics.eye import iris_overlap
from device.sim.effects.illumination import lit_share
from device.sim.optical_setup import Scene
from device.sim.world import World
from tests.lens_packing import lenses_in_iris, random_packing
from tests.simulated import SCENES, coarse

SUMMED = 2  # pixels of a sample: 6.9 um with the IMX296
PACKING_UM, PACKING_SEED = 600.0, 1
HEADS = {
    "diffuser": "imx296",
    "diffuser, power": "imx296_power",
    "lenslets": "imx296_lenslets",
    "lenslets, power": "imx296_power_lenslets",
    "random packing": "imx296_lenslets",
    "hexagonal": "imx296_hexagonal",
    "control": "imx296_control",
}


class Eye(NamedTuple):
    """An eye: M, J0 and J45 in dpt (M > 0: myopia), the seed of its drawing, or a photograph in its place."""

    m_dpt: float = 0.0
    j0_dpt: float = 0.0
    j45_dpt: float = 0.0
    seed: int | None = None  # None: that of the scene
    photo: Path | None = None


def scene(head: str, eye: Eye) -> InstrumentSpec:
    """Return the scene of one of HEADS before an eye."""
    spec = load_head(SCENES / f"human_eye_{HEADS[head]}.toml")
    assert spec.sim is not None
    assert spec.optics is not None
    if head == "random packing":
        places_um = random_packing(PACKING_UM, spec.optics.iris_um, PACKING_SEED)
        lenses = lenses_in_iris(places_um, spec.optics.element.lenses[0][2], spec.optics.iris_um)
        element = spec.optics.element.model_copy(update={"lenses": lenses})
        spec = spec.model_copy(update={"optics": spec.optics.model_copy(update={"element": element})})
    changes: dict[str, object] = {
        "eye": spec.sim.eye.model_copy(update={name: getattr(eye, name) for name in ("m_dpt", "j0_dpt", "j45_dpt")}),
        "seed": spec.sim.seed if eye.seed is None else eye.seed,
    }
    if eye.photo is not None:
        lit_deg = Scene(spec, spec.light.colour).lit_deg  # beyond a smaller photograph the field would be dark
        changes["object"] = ObjectSpec(kind="image", image=eye.photo, size_deg=lit_deg)
    return coarse(spec.model_copy(update={"sim": spec.sim.model_copy(update=changes)}), SUMMED)


def world(spec: InstrumentSpec, *, is_flat: bool = False) -> World:
    """Return the world of a scene; `is_flat`: no lens has a curved image surface, and its calibration says so."""
    assert spec.optics is not None
    if is_flat:
        element = spec.optics.element.model_copy(update={"flat_field": True})
        spec = spec.model_copy(update={"optics": spec.optics.model_copy(update={"element": element})})
    return World(spec, VirtualClock())


def behind_pupil(wide: World, pupil_um: float, decentred_um: float) -> InstrumentSpec:
    """Return the scene of a world with another pupil, and as much light on the retina as through the world's own one.

    The iris loses what the pupil hides of it.
    """
    spec = wide.spec
    assert spec.sim is not None
    assert spec.optics is not None
    iris_um = spec.optics.iris_um * spec.optics.angular_magnification
    peak_e = float(wide.electrons_per_s(spec.light.colour).max()) * spec.camera.exposure_s
    peak_e *= iris_overlap(decentred_um, pupil_um / 2, iris_um / 2)
    eye = spec.sim.eye.model_copy(update={"pupil_um": pupil_um, "decentred_um": decentred_um})
    return spec.model_copy(update={"sim": spec.sim.model_copy(update={"eye": eye, "peak_e": peak_e})})


def light_in_pupil(spec: InstrumentSpec) -> float:
    """Return the share of the ring's light that enters the pupil of a scene's eye, 0 to 1."""
    axis_deg = np.zeros(1)
    try:
        return float(lit_share(Scene(spec, spec.light.colour), axis_deg, axis_deg)[0])
    except SpecError:  # none
        return 0.0
