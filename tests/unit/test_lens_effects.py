"""Effects of lenslets: all that is present is simulated, and the calibration sees what was made, not what moved."""

import numpy as np

from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ElementFlaws
from device.sim.optical_setup import Scene
from device.sim.plan import decide
from device.sim.simulated_calibration import calibration_point
from services import resources
from services.workshop.optics_report import design_of, table
from tests.paper.bench import with_changes
from tests.simulated import SCENES, coarse, world


def scene(spec: InstrumentSpec) -> Scene:
    return Scene(spec, spec.light.colour)


def test_behind_lenslets_nothing_that_is_present_is_skipped() -> None:
    flaws = {"sim.element.focal_spread": 0.02, "sim.element.moved_um": 1.0, "sim.eye.m_dpt": 0.005}
    head = with_changes(load_head(SCENES / "human_eye_imx296_lenslets.toml"), flaws)
    planned = {decision.name: decision for decision in decide(scene(head))}
    assert 0 < planned["refraction"].eta < 0.05
    assert "a diffuser's" in planned["refraction"].why
    assert all(decision.simulated == (decision.eta > 0) for decision in planned.values())
    assert "12 and 26 dpt too strong" in planned["lens_curvature"].why
    setup = world(coarse(head, 4)).setup("green")
    assert setup.lenses == (ElementFlaws(focal_spread=0.02, moved_um=1.0), True)
    flat = with_changes(head, {"optics.element.flat_field": True})
    assert {decision.name: decision for decision in decide(scene(flat))}["lens_curvature"].eta == 0
    assert not world(coarse(flat, 4)).setup("green").lenses.curved
    plain = {decision.name: decision for decision in decide(scene(load_head(SCENES / "healthy.toml")))}
    assert all(plain[name].eta == 0 for name in ("lens_curvature", "lens_flaws", "lens_shift"))


def test_shifted_and_dusty_lenses_are_in_the_frame_and_not_in_the_calibration() -> None:
    head = coarse(load_head(SCENES / "human_eye_imx296_control.toml"), 2)
    points = {}
    for key, size in (("centre_um", 30.0), ("moved_um", 30.0), ("dust_grains", 3)):
        of = world(with_changes(head, {f"sim.element.{key}": size}), without=["lens_curvature"])
        points[key] = calibration_point(of), of.psf("green")
    ideal = world(head, without=["lens_curvature"]).psf("green")
    for made, (calibrated, framed) in points.items():
        assert np.array_equal(calibrated, ideal) == (made != "centre_um")
        assert not np.array_equal(framed, ideal)


def test_the_budget_of_a_head_with_lenslets_claims_no_detail_of_a_diffuser() -> None:
    for name, claims in (("imx296", True), ("imx296_lenslets", False)):
        printed = table(design_of(load_head(resources.HEADS / f"{name}.toml")))
        assert ("behind lenslets it is finer" not in printed) == claims
