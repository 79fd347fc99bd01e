"""A pupil that hides part of the diffuser: its share of a PSF, and the place of its edge."""

import numpy as np
import pytest

from device.recon.estimation.refraction.notation import widened
from device.recon.estimation.refraction.pupil import SOFT_UM, Pupil
from device.values import Psf

SHAPE = (129, 161)
PITCH_UM = 20.0


def even_disc(radius_um: float) -> Psf:
    rows, cols = (np.arange(size) - size // 2 for size in SHAPE)
    inside = np.hypot(rows[:, None], cols[None]) * PITCH_UM <= radius_um
    return Psf(np.asarray(inside / inside.sum(), np.float32))


def test_a_large_pupil_through_the_centre_hides_half_of_an_even_psf() -> None:
    radius_um = 1e7
    hidden_psf, hidden = Pupil(radius_um, 0.0, radius_um).hide(even_disc(1000.0), PITCH_UM)
    assert hidden == pytest.approx(0.5, abs=0.005)
    assert hidden_psf.pixels.sum() == pytest.approx(1.0, abs=1e-5)
    left, right = hidden_psf.pixels[:, : 80 - 4], hidden_psf.pixels[:, 80 + 4 :]
    assert left.sum() < 1e-3 < 0.9 < right.sum()


def test_a_pupil_is_down_with_the_rows() -> None:
    hidden_psf, _ = Pupil(0.0, 500.0, 400.0).hide(even_disc(1000.0), PITCH_UM)
    rows = hidden_psf.pixels.sum(axis=1)
    assert np.average(np.arange(SHAPE[0]), weights=rows) == pytest.approx(SHAPE[0] // 2 + 25, abs=0.5)


def test_a_wide_pupil_hides_nothing() -> None:
    psf = even_disc(1000.0)
    same, hidden = Pupil(100.0, 0.0, 1100.0 + 6 * SOFT_UM).hide(psf, PITCH_UM)
    assert hidden == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(same.pixels, psf.pixels, rtol=1e-4)


@pytest.mark.parametrize(("pupil", "nearest_um"), [((300, 400, 900), 400), ((0, 0, 700), 700), ((0, 800, 700), -100)])
def test_nearest_place_of_the_edge(pupil: tuple[float, float, float], nearest_um: float) -> None:
    assert Pupil(*pupil).nearest_um == pytest.approx(nearest_um)


def test_a_hidden_share_widens_only_the_deviations_that_are_known() -> None:
    known = {"sphere": 1.0, "sd": 0.3, "j0_sd": None, "j45_sd": 0.0, "refused": None}
    assert widened(known, 0.4) == pytest.approx(known | {"sd": 0.5, "j45_sd": 0.4})
    assert widened(None, 0.4) is None


def test_a_softer_edge_hides_a_part_of_what_is_near_it() -> None:
    places_um = np.array([-170.0, 0.0, 170.0])
    passed = Pupil(-1e6, 0.0, 1e6, 170.0).passed(places_um, np.zeros(3))
    np.testing.assert_allclose(passed, [0.841, 0.5, 0.159], atol=0.001)
    assert Pupil(1.0, 2.0, 3.0, 170.0).moved(np.array([0.5, 0.0, -1.0])) == Pupil(1.5, 2.0, 2.0, 170.0)
