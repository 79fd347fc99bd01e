"""Montage: shift and rotation between gaze directions, chains of pictures, and pictures that are refused."""

import numpy as np
import pytest
from scipy import ndimage

from device.errors import FrameError
from device.recon.estimation.masked_correlation import Match
from device.recon.model.field_projection import Motion, Plane, Sphere
from device.recon.montage import make_montage, refusal
from tests.moving_retina import (
    GAZE_FIELD_PX,
    GAZE_SIZE,
    OTHER_RETINA,
    WIDE_RETINA,
    directions,
    eye_turn,
    gaze,
    places,
    small_field_gaze,
    sparse_retina,
    turned_gaze,
)

PX_PER_DEG = GAZE_FIELD_PX / 45


@pytest.mark.parametrize("turn_deg", [0.0, 3.0, -4.5])
@pytest.mark.parametrize("shift_px", [(30.0, 10.0), (-20.5, 84.3), (110.0, -40.0)])  # overlaps of 0.8, 0.46 and 0.3
def test_shift_and_rotation_are_found(shift_px: tuple[float, float], turn_deg: float) -> None:
    joined = make_montage([gaze(WIDE_RETINA, (0, 0)), gaze(WIDE_RETINA, shift_px, turn_deg, 1)])
    found = joined.placed[1]
    assert found.used, found.reason
    assert found.shift_px == pytest.approx(shift_px, abs=0.6)  # what a montage may be off by (half a vessel)
    assert found.rotation_deg == pytest.approx(turn_deg, abs=0.3)
    assert found.peak is not None
    assert found.peak > 0.8
    distance = np.hypot(*shift_px) / GAZE_FIELD_PX
    overlap = 2 / np.pi * (np.arccos(distance) - distance * np.sqrt(1 - distance**2))
    assert found.overlap == pytest.approx(overlap, abs=0.05)


@pytest.mark.parametrize("shift_px", [(0.0, 62.3), (44.0, -44.0)], ids=str)  # 8 degrees
def test_a_small_field_is_placed_by_its_retina_and_not_by_its_edge(shift_px: tuple[float, float]) -> None:
    retina = sparse_retina(0)
    found = make_montage([small_field_gaze(retina, (0, 0), 1), small_field_gaze(retina, shift_px, 2)]).placed[1]
    assert found.used, found.reason
    assert found.shift_px == pytest.approx(shift_px, abs=0.6)  # what a montage may be off by (half a vessel)


def test_the_small_fields_of_different_retinas_are_not_joined_by_their_edges() -> None:
    pictures = [small_field_gaze(sparse_retina(seed), (0, 0), seed) for seed in range(4)]
    assert [place.used for place in make_montage(pictures).placed] == [True, False, False, False]


@pytest.mark.parametrize("same", [True, False])
def test_what_stands_still_at_the_edge_places_no_picture(same: bool) -> None:
    """A ring of reflexes inside the edge, which no mask leaves out; the retina below it is the same one or another."""
    rows, cols = np.indices((540, 960))
    angle = np.arctan2(rows - 269.5, cols - 479.5)
    ring = (
        0.3
        * np.exp(-((np.hypot(rows - 269.5, cols - 479.5) - 118) ** 2) / 18)
        * (np.cos(24 * angle) + np.cos(5 * angle))
    )
    pictures = [small_field_gaze(sparse_retina(seed), (0, 0), k) for k, seed in enumerate((0, 0 if same else 1))]
    found = make_montage([np.asarray(picture * (1 + ring), np.float32) for picture in pictures]).placed[1]
    assert found.used is same, found


@pytest.mark.parametrize("turn_deg", [0.0, -3.0])
@pytest.mark.parametrize("shift_px", [(-20.5, 84.3), (110.0, -40.0)])  # turns of 20 and 26 degrees
def test_turns_of_an_eye_are_found_on_the_sphere(shift_px: tuple[float, float], turn_deg: float) -> None:
    pictures = [
        turned_gaze(WIDE_RETINA, (0, 0), 0, 0, PX_PER_DEG),
        turned_gaze(WIDE_RETINA, shift_px, turn_deg, 1, PX_PER_DEG),
    ]
    errors_px = []
    for scale in (None, PX_PER_DEG):
        joined = make_montage(pictures, px_per_deg=scale)
        found = joined.placed[1]
        assert found.used, found.reason
        assert joined.projection == ("plane" if scale is None else "sphere")
        errors_px.append(np.hypot(*np.subtract(found.shift_px, shift_px)))
    assert found.shift_px == pytest.approx(shift_px, abs=0.6)  # what a montage may be off by (half a vessel)
    assert found.rotation_deg == pytest.approx(turn_deg, abs=0.3)
    assert errors_px[1] < errors_px[0]


