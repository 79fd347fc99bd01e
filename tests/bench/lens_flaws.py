"""Cost of each flaw of lenslets in the picture and refraction of an eye: `python -m tests.bench.lens_flaws`.

One frame at the light of a human eye, with the calibration of the same flawed lenses; "since" is a change after it.
"""

import argparse
from math import hypot, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ElementFlaws, ObjectSpec
from device.recon.assessment.metrics import PictureScorer
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import simulate_exposure
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


def cost(spec: InstrumentSpec, photo: Path | None) -> tuple[float, dict[str, Any]]:
    """Return the correlation of the detail of a picture with the truth, and the refraction as reported."""
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
    return judge(made.picture).highpass_pcc, dict(made.report.refraction_dpt or {})


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
    for name, flaws, element, distances_um in rows():
        detail, refraction = cost(flawed(flaws, element, distances_um), asked.photo)
        sphere, cylinder = refraction.get("sphere"), ""
        if sphere is not None and refraction.get("j0") is not None:
            cylinder = f"{2 * hypot(refraction['j0'], refraction['j45']):6.2f}"
        eye = "refused" if sphere is None else f"{sphere:+6.2f} {cylinder}"
        print(f"{name:24} {detail:.3f}  {eye}", flush=True)


if __name__ == "__main__":
    main()
