"""Microlenses and lenslets at the iris: closed forms of their surface, packing, and spots; OPTICS.md 2.8."""

import numpy as np
import pytest

from device.config.head_file import OpticsSpec, load_head
from device.config.scene import DiffuserSpec
from device.errors import SpecError
from device.optics.diffuser import Refraction, caustic, element_path_um, grid_for
from device.optics.lenslets import CLOSEST, centres_um, reach_um, steepest_rad
from tests.simulated import SCENES

OPTICS, PITCH_UM = OpticsSpec(), 8.0
ARRAY = DiffuserSpec(kind="microlenses", pitch_um=400.0)
RANDOM = DiffuserSpec(kind="lenslets", pitch_um=400.0)


@pytest.mark.parametrize("element", [ARRAY, RANDOM], ids=lambda element: element.kind)
def test_path_is_the_parabola_around_the_nearest_centre(element: DiffuserSpec) -> None:
    grid = grid_for(OPTICS, PITCH_UM, element=element)
    path = element_path_um(OPTICS, grid, 3, element)
    x_um = grid.x_um
    inside = np.argwhere(np.hypot(x_um[:, None], x_um[None, :]) < OPTICS.iris_um / 2)[::977]
    places = np.stack([x_um[inside[:, 1]], x_um[inside[:, 0]]], axis=-1)
    distances = np.hypot(*(places[:, None] - centres_um(element, OPTICS.iris_um, 3)[None]).transpose(2, 0, 1))
    nearest = distances.min(axis=1)
    assert path[inside[:, 0], inside[:, 1]] == pytest.approx(-(nearest**2) / (2 * 6000.0), abs=1e-5)
    assert nearest.max() <= reach_um(element) * 1.03, "no place is farther than the sampled slope allows"
    assert steepest_rad(element, 6000.0) == pytest.approx(reach_um(element) / 6000.0)


def test_lenslets_are_a_random_packing_with_one_centre_for_each_square_of_the_pitch() -> None:
    wide_um = 12000.0
    places = [centres_um(RANDOM, wide_um, seed) for seed in range(3)]
    for found in places:
        apart = np.hypot(*(found[:, None] - found[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(found))
        assert apart.min() >= CLOSEST * RANDOM.pitch_um
    counts = [int((np.abs(found) < wide_um / 2).all(axis=1).sum()) for found in places]
    assert np.mean(counts) == pytest.approx((wide_um / RANDOM.pitch_um) ** 2, rel=0.03)
    assert not np.array_equal(places[0], places[1])


def test_array_focuses_each_lens_to_a_spot_below_its_centre() -> None:
    psf = caustic(OPTICS, PITCH_UM, 1, lines=1, element=ARRAY)
    middle = psf.shape[0] // 2
    spot, pitch_px = psf[middle - 2 : middle + 3, middle - 2 : middle + 3].sum(), 400 / PITCH_UM
    whole = psf[middle - int(pitch_px / 2) : middle + int(pitch_px / 2), middle - 25 : middle + 25].sum()
    assert spot > 0.75 * whole
    assert psf[middle, middle] > 20 * psf[middle, middle + int(pitch_px / 2)]
    assert psf[middle, middle + int(pitch_px)] == pytest.approx(psf[middle, middle], rel=0.02)
    assert psf.sum(dtype=np.float64) == pytest.approx(1, abs=1e-5)


def test_refraction_moves_the_spots_of_lenslets_by_the_scale_of_the_caustic() -> None:
    eye = Refraction(4.0)
    relaxed, strained = (caustic(OPTICS, PITCH_UM, 2, of, 1, element=RANDOM) for of in (Refraction(), eye))
    places = centres_um(RANDOM, OPTICS.iris_um, 2)
    far = places[np.hypot(*places.T) < 1200]
    far = far[np.argmax(np.hypot(*far.T))]
    for psf, scale in ((relaxed, 1.0), (strained, eye.warp(OPTICS)[0, 0])):
        col, row = (round(scale * at / PITCH_UM) + psf.shape[0] // 2 for at in far)
        window = psf[row - 12 : row + 13, col - 12 : col + 13]
        found = np.array(np.unravel_index(window.argmax(), window.shape)) - 12
        assert np.abs(found).max() <= 1
    assert 1200 * (1 - eye.warp(OPTICS)[0, 0]) / PITCH_UM > 1.5, "the shift is larger than the tolerance"


def test_lenses_too_steep_for_the_grid_are_refused_and_other_kinds_unknown(tmp_path) -> None:
    with pytest.raises(SpecError, match=r"needs \d+ samples"):
        grid_for(OPTICS, 5.0, element=DiffuserSpec(kind="lenslets", pitch_um=1000.0))
    text = (SCENES / "human_eye_sim.toml").read_text()
    (tmp_path / "scene.toml").write_text(text + '\n[sim.diffuser]\nkind = "prisms"\n')
    with pytest.raises(SpecError, match=r"sim\.diffuser\.kind: .*'lenslets'"):
        load_head(tmp_path / "scene.toml")
