"""Notes on PSF images: stray light, values cut off below, few counts, noise; and images without any of these."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from device.config.image_files import as_psf, psf_counts
from services.research.psf_notes import background_notes, damage_notes

SHAPE = (120, 160)
PEAK_DN = 3000.0


def caustic() -> NDArray[np.float64]:
    """Return filaments around the centre, 0 to 1, whose light ends gently."""
    rng = np.random.default_rng(8)
    rows, cols = (np.arange(size) - size / 2 for size in SHAPE)
    envelope = np.exp(-(rows[:, None] ** 2 + cols**2) / 600)
    lines = ndimage.gaussian_filter(rng.normal(size=SHAPE), 2) ** 2 * envelope
    return np.asarray(lines / lines.max(), np.float64)


def measured(noise_dn: float = 2.0, peak_dn: float = PEAK_DN) -> NDArray[np.float64]:
    """Return counts of the caustic over a black level of 64."""
    return caustic() * peak_dn + 64 + np.random.default_rng(9).normal(0, noise_dn, SHAPE)


def notes_on(pixels: NDArray[Any]) -> tuple[str, ...]:
    counts = np.rint(pixels).clip(0).astype(np.uint16) if pixels.max() > 1 else pixels.astype(np.float32)
    raw = psf_counts(counts, "psf")
    return (*background_notes(raw, "psf"), *damage_notes(raw, as_psf(counts, "psf")))


RAMP = np.linspace(0, 1, SHAPE[1]) * np.ones((SHAPE[0], 1))


@pytest.mark.parametrize(
    "pixels",
    [
        measured(),
        measured() - 64,
        caustic() * PEAK_DN,
        caustic() * 0.9,
        measured() + 100,
        np.where(caustic() == 1, 3000.0, 0.0),
    ],
    ids=["measured", "black level off", "no noise", "float", "brighter background", "one point"],
)
def test_a_psf_without_a_defect_has_no_note(pixels: NDArray[np.float64]) -> None:
    assert notes_on(pixels) == ()


@pytest.mark.parametrize(
    ("words", "pixels"),
    [
        ("stray light that rises by", measured() + 0.1 * PEAK_DN * RAMP),
        ("is cut off below", measured() - 64 - 100),
        ("has few counts", measured(0.3, 10.0)),
        ("is noisy", measured(200.0) + 1000),
    ],
)
def test_each_defect_of_a_psf_has_its_note(words: str, pixels: NDArray[np.float64]) -> None:
    (note,) = notes_on(pixels)
    assert words in note
    assert "easure" in note


def test_a_plane_of_stray_light_is_taken_out() -> None:
    even, uneven = (as_psf(measured() + share * PEAK_DN * RAMP, "psf").pixels for share in (0.0, 0.1))
    assert np.abs(uneven - even).max() < 0.01 * even.max()