def test_the_montage_of_a_turned_eye_shows_its_retina() -> None:
    pictures = [turned_gaze(WIDE_RETINA, shift, 0, k, PX_PER_DEG) for k, shift in enumerate([(0, 0), (10, 80)])]
    agreement = []
    for scale in (None, PX_PER_DEG):
        joined = make_montage(pictures, px_per_deg=scale)
        rows, cols = joined.picture.shape
        middle = (np.array(WIDE_RETINA.shape) - 1) / 2 - (GAZE_SIZE - 1) / 2 + np.array(joined.origin_px)
        truth = ndimage.affine_transform(WIDE_RETINA, np.eye(2), middle, (rows, cols), order=3)
        # the part that only the second picture shows: the first one is its own truth
        lit = ndimage.binary_erosion(joined.picture > 0.2, iterations=6)
        lit[:, -joined.origin_px[1] + (GAZE_SIZE - GAZE_FIELD_PX) // 2 :] = False
        assert lit.sum() > 5000
        agreement.append(np.corrcoef(joined.picture[lit], truth[lit])[0, 1])
    assert agreement[1] > 0.95
    assert agreement[1] > agreement[0]


def test_three_turns_about_different_axes_are_composed_as_rotations() -> None:
    """Two turns about different axes are a turn with a torsion of its own, which shifts of a plane do not have."""
    steps = [(0.0, 0.0), (75.0, 20.0), (40.0, 110.0)]
    placed = make_montage(
        [turned_gaze(WIDE_RETINA, step, 0, k, PX_PER_DEG) for k, step in enumerate(steps)], px_per_deg=PX_PER_DEG
    ).placed
    assert all(place.used for place in placed)
    assert placed[2].shift_px == pytest.approx(steps[2], abs=1.2)  # twice the error of one step
    assert placed[2].rotation_deg == pytest.approx(0, abs=0.6)


def test_a_composed_motion_moves_places_as_both_motions_do() -> None:
    here = np.random.default_rng(3).uniform(-100, 100, (40, 2))
    first, then = ((30.0, -80.0), 3.0), ((-55.0, -20.0), -4.0)
    sphere = Sphere(PX_PER_DEG)
    true = here
    for shift_px, turn_deg in (first, then):
        turn = eye_turn(np.array(shift_px), turn_deg, PX_PER_DEG)
        true = places(turn.apply(directions(true, PX_PER_DEG)), PX_PER_DEG)
    both = sphere.composed(Motion(*first), Motion(*then))
    assert sphere.moved(here, both) == pytest.approx(true, abs=1e-6)
    assert sphere.moved_back(true, both) == pytest.approx(here, abs=1e-6)


def test_the_sphere_of_a_small_field_is_the_plane() -> None:
    here, motion = np.array([[0.0, 0.0], [90.0, -40.0], [-15.0, 70.0]]), Motion((30.0, -80.0), 3.0)
    then = Motion((-10.0, 5.0), -2.0)
    plane, sphere = Plane(), Sphere(1e5)  # a picture of 0.002 degrees
    assert sphere.moved(here, motion) == pytest.approx(plane.moved(here, motion), abs=1e-6)
    assert plane.moved_back(plane.moved(here, motion), motion) == pytest.approx(here)
    both, flat = (projection.composed(motion, then) for projection in (sphere, plane))
    assert both.shift == pytest.approx(flat.shift, abs=1e-6)
    assert both.rotation_deg == pytest.approx(flat.rotation_deg, abs=1e-6)


def test_a_scale_that_makes_a_picture_wider_than_half_a_sphere_is_refused() -> None:
    with pytest.raises(FrameError, match="more than 90 degrees from its centre"):
        make_montage([gaze(WIDE_RETINA, (0, 0))], px_per_deg=1.5)


def test_the_montage_shows_the_retina_of_all_pictures_on_the_plane_of_the_first() -> None:
    pictures = [gaze(WIDE_RETINA, (0, 0)), 2 * gaze(WIDE_RETINA, (10, 80), 2.0, 1)]  # twice the exposure
    joined = make_montage(pictures)
    rows, cols = joined.picture.shape
    down, right = joined.origin_px
    middle = (np.array(WIDE_RETINA.shape) - 1) / 2 - (GAZE_SIZE - 1) / 2 + np.array([down, right])
    truth = ndimage.affine_transform(WIDE_RETINA, np.eye(2), middle, (rows, cols), order=3)
    lit = ndimage.binary_erosion(joined.picture > 0.2, iterations=6)
    assert lit.sum() > 1.3 * np.pi * (GAZE_FIELD_PX / 2) ** 2  # more than one field
    assert np.corrcoef(joined.picture[lit], truth[lit])[0, 1] > 0.95
    assert joined.picture[lit].mean() == pytest.approx(truth[lit].mean(), rel=0.05)  # the exposure of the first


def test_a_picture_is_placed_by_another_one_than_the_first() -> None:
    steps = [(0.0, 0.0), (75.0, 20.0), (150.0, 40.0)]
    placed = make_montage([gaze(WIDE_RETINA, step, 0, k) for k, step in enumerate(steps)]).placed
    assert all(place.used for place in placed)
    assert placed[2].shift_px == pytest.approx(steps[2], abs=1.2)  # twice the error of one step


def test_another_eye_and_a_small_overlap_stay_apart_with_the_reason() -> None:
    first = gaze(WIDE_RETINA, (0, 0))
    far = gaze(WIDE_RETINA, (150, 40), 0, 1)  # an overlap of 0.12
    other = gaze(np.asarray(ndimage.zoom(OTHER_RETINA, 1.5, order=3), np.float32), (0, 0), 0, 2)
    joined = make_montage([first, far, other])
    assert [place.used for place in joined.placed] == [True, False, False]
    assert all(place.reason and place.shift_px is None for place in joined.placed[1:])
    assert joined.picture.shape == first.shape


def test_a_montage_of_one_is_that_picture() -> None:
    first = gaze(WIDE_RETINA, (0, 0))
    joined = make_montage([first])
    assert joined.origin_px == (0, 0)
    inside = joined.picture > 0
    assert joined.picture[inside] == pytest.approx(first[inside], rel=1e-5)


@pytest.mark.parametrize(
    ("match", "words"),
    [
        (Match((0, 0), 0, 0.45, 0.1, 0.6), "no picture shows the same part"),
        (Match((0, 0), 0, 0.55, 0.1, 0.25), "no picture shows the same part"),
        (Match((0, 0), 0, 0.7, 0.6, 0.6), "ambiguous"),
        (Match((0, 0), 0, 0.9, 0.2, 0.15), "too small"),
        (Match((0, 0), 0, 0.7, 0.3, 0.27), None),
    ],
)
def test_the_rule_of_acceptance(match: Match, words: str | None) -> None:
    assert words in (refusal(match) or "") if words else refusal(match) is None


def test_pictures_that_cannot_be_joined_are_refused() -> None:
    first = gaze(WIDE_RETINA, (0, 0))
    with pytest.raises(FrameError, match="different sizes"):
        make_montage([first, first[2:]])
    with pytest.raises(FrameError, match="not numbers"):
        make_montage([first, np.full_like(first, np.nan)])
    with pytest.raises(FrameError, match="black"):
        make_montage([first, np.zeros_like(first)])
    with pytest.raises(FrameError, match="1 to 64 pictures, not 0"):
        make_montage([])
    with pytest.raises(FrameError, match="8 x 8 pixels shows no vessels"):
        make_montage([first[:8, :8]])
    for wrong in (first[0], np.stack([first] * 4, axis=2)):
        with pytest.raises(FrameError):
            make_montage([wrong])


def test_pictures_in_colour_are_placed_by_their_green_channel_and_keep_their_colour() -> None:
    first, second = (gaze(WIDE_RETINA, shift, 0, k) for k, shift in enumerate([(0.0, 0.0), (20.0, 60.0)]))
    joined = make_montage([np.stack([2 * picture, picture, picture / 2], axis=2) for picture in (first, second)])
    assert joined.placed[1].shift_px == pytest.approx((20, 60), abs=0.6)
    red, green, blue = (joined.picture[..., channel][joined.picture[..., 1] > 0.2] for channel in range(3))
    assert red == pytest.approx(2 * green, rel=1e-4)
    assert blue == pytest.approx(green / 2, rel=1e-4)


def test_pictures_without_detail_stay_apart() -> None:
    disc = (gaze(WIDE_RETINA, (0, 0)) > 0).astype(np.float32)
    assert not make_montage([disc, disc]).placed[1].used
