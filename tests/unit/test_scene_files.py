"""Simulated scenes as files, and the plan of their effects."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from device.config.head_file import load_head
from device.config.marked_files import is_marked_simulated
from device.errors import SettingError, StoreError
from device.sim.effects import EFFECTS
from device.sim.scene_files import simulate
from tests import simulated

SCENES = Path(__file__).parents[2] / "device" / "sim" / "scenes"


def coarse(name):
    """Return a scene with 4 x 4 of its pixels summed."""
    return simulated.coarse(load_head(SCENES / name), 4)


def with_field(spec, field_deg):
    return spec.model_copy(update={"optics": spec.optics.model_copy(update={"field_deg": field_deg})})


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_scene_can_be_simulated(path, tmp_path):
    spec = coarse(path.name)
    simulate(spec, tmp_path)
    shape = (spec.camera.rows, spec.camera.cols)
    raw, truth = tifffile.imread(tmp_path / "raw.tiff"), np.load(tmp_path / "truth.npy")
    psf = tifffile.imread(tmp_path / "psf.tiff")
    assert (raw.dtype, raw.shape) == (np.dtype(np.uint16), shape)
    assert (truth.dtype, truth.shape) == (np.dtype(np.float32), shape)
    assert (psf.dtype, psf.shape) == (np.dtype(np.float32), shape)
    assert (raw == spec.camera.white_dn).mean() <= 2 * spec.sim.sensor.hot_pixels  # nothing else saturates
    if spec.sim.object.kind == "retina":
        vessels = np.asarray(Image.open(tmp_path / "vessels.png"))
        assert vessels.shape == shape
        assert set(np.unique(vessels)) == {0, 255}
        place = np.indices(shape) - (np.array(shape)[:, None, None] - 1) / 2
        even = np.hypot(*place) < 10 * spec.optics.geometry(spec.camera.pitch_um).px_per_deg  # before any soft edge
        assert truth[even & (vessels > 0)].mean() < truth[even & (vessels == 0) & (truth > 0)].mean()


def test_frames_of_a_burst_have_one_diffuser_and_noise_and_motion_of_their_own(tmp_path):
    """The eye of the scene drifts; that of the other stands still, so that its frames differ by their noise only."""
    for name, moves in (("drifting_eye.toml", True), ("healthy.toml", False)):
        folder = tmp_path / name
        simulate(coarse(name), folder, count=3)
        frames = [tifffile.imread(folder / raw).astype(float) for raw in ("raw.tiff", "raw-2.tiff", "raw-3.tiff")]
        simulate(coarse(name), tmp_path / "one")
        assert np.array_equal(frames[0], tifffile.imread(tmp_path / "one" / "raw.tiff"))
        for frame in frames[1:]:
            noise_dn, blocks_dn = (frame - frames[0]).std(), blocks_of_8(frame - frames[0]).std()
            assert noise_dn > 1
            assert (blocks_dn > 2 * noise_dn / 8) == moves  # the mean of 64 pixels has an eighth of white noise
    assert is_marked_simulated(folder / "raw-3.tiff")
    for count in (0, 65):
        with pytest.raises(SettingError, match="cannot be simulated at once"):
            simulate(coarse("healthy.toml"), tmp_path, count=count)


def blocks_of_8(image):
    """Return the means of 8 x 8 pixels."""
    rows, cols = (size // 8 for size in image.shape)
    return image[: rows * 8, : cols * 8].reshape(rows, 8, cols, 8).mean(axis=(1, 3))


def test_plan_json_lists_every_effect(tmp_path):
    simulate(coarse("healthy.toml"), tmp_path)
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert set(plan) == {effect.name for effect in EFFECTS}
    for effect in plan.values():
        assert set(effect) == {"simulated", "eta", "why", "cost_ms"}
        assert math.isfinite(effect["eta"])
        assert effect["simulated"] == (effect["eta"] >= 0.05)
        assert effect["simulated"] or effect["cost_ms"] == 0
    assert not plan["refraction"]["simulated"]
    assert plan["shot"]["simulated"]


def test_a_folder_that_cannot_be_written_is_an_error_with_a_remedy(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        simulate(coarse("healthy.toml"), tmp_path / "file" / "inside")
