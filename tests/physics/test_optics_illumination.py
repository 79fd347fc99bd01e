"""Photon budget against the table of OPTICS.md 4.2."""

import pytest

from device.optics.illumination import photon_budget
from device.values import Colour

TABLE: dict[Colour, tuple[float, float, float, float]] = {
    "red": (0.246, 0.301, 12.2, 21900),
    "green": (0.210, 0.257, 2.9, 4200),
    "blue": (0.519, 0.635, 4.5, 4500),
}


@pytest.mark.parametrize("colour", TABLE)
def test_the_photon_budget_equals_the_table(colour: Colour) -> None:
    """The solid angle of the field is taken from its area, which is 9 % more than the table's cone."""
    cornea_mw, retina, image_nw, electrons = TABLE[colour]
    found = photon_budget(colour, 5.04)
    assert found.cornea_mw == pytest.approx(cornea_mw, rel=0.01)
    assert found.retina_mw_per_cm2 == pytest.approx(retina, rel=0.01)
    assert found.image_nw == pytest.approx(image_nw, rel=0.1)
    assert found.electrons_per_px_s == pytest.approx(electrons, rel=0.1)


def test_larger_pixels_collect_more_and_a_wider_field_less() -> None:
    small, large = photon_budget("green", 5.04), photon_budget("green", 10.08)
    assert large.electrons_per_px_s == pytest.approx(4 * small.electrons_per_px_s)
    wide = photon_budget("green", 5.04, field_deg=50)
    assert wide.cornea_mw == pytest.approx(2.2 * small.cornea_mw, rel=0.01), "sin^2 of 18.71 and of 12.5 degrees"
    assert wide.retina_mw_per_cm2 < small.retina_mw_per_cm2
