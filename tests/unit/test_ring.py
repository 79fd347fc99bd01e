"""The ring without a wire: its bytes, which LEDs it is made of, and what they draw."""

import numpy as np
import pytest

from device.drivers.blank import blank_frame
from device.drivers.ring import chosen_leds
from device.drivers.wire import current_ma, encoded, levels
from device.errors import SpecError
from device.optics.ring import ring, ring_for_pupil_mm, rings_mm
from device.spec import LightSpec

LUMINI = (3.175, (3.5, 3.5), 8, 8)


def test_a_frame_is_268_bytes_with_blue_first_and_zeros_at_both_ends():
    rgb = np.zeros((64, 3), np.uint8)
    rgb[0], rgb[63] = (1, 2, 3), (4, 5, 6)
    frame = encoded(rgb)
    assert len(frame) == 268
    assert frame[:12] == bytes(4) + b"\xff\x03\x02\x01" + b"\xff\0\0\0"
    assert frame[256:] == b"\xff\x06\x05\x04" + bytes(8)


def test_global_brightness_is_31_in_every_frame_and_darkness_is_the_blanker_s_own():
    dark = encoded(np.zeros((64, 3), np.uint8))
    assert dark == blank_frame()
    assert set(dark[4:260:4]) == {0xFF}


@pytest.mark.parametrize("leds", [1, 8, 64, 65, 144])
def test_the_tail_clocks_the_last_led_and_latches_its_clones(leds):
    tail = len(blank_frame(leds)) - 4 - 4 * leds
    assert 8 * tail >= leds / 2 + 32


def test_the_board_s_rings_are_those_of_its_own_drawing():
    assert ring(10.04, 0.01, *LUMINI) == (19, 20, 26, 29, 34, 37, 43, 44)
    assert len(ring(4.49, 0.01, *LUMINI)) == 4
    assert ring(7.67, 1.4, 3.175, (3, 3), 8, 8) == (18, 19, 20, 26, 28, 34, 35, 36)
    assert rings_mm(*LUMINI)[:3] == (4.49, 10.04, 13.47)
    with pytest.raises(SpecError) as refused:
        ring(8, 0.5, *LUMINI)
    assert "10.04" in refused.value.remedy


def test_a_pupil_chooses_the_widest_ring_that_passes_it_through_the_relay():
    assert ring_for_pupil_mm(10, 0.80, 2.0, *LUMINI) == 10.04
    assert ring_for_pupil_mm(9.6, 0.80, 2.0, *LUMINI) == 4.49  # 8.03 mm between centres, 9.63 mm with the LEDs
    with pytest.raises(SpecError):
        ring_for_pupil_mm(3, 1.0, 2.0, *LUMINI)
    assert len(chosen_leds(LightSpec(backend="apa102", pupil_mm=10, relay_magnification=0.8))) == 8


def test_leds_of_unequal_strength_are_driven_to_the_weakest():
    drive = levels(1.0, np.array([1.0, 0.8, 1.0]))
    assert drive.tolist() == [204, 255, 204]
    assert levels(0.0001, np.ones(2)).tolist() == [1, 1]  # asked to shine, it is not dark


def test_current_is_20_ma_for_a_full_colour():
    rgb = np.zeros((64, 3), np.uint8)
    rgb[:8, 1] = 255
    assert current_ma(rgb) == pytest.approx(160)
    assert current_ma(np.full((64, 3), 255, np.uint8)) == pytest.approx(3840)


def test_colours_are_known_by_their_wavelength():
    spec = LightSpec(backend="apa102")
    assert [spec.colour_near(um) for um in (0.46, 0.55, 0.66)] == ["blue", "green", "red"]
    assert spec.peak_um("green") == 0.5225


def test_a_calibration_needs_every_led():
    with pytest.raises(ValueError, match="64 LEDs"):
        LightSpec(backend="apa102", led_output=(1.0, 1.0))
