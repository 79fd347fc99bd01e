"""Light of a scene by the budget of a head's LEDs: `[sim] peak_e = "budget"` and `[light] head`."""

from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, LightSpec, load_head
from device.config.radiometry import BeamSpec, RadiometrySpec
from device.config.shipped_heads import HEADS
from device.errors import SpecError
from device.optics.light_budget import chain, product
from device.sim.optical_setup import Scene
from device.sim.scene_files import simulate
from device.sim.world import World
from services.workshop.optics_report import design_of
from tests.paper.bench import with_changes, with_merged_pixels
from tests.simulated import SCENES, coarse, with_keys

EYES = sorted(SCENES.glob("human_eye_*.toml"))
SIMULATED = sorted(HEADS.glob("sim_*.toml"))
LIT = sorted(
    path.stem for path in set(HEADS.glob("*.toml")) - set(SIMULATED) if load_head(path).light.backend != "none"
)
SIM = load_head(SCENES / "human_eye_sim.toml")


def light(spec: InstrumentSpec) -> float:
    """Return the mean electrons of the lit disc by the budget."""
    budget = Scene(spec, spec.light.colour).budget
    assert budget is not None
    return budget.mean_e


def test_every_head_with_a_lamp_has_a_scene_of_a_human_eye_in_its_own_light() -> None:
    assert [path.stem.removeprefix("human_eye_") for path in EYES] == LIT


@pytest.mark.parametrize("path", SIMULATED, ids=lambda path: path.stem)
def test_simulated_head_has_the_optics_and_the_light_of_its_scene(path: Path) -> None:
    head = load_head(path)
    scene = load_head(SCENES / f"human_eye_imx296{path.stem.removeprefix('sim').removeprefix('_imx296')}.toml")
    assert head.optics == scene.optics
    assert light(head) == pytest.approx(light(scene), rel=1e-3), "also where its measured light is stated"


@pytest.mark.parametrize("name", LIT)
def test_scene_has_camera_and_optics_of_its_head_and_the_light_of_its_chain(name: str) -> None:
    scene, head = load_head(SCENES / f"human_eye_{name}.toml"), load_head(HEADS / f"{name}.toml")
    own = {"backend", "upright"}
    assert scene.camera.model_dump(exclude=own) == head.camera.model_dump(exclude=own)
    assert scene.optics == head.optics
    assert light(scene) == pytest.approx(product(chain(design_of(head))) * (head.camera.pitch_um / 10) ** 2, rel=1e-6)


def test_frame_has_the_mean_of_the_budget_over_its_disc() -> None:
    wide = coarse(with_changes(SIM, {"camera.rows": 1600, "camera.cols": 1600}), 4)  # d + 2 s is 1155 pixels wide
    electrons = World(wide, VirtualClock()).electrons_per_s("green").astype(np.float64) * wide.camera.exposure_s
    budget = Scene(wide, "green").budget
    assert budget is not None
    assert electrons.sum() / budget.disc_px == pytest.approx(budget.mean_e, rel=1e-3)
    assert electrons.max() == pytest.approx(Scene(wide, "green").peak_e, rel=0.03), "the plan's estimate of the peak"


def test_budget_follows_pixels_exposure_and_eye() -> None:
    assert light(with_merged_pixels(SIM, 2)) == pytest.approx(4 * light(SIM))
    assert light(with_changes(SIM, {"camera.exposure_s": 0.05})) == pytest.approx(light(SIM) / 2)
    narrow = with_changes(SIM, {"sim.eye.pupil_um": 5000.0})
    assert light(narrow) < 0.01 * light(SIM), "the ring is imaged outside of so small a pupil"


def test_measured_irradiance_replaces_the_estimate_and_is_named(tmp_path: Path) -> None:
    expected = design_of(SIM).highest_mw_per_cm2
    beam = BeamSpec(wavelength_um=0.522, retina_mw_per_cm2=3 * expected, waist_mw_per_cm2=1.0)
    table = RadiometrySpec(measured="2026-11-02, PM100D", guard_factor=1.3, green=beam)
    measured = SIM.model_copy(update={"light": SIM.light.model_copy(update={"radiometry": table})})
    assert light(measured) == pytest.approx(3 * light(SIM))
    plan = simulate(coarse(measured, 8), tmp_path / "scene").plan
    assert any("2026-11-02, PM100D" in decision.why for decision in plan)
    assert '"why": ' in (text := (tmp_path / "scene" / "plan.json").read_text())
    assert "the budget's mean is" in text


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"budget"', '"bugdet"', "line 24: sim.peak_e: 'bugdet' is neither a number .* nor \"budget\"; give"),
        ('"budget"', "true", "neither a number"),
        ('"budget"', "0", "neither a number"),
        ('head = "sim"', 'head = "imx269"', "no head is called 'imx269'; did you mean 'imx296'"),
        ('head = "sim"', 'head = "xyz"', "known are bench, imx296"),
        ('head = "sim"', 'head = "bench"', "bench.toml has no LEDs, .* name a head with a lamp"),
        ('head = "sim"', 'head = "scene.toml"', "takes its light from another head; name that one"),
        ('head = "sim"', 'head = "absent.toml"', "absent.toml cannot be read"),
        ('"human eye"', '"print"', "not of a print; set shown_by"),
    ],
)
def test_light_that_cannot_be_known_is_refused_with_a_remedy(tmp_path: Path, old: str, new: str, reason: str) -> None:
    text = (SCENES / "human_eye_sim.toml").read_text()
    assert old in text
    (tmp_path / "scene.toml").write_text(text.replace(old, new))
    with pytest.raises(SpecError, match=reason):
        load_head(tmp_path / "scene.toml")


def test_colour_without_leds_and_head_without_lamp_are_refused() -> None:
    power = load_head(SCENES / "human_eye_imx296_power.toml")
    with pytest.raises(SpecError, match="has no blue LEDs") as refused:
        _ = Scene(power, "blue").peak_e
    assert "peak_e as a number" in refused.value.remedy
    dark = SIM.model_copy(update={"light": LightSpec(backend="none")})
    with pytest.raises(SpecError, match="has no lamp"):
        _ = Scene(dark, "green").peak_e


def test_light_of_a_head_is_kept_where_the_table_omits_it() -> None:
    power, head = load_head(SCENES / "human_eye_imx296_power.toml"), load_head(HEADS / "imx296_power.toml")
    assert power.light.sinks == head.light.sinks
    assert (power.light.backend, power.light.preview_colour) == ("sim", "amber")
    assert with_changes(power, {"sim.eye.m_dpt": 1.0}).light == power.light
    assert with_keys(power, peak_e=500.0).sim.peak_e == 500
