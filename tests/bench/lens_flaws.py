"""Cost of each flaw of lenslets in the picture and refraction of an eye: `python -m tests.bench.lens_flaws`.

One frame at the light of a human eye, with the calibration of the same flawed lenses; "since" is a change after it. The
last column is what the next calibration, of the lenses as they are now, states about them.
"""

import argparse
from math import hypot, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from device.calibration.procedure.lens_check import lens_figures, lens_messages
from device.clock import VirtualClock
from device.config.element import Lenses
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ElementFlaws, ObjectSpec
from device.optics import lenslets
from device.recon.assessment.metrics import PictureScorer
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.spots import find_spots
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import simulate_exposure
from device.values import Calibration, Psf
from tests.scenes import PLANNER
from tests.simulated import SCENES, coarse

SCENE = SCENES / "human_eye_imx296_lenslets.toml"
DETAIL_DEG, RIM_PX = 2.0, 3
GAP_SHARE = 0.25


def flawed(flaws: dict[str, float], element: dict[str, Any], distances_um: tuple[float, float]) -> InstrumentSpec:
    """Return the scene with flaws of its lenses; `distances_um`: of the sensor in the frame, and at the calibration."""
    spec = load_head(SCENE)
    assert spec.sim is not None
    assert spec.optics is not None
    frame_um, calibrated_um = distances_um
    calibration = spec.sim.calibration.model_copy(update={"diffuser_to_sensor_um": calibrated_um})
    sim = spec.sim.model_copy(update={"element": ElementFlaws(**flaws), "calibration": calibration})
    made = spec.optics.element.model_copy(update=element)
    optics = spec.optics.model_copy(update={"element": made, "diffuser_to_sensor_um": frame_um})
    return coarse(spec.model_copy(update={"sim": sim, "optics": optics}), 2)


def cost(spec: InstrumentSpec, photo: Path | None) -> tuple[float, dict[str, Any], Calibration]:
    """Return the correlation of the detail of a picture with the truth, its refraction, and the calibration."""
    assert spec.sim is not None
    if photo is not None:
        sim = spec.sim.model_copy(update={"object": ObjectSpec(kind="image", image=photo)})
        spec = spec.model_copy(update={"sim": sim})
    exposure = simulate_exposure(spec)
    calibration = exposure.calibration
    made = Reconstructor(calibration, exposure.counts.shape, PLANNER, VirtualClock())(exposure.counts, simulated=True)
    inside = np.asarray(field_mask(exposure.counts.shape, field_radius_px(calibration) - RIM_PX), bool)
    assert calibration.geometry is not None
    judge = PictureScorer(exposure.truth, inside, DETAIL_DEG * calibration.geometry.px_per_deg, exposure.vessels)
    return judge(made.picture).highpass_pcc, dict(made.report.refraction_dpt or {}), calibration


def stated(spec: InstrumentSpec, drawn: Lenses, before: Calibration | None) -> str:
    """Return what a calibration of the lenses as they are now states: they should be as `drawn`, and as `before`."""
    assert spec.sim is not None
    assert spec.optics is not None
    pitch_um, flaws = spec.camera.pitch_um, spec.sim.element
    psf = Psf(lenslets.spots(spec.optics, pitch_um, spec.sim.seed, flaws=flaws))
    spots = find_spots(psf, spec.optics.geometry(pitch_um))
    return "no spots" if spots is None else "; ".join(lens_messages(lens_figures(spots, drawn, before)))


def merged(lenses: Lenses) -> Lenses:
    """Return the lenses with the two closest ones as one, in the middle between them."""
    places = np.array(lenses)
    apart = np.hypot(*(places[:, None, :2] - places[None, :, :2]).transpose(2, 0, 1)) + 1e9 * np.eye(len(places))
    first, second = np.unravel_index(int(apart.argmin()), apart.shape)
    middle = tuple(places[[first, second]].mean(axis=0).tolist())
    return (*(lens for number, lens in enumerate(lenses) if number not in (first, second)), middle)


def rows() -> list[tuple[str, dict[str, float], dict[str, Any], tuple[float, float]]]:
    """Return each flaw: its name, flaws of the lenses, changes of the element, and the two distances, um."""
    optics = load_head(SCENE).optics
    assert optics is not None
    z_um = optics.diffuser_to_sensor_um
    here = (z_um, z_um)
    round_um = optics.iris_um * sqrt((1 - GAP_SHARE) / len(optics.element.lenses))
    found: list[tuple[str, dict[str, float], dict[str, Any], tuple[float, float]]] = [("as drawn", {}, {}, here)]
    found += [(f"focal lengths {share:.0%}", {"focal_spread": share}, {}, here) for share in (0.01, 0.02, 0.05, 0.1)]
    found += [(f"surface {waves} waves", {"surface_waves": waves}, {}, here) for waves in (0.07, 0.15, 0.3)]
    found += [(f"centres {um} um", {"centre_um": um}, {}, here) for um in (5.0, 20.0, 50.0)]
    found += [
        (f"{gaps} gaps {GAP_SHARE:.0%}", {}, {"aperture_um": round_um, "gaps": gaps}, here)
        for gaps in ("black", "clear")
    ]
    lenses = optics.element.lenses
    found += [("a lens missing", {}, {"lenses": lenses[:4] + lenses[5:]}, here)]
    found += [("two lenses merged", {}, {"lenses": merged(lenses)}, here)]
    found += [(f"sensor {um:+g} um", {}, {}, (z_um + um, z_um + um)) for um in (-200.0, -100.0, 100.0, 200.0)]
    found += [(f"sensor {um:+g} um since", {}, {}, (z_um + um, z_um)) for um in (20.0, 50.0, 100.0)]
    found += [(f"centres {um} um since", {"moved_um": um}, {}, here) for um in (1.0, 2.0, 5.0)]
    dust = ((5, 150.0), (1, 400.0))
    found += [(f"{n} grains of {um} um since", {"dust_grains": n, "dust_um": um}, {}, here) for n, um in dust]
    return found


def main() -> None:
    """Print a row for each flaw."""
    words = argparse.ArgumentParser(prog="python -m tests.bench.lens_flaws", description=__doc__)
    words.add_argument("--photo", type=Path, help="photograph instead of the drawn eye")
    asked = words.parse_args()
    optics = load_head(SCENE).optics
    assert optics is not None
    drawn = optics.element.lenses
    before: Calibration | None = None
    for name, flaws, element, distances_um in rows():
        spec = flawed(flaws, element, distances_um)
        detail, refraction, calibration = cost(spec, asked.photo)
        before = before or calibration  # as drawn
        next_one = stated(spec, drawn, before if name.endswith("since") else None)
        sphere, cylinder = refraction.get("sphere"), ""
        if sphere is not None and refraction.get("j0") is not None:
            cylinder = f"{2 * hypot(refraction['j0'], refraction['j45']):6.2f}"
        eye = "refused" if sphere is None else f"{sphere:+6.2f} {cylinder}"
        print(f"{name:24} {detail:.3f}  {eye:13} {next_one}", flush=True)


if __name__ == "__main__":
    main()
