"""Laterality estimate: no wrong eye, None if uncertain, and the opposite answer for mirror images."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pictures
from scipy import ndimage

from device.recon.assessment.laterality import Laterality, laterality
from device.sim.fundus import fundus
from device.values import Eye, Image

PER_DEG, FIELD_DEG = 8.0, 33.4
OTHER: dict[Eye | None, Eye | None] = {"OD": "OS", "OS": "OD", None: None}
PHOTOS = Path(__file__).parents[2].parent / "shared" / "data" / "fundus" / "hrf" / "images"
# Eye, and (row, col) of the picture's centre in the photograph, between macula and disc; 54.4 pixels per degree.
EYES: dict[str, tuple[Eye, int, int]] = {
    "06_dr.JPG": ("OD", 1142, 2051),
    "07_h.jpg": ("OD", 1177, 2168),
    "09_g.jpg": ("OS", 1206, 1482),
}


@cache
def retina(seed: int, eye: Eye = "OD", wide_deg: float = FIELD_DEG, exudates: int = 0) -> Image:
    size = round(wide_deg * PER_DEG) + 4
    found = fundus((size, size), PER_DEG, wide_deg, seed, eye=eye, exudates=exudates)
    return found.reflectance["green"]


def field_of_view(whole: Image, right_deg: float, turned_deg: float = 0.0) -> Image:
    """Return the field of a head that looks `right_deg` to the right in a wider picture, rotated by `turned_deg`."""
    moved = ndimage.shift(ndimage.rotate(whole, turned_deg, reshape=False, order=1), (0, -right_deg * PER_DEG), order=1)
    size = round(FIELD_DEG * PER_DEG) + 4
    first = (moved.shape[0] - size) // 2
    seen = moved[first : first + size, first : first + size]
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return np.where(np.hypot(x, y) < FIELD_DEG * PER_DEG / 2, seen, 0).astype(np.float32)


def estimated(picture: Image) -> Laterality:
    return laterality(picture, PER_DEG, FIELD_DEG)


@given(
    st.integers(0, 9999),
    st.integers(100, 290),
    st.integers(100, 290),
    st.sampled_from([3.0, 5.5, 8.0, 16.0]),
    st.booleans(),
)
def test_a_mirrored_picture_gives_exactly_the_other_eye(
    seed: int, rows: int, cols: int, per_deg: float, has_disc: bool
) -> None:
    picture = np.random.default_rng(seed).random((rows, cols), np.float32)
    if has_disc:
        whole = retina(seed % 4)[:rows, :cols]
        picture = picture[: whole.shape[0], : whole.shape[1]] * np.float32(0.02) + whole
    here, there = (laterality(seen, per_deg, FIELD_DEG) for seen in (picture, picture[:, ::-1]))
    assert there.eye == OTHER[here.eye]
    assert there.confidence == here.confidence
    if here.disc is not None and there.disc is not None:
        assert there.disc == (here.disc[0], picture.shape[1] - 1 - here.disc[1])


def test_drawn_retinas_get_no_wrong_eye_when_rotated_diseased_or_noisy() -> None:
    results: list[tuple[Eye | None, Eye]] = []
    for seed in range(6):
        for eye in ("OD", "OS"):
            for turned_deg in (-10.0, 10.0):
                whole = retina(seed, eye, 45.0, 20 * (seed % 2))
                seen = field_of_view(whole, 0.0, turned_deg)
                noise = np.random.default_rng(seed).standard_normal(seen.shape, np.float32)
                results.append((estimated(seen * (1 + np.float32(0.1) * noise)).eye, eye))
    assert not [result for result in results if result[0] == OTHER[result[1]]]
    assert sum(found == eye for found, eye in results) >= 0.6 * len(results)


def test_the_position_of_the_disc_is_returned() -> None:
    size = round(FIELD_DEG * PER_DEG) + 4
    drawn = fundus((size, size), PER_DEG, FIELD_DEG, 3)
    found = estimated(drawn.reflectance["green"])
    assert found.eye == "OD"
    assert found.disc is not None
    assert drawn.disc is not None
    assert np.hypot(*np.subtract(found.disc, drawn.disc)) < 2.0 * PER_DEG


@pytest.mark.parametrize("right_deg", [10.0, 18.0], ids=["the nerve in the middle", "the nose's side of the nerve"])
def test_pictures_without_a_macula_give_no_eye(right_deg: float) -> None:
    assert [estimated(field_of_view(retina(seed, wide_deg=80.0), right_deg)).eye for seed in range(4)] == [None] * 4


def test_bright_patches_without_vessels_give_no_eye() -> None:
    """Exudates on the other side of the macula, and the disc outside the field."""
    whole = retina(2, wide_deg=80.0)
    seen = field_of_view(whole, -12.0)
    y, x = (np.mgrid[: seen.shape[0], : seen.shape[1]] - (seen.shape[0] - 1) / 2) / PER_DEG
    for number in range(4):
        dots = np.zeros_like(seen)
        for row, col in np.random.default_rng(number).normal((0, -9), 1.2, (40, 2)):
            dots = np.maximum(dots, np.exp(-((y - row) ** 2 + (x - col) ** 2) / 0.25**2))
        assert estimated((seen * (1 + 0.6 * dots)).astype(np.float32)).eye is None


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((270, 270), np.float32),
        np.full((270, 270), 0.3, np.float32),
        np.full((270, 270), np.nan, np.float32),
        np.random.default_rng(1).random((270, 270), np.float32),
        np.ones((3, 4), np.float32),
        -np.ones((270, 270), np.float32),
        np.tile(np.linspace(0, 1, 270, dtype=np.float32), (270, 1)),
    ],
    ids=["black", "even", "no numbers", "noise", "tiny", "negative", "a ramp"],
)
def test_pictures_other_than_retinas_give_no_eye(picture: Image) -> None:
    assert estimated(picture).eye is None


def test_pixels_too_coarse_for_vessels_give_no_eye() -> None:
    assert laterality(retina(1)[::4, ::4], PER_DEG / 4, FIELD_DEG) == Laterality(None, 0.0)


@pytest.mark.skipif(not PHOTOS.is_dir(), reason=f"there are no photographs in {PHOTOS}")
@pytest.mark.parametrize("name", EYES)
def test_photographs_get_their_eye(name: str) -> None:
    eye, row, col = EYES[name]
    half, results = round(54.4 * FIELD_DEG / 2), []
    y, x = np.mgrid[: 2 * half, : 2 * half] - (half - 0.5)
    with Pictures.open(PHOTOS / name) as photo:
        green = photo.convert("RGB").getchannel("G")
    for turned_deg in (-10, 0, 10):
        turned = green.rotate(turned_deg, center=(col, row)).crop((col - half, row - half, col + half, row + half))
        seen = np.where(np.hypot(x, y) < half, np.asarray(turned, np.float32), 0)
        results.append(laterality(seen, 54.4, FIELD_DEG).eye)
    assert OTHER[eye] not in results
    assert results.count(eye) >= 2, results
