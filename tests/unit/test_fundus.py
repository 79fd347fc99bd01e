"""Procedural fundus: reproducible, and within published figures of real eyes."""

import numpy as np
import pytest
from scipy import ndimage

from device.sim.fundus import COLOURS, fundus

PX_PER_DEG, FIELD_DEG = 15.583, 33.4
SHAPE = (540, 560)


@pytest.fixture(scope="module")
def healthy():
    return fundus(SHAPE, PX_PER_DEG, FIELD_DEG, 1)


def around(picture, place, radius_px):
    rows, cols = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return picture[np.hypot(rows - place[0], cols - place[1]) < radius_px]


def spots(mask, smallest=3):
    labels, found = ndimage.label(mask)
    return int((ndimage.sum_labels(mask, labels, range(1, found + 1)) >= smallest).sum())


def test_fundus_is_reproducible_by_seed(healthy):
    again, other = fundus(SHAPE, PX_PER_DEG, FIELD_DEG, 1), fundus(SHAPE, PX_PER_DEG, FIELD_DEG, 2)
    for colour in COLOURS:
        assert np.array_equal(healthy.reflectance[colour], again.reflectance[colour])
    assert (healthy.vessels ^ other.vessels).sum() > 0.3 * healthy.vessels.sum()


@pytest.mark.parametrize("shape", [(540, 560), (541, 560), (541, 563)])
def test_the_left_eye_is_the_mirror_image(shape):
    right, left = (fundus(shape, PX_PER_DEG, FIELD_DEG, 4, eye=eye, haemorrhages=3) for eye in ("OD", "OS"))
    for colour in COLOURS:
        assert np.array_equal(right.reflectance[colour][:, ::-1], left.reflectance[colour])
    assert left.disc == pytest.approx((right.disc[0], shape[1] - 1 - right.disc[1]))
    assert right.disc[1] > right.fovea[1]
    assert left.disc[1] < left.fovea[1]


def test_the_field_is_a_disc_of_the_right_size_and_dark_outside(healthy):
    radius = PX_PER_DEG * FIELD_DEG / 2
    assert healthy.field.sum() == pytest.approx(np.pi * radius**2, rel=0.005)
    far = ~ndimage.binary_dilation(healthy.field, iterations=2)
    for colour in COLOURS:
        plane = healthy.reflectance[colour]
        assert plane.dtype == np.float32
        assert not plane[far].any()
        assert plane[ndimage.binary_erosion(healthy.field, iterations=2)].min() > 0


def test_a_field_larger_than_the_frame_is_cropped_to_its_centre(healthy):
    part = fundus((300, 400), PX_PER_DEG, FIELD_DEG, 1)
    assert np.array_equal(part.reflectance["green"], healthy.reflectance["green"][120:420, 80:480])
    assert part.fovea == pytest.approx((healthy.fovea[0] - 120, healthy.fovea[1] - 80))


def test_reflectance_levels_equal_published_values(healthy):
    """Delori & Pflibsen 1989: perifovea .81, 1.41, 4.9 % in blue, green, red; the disc two to three times that."""
    inside = healthy.field & ~healthy.vessels
    typical = {colour: np.median(healthy.reflectance[colour][inside]) for colour in COLOURS}
    for colour, percent in {"red": 4.9, "green": 1.41, "blue": 0.81}.items():
        assert typical[colour] == pytest.approx(percent / 100, rel=0.15)
    disc = np.median(around(healthy.reflectance["green"], healthy.disc, 30))
    assert 1.8 < disc / typical["green"] < 3.2
    fovea = {
        colour: around(healthy.reflectance[colour], healthy.fovea, 6).mean() / typical[colour] for colour in COLOURS
    }
    assert fovea["blue"] < fovea["green"] < fovea["red"] < 0.95


def test_vessels_are_dark_in_green_and_nearly_invisible_in_red(healthy):
    wide = ndimage.binary_erosion(healthy.vessels, iterations=2)  # the middle of the trunks
    beside = ndimage.binary_dilation(healthy.vessels, iterations=6) & ~ndimage.binary_dilation(healthy.vessels)
    away = np.hypot(*(np.indices(SHAPE) - np.array(healthy.disc)[:, None, None])) > 60
    contrast = {}
    for colour in COLOURS:
        plane = healthy.reflectance[colour]
        contrast[colour] = 1 - np.median(plane[wide & away]) / np.median(plane[beside & away & healthy.field])
    assert 0.3 < contrast["green"] < 0.6
    assert contrast["blue"] < contrast["green"]
    assert contrast["red"] < 0.15


@pytest.mark.parametrize("seed", range(1, 9))
def test_every_eye_has_connected_vessels_and_a_free_fovea(seed):
    eye = fundus(SHAPE, PX_PER_DEG, FIELD_DEG, seed)
    share = eye.vessels.sum() / eye.field.sum()
    assert 0.05 < share < 0.2  # manual masks of real eyes: 8 to 14 %
    assert not around(eye.vessels, eye.fovea, 0.9 * PX_PER_DEG).any()
    labels, found = ndimage.label(eye.vessels, np.ones((3, 3)))
    sizes = np.sort(ndimage.sum_labels(eye.vessels, labels, range(1, found + 1)))
    assert sizes[-4:].sum() > 0.9 * eye.vessels.sum()
    middle = np.abs(np.arange(SHAPE[1]) - eye.fovea[1]) < 3 * PX_PER_DEG
    trunks = ndimage.binary_erosion(eye.vessels)[:, middle]
    heights = (np.flatnonzero(trunks.any(1)) - eye.fovea[0]) / PX_PER_DEG
    assert heights.min() < -4.5  # an arcade above the macula,
    assert heights.max() > 4.5  # and one below


def test_lesions_change_only_their_own_pixels(healthy):
    diseased = fundus(SHAPE, PX_PER_DEG, FIELD_DEG, 1, haemorrhages=5, microaneurysms=7, exudates=6)
    ratio = np.where(healthy.field, diseased.reflectance["green"] / np.maximum(healthy.reflectance["green"], 1e-9), 1)
    assert 6 <= spots(ratio < 0.85) <= 12  # some may touch
    assert 2 <= spots(ratio > 1.15) <= 6
    assert (np.abs(ratio - 1) < 0.01).mean() > 0.95
    assert np.array_equal(diseased.vessels, healthy.vessels)


@pytest.mark.parametrize(("px_per_deg", "field_deg"), [(4.0, 33.4), (15.583, 12.0), (22.8, 50.0)])
def test_other_scales_and_fields_are_drawn(px_per_deg, field_deg):
    eye = fundus((301, 400), px_per_deg, field_deg, 3, haemorrhages=2, exudates=3)
    assert all(np.isfinite(plane).all() and plane.max() > 0 for plane in eye.reflectance.values())
