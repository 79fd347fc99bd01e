"""Notes on counts that are not those of a sensor, and frames of a sensor, which have none."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from device.config.image_files import as_raw
from services.research.raw_notes import bits_note, gamma_of, raw_notes
from services.research.reconstruct_inputs import linear
from tests.hard.defects import jpeg

FULL_DN, GAIN_E_PER_DN, READ_E = 4095, 5.6, 2.0


def light(share: float = 0.6) -> NDArray[np.float64]:
    """Return counts above black of smooth light, up to a share of 12 bits, with the noise of a sensor."""
    rng = np.random.default_rng(4)
    smooth = ndimage.gaussian_filter(rng.normal(size=(300, 400)), 12)
    expected_e = (smooth - smooth.min()) / np.ptp(smooth) * share * FULL_DN * GAIN_E_PER_DN
    return np.rint((rng.poisson(expected_e) + rng.normal(0, READ_E, expected_e.shape)) / GAIN_E_PER_DN)


def eight_bits(counts: NDArray[np.float64], gamma: float = 1.0) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(counts / FULL_DN, 0, 1) ** (1 / gamma)).astype(np.uint8)


def notes_on(counts: NDArray[Any], is_linear: bool = False) -> tuple[str, ...]:
    return raw_notes(as_raw(counts), "raw", is_linear)


@pytest.mark.parametrize("share", [0.6, 0.05, 0.01])
def test_counts_of_a_sensor_have_no_note(share: float) -> None:
    assert notes_on((light(share) + 64).clip(0).astype(np.uint16)) == ()
    assert notes_on(eight_bits(light(share))) == ()


def test_a_gamma_is_found_by_its_noise_and_undone() -> None:
    encoded = eight_bits(light(), 2.2)
    assert gamma_of(encoded.astype(np.float64)) == pytest.approx(2.2, abs=0.25)
    (note,) = notes_on(encoded)
    assert "--gamma 2.2" in note
    assert notes_on(encoded, is_linear=True) == ()
    undone = linear(encoded, 255.0, 2.2) * (FULL_DN / 255)
    assert np.abs(undone - light().clip(0)).max() < 0.02 * FULL_DN


@pytest.mark.parametrize("corner", [(0, 0), (3, 5)])
def test_blocks_of_a_jpeg_are_found_wherever_it_is_cropped(corner: tuple[int, int]) -> None:
    (note,) = notes_on(jpeg(eight_bits(light()))[corner[0] :, corner[1] :])
    assert "JPEG" in note


def test_eight_bits_are_stated_where_the_converter_has_more() -> None:
    raw = as_raw(eight_bits(light()))
    assert "has 8 bits" in bits_note(raw, "raw", 12)[0]
    assert bits_note(raw, "raw", 8) == ()
    assert bits_note(as_raw(light().clip(0).astype(np.uint16)), "raw", 12) == ()
