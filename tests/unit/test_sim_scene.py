"""Scenes as files, and the plan that says what is in them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from device.clock import VirtualClock
from device.errors import StoreError
from device.optics.diffuser import Refraction
from device.sim.scene import captured_fraction, edge_shift_um, simulate
from device.sim.world import World
from device.spec import load_head

SCENES = Path(__file__).parents[2] / "device" / "sim" / "scenes"


def coarse(name):
    """A scene with pixels four times as wide."""
    spec = load_head(SCENES / name)
    camera = spec.camera
    smaller = {"rows": camera.rows // 4, "cols": camera.cols // 4, "pitch_um": 4 * camera.pitch_um}
    return spec.model_copy(update={"camera": camera.model_copy(update=smaller)})


def with_field(spec, field_deg):
    return spec.model_copy(update={"optics": spec.optics.model_copy(update={"field_deg": field_deg})})


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_scene_can_be_simulated(path, tmp_path):
    spec = coarse(path.name)
    plan = simulate(spec, tmp_path)
    shape = (spec.camera.rows, spec.camera.cols)
    raw, truth = tifffile.imread(tmp_path / "raw.tiff"), np.load(tmp_path / "truth.npy")
    psf = tifffile.imread(tmp_path / "psf.tiff")
    assert (raw.dtype, raw.shape) == (np.dtype(np.uint16), shape)
    assert (truth.dtype, truth.shape) == (np.dtype(np.float32), shape)
    assert (psf.dtype, psf.shape) == (np.dtype(np.float32), shape)
    vessels = np.asarray(Image.open(tmp_path / "vessels.png"))
    assert vessels.shape == shape
    assert set(np.unique(vessels)) == {0, 255}
    assert truth[vessels > 0].mean() < truth[(vessels == 0) & (truth > 0)].mean()
    assert json.loads((tmp_path / "plan.json").read_text()) == plan
    assert raw.max() < spec.camera.white_dn


def test_the_plan_is_honest_about_every_effect(tmp_path):
    plan = simulate(coarse("healthy.toml"), tmp_path)
    assert {"refraction", "shot_noise", "read_noise", "saturation", "quantisation", "crop"} <= set(plan)
    for effect in plan.values():
        assert set(effect) == {"simulated", "why", "number"}
        assert math.isfinite(effect["number"])
    assert not plan["refraction"]["simulated"]
    assert plan["shot_noise"]["number"] > 0.99  # of the variance: the rest is reading and rounding
    shares = sum(plan[name]["number"] for name in ("shot_noise", "read_noise", "quantisation"))
    assert shares == pytest.approx(1)
    assert plan["saturation"]["number"] == 0
    assert not plan["pixel_response"]["simulated"]


def test_too_much_light_is_reported_as_saturation(tmp_path):
    spec = coarse("healthy.toml")
    bright = spec.model_copy(update={"sim": spec.sim.model_copy(update={"peak_e": 40000.0})})
    assert simulate(bright, tmp_path)["saturation"]["number"] > 0.005


def test_a_refraction_is_in_the_plan_by_what_it_moves(tmp_path):
    plan = simulate(coarse("healthy.toml"), tmp_path, Refraction(2.0))
    assert plan["refraction"]["simulated"]
    assert plan["refraction"]["number"] == pytest.approx(10.8)


def test_one_dioptre_moves_the_iris_edge_by_the_golden_number():
    """optics.md 9: 5.4 um/D."""
    optics = coarse("healthy.toml").optics
    assert edge_shift_um(optics, Refraction(1.0)) == pytest.approx(5.4)
    assert edge_shift_um(optics, Refraction(0.0, 0.6, 0.8)) == pytest.approx(5.4)


@pytest.mark.parametrize(
    ("scene", "field_deg", "captured"),
    [
        ("healthy.toml", 33.4, 0.98),
        ("healthy.toml", 45.0, 0.86),
        ("crowded_imx296.toml", 33.4, 0.72),
        ("crowded_imx296.toml", 45.0, 0.54),
    ],
)
def test_the_captured_fraction_is_that_of_the_table(scene, field_deg, captured):
    """optics.md 1.5."""
    world = World(with_field(load_head(SCENES / scene), field_deg), VirtualClock())
    assert captured_fraction(world) == pytest.approx(captured, abs=0.006)


def test_a_folder_that_cannot_be_written_is_an_error_with_a_remedy(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        simulate(coarse("healthy.toml"), tmp_path / "file" / "inside")
