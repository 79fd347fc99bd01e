"""Which LEDs make a ring, by geometry alone (device.md 4)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.errors import SpecError
from device.optics.matrix import for_pupil, places_mm, ring, ring_at_pupil_mm
from device.spec import ChainSpec

LUMINI = ChainSpec()


def test_the_lumini_has_one_clean_ring_near_that_of_the_paper():
    assert ring(LUMINI) == (19, 20, 26, 29, 34, 37, 43, 44)
    assert ring_at_pupil_mm(LUMINI, 0.75) == pytest.approx(7.53, abs=0.01)


def test_the_papers_grid_would_have_twelve():
    paper = ChainSpec(pitch_mm=2.0, ring_mm=9.34, tolerance_mm=2.0)
    assert ring(paper) == (11, 12, 18, 21, 25, 30, 33, 38, 42, 45, 51, 52)


def test_a_ring_around_an_led_is_a_matter_of_the_axis():
    around = ChainSpec(axis=(3.0, 3.0), ring_mm=7.67, tolerance_mm=3.0)
    assert set(ring(around)) == {18, 19, 20, 26, 28, 34, 35, 36}


def test_a_ring_that_the_matrix_does_not_have_is_refused_with_the_nearest():
    with pytest.raises(SpecError, match=r"4\.49 mm"):
        ring(ChainSpec(ring_mm=5.5))


def test_more_leds_than_the_supply_can_carry_are_refused():
    with pytest.raises(SpecError, match="most_lit"):
        ring(ChainSpec(ring_mm=14.0, tolerance_mm=9.0, most_lit=8))


@given(st.floats(3.4, 15))
def test_a_pupil_gets_the_widest_ring_that_fits_into_it(pupil_mm):
    chosen = for_pupil(LUMINI, pupil_mm, 0.75)
    assert ring_at_pupil_mm(chosen, 0.75) <= pupil_mm
    assert len(ring(chosen)) >= 4
    wider = [place for place in places_mm(LUMINI) if 2 * (place[0] ** 2 + place[1] ** 2) ** 0.5 > chosen.ring_mm + 0.2]
    for right, up in wider:
        other = LUMINI.model_copy(update={"ring_mm": 2 * (right**2 + up**2) ** 0.5})
        assert ring_at_pupil_mm(other, 0.75) > pupil_mm or len(ring(other)) < 4


def test_a_pupil_of_two_millimetres_is_too_small_for_any():
    with pytest.raises(SpecError, match="pupil"):
        for_pupil(LUMINI, 2.0, 0.75)
