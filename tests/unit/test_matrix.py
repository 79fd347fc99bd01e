"""Ring selection on an LED matrix by geometry (OPTICS.md 3.5)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.config.head_file import ChainSpec
from device.errors import SpecError
from device.optics.matrix import led_positions_mm, ring, ring_at_pupil_mm, ring_for_pupil

LUMINI = ChainSpec()


def test_the_lumini_has_one_clean_ring_near_that_of_the_paper():
    assert ring(LUMINI) == (19, 20, 26, 29, 34, 37, 43, 44)
    assert ring_at_pupil_mm(LUMINI, 0.75) == pytest.approx(7.53, abs=0.01)


def test_the_papers_grid_has_a_ring_of_twelve():
    paper = ChainSpec(pitch_mm=2.0, ring_mm=9.34, tolerance_mm=2.0)
    assert ring(paper) == (11, 12, 18, 21, 25, 30, 33, 38, 42, 45, 51, 52)


def test_a_ring_is_centred_on_the_axis():
    around = ChainSpec(axis=(3.0, 3.0), ring_mm=7.67, tolerance_mm=3.0)
    assert set(ring(around)) == {18, 19, 20, 26, 28, 34, 35, 36}


def test_a_missing_ring_is_refused_with_the_nearest():
    with pytest.raises(SpecError, match=r"4\.49 mm"):
        ring(ChainSpec(ring_mm=5.5))


def test_more_leds_than_the_supply_can_carry_are_refused():
    with pytest.raises(SpecError, match="most_lit"):
        ring(ChainSpec(ring_mm=14.0, tolerance_mm=9.0, most_lit=8))


@given(st.floats(3.4, 15))
def test_a_pupil_gets_the_widest_ring_that_fits_into_it(pupil_mm):
    chosen = ring_for_pupil(LUMINI, pupil_mm, 0.75)
    assert ring_at_pupil_mm(chosen, 0.75) <= pupil_mm
    assert len(ring(chosen)) >= 4
    wider = [
        place for place in led_positions_mm(LUMINI) if 2 * (place[0] ** 2 + place[1] ** 2) ** 0.5 > chosen.ring_mm + 0.2
    ]
    for right, up in wider:
        other = LUMINI.model_copy(update={"ring_mm": 2 * (right**2 + up**2) ** 0.5})
        assert ring_at_pupil_mm(other, 0.75) > pupil_mm or len(ring(other)) < 4


def test_a_pupil_too_small_for_any_ring_is_refused():
    with pytest.raises(SpecError, match="pupil"):
        ring_for_pupil(LUMINI, 2.0, 0.75)
