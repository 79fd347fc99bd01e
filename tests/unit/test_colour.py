"""Colour pictures: registration to green, the guided filter, and a blue that was not taken."""

import numpy as np
import pytest
from scipy import ndimage

from device.recon.colour import guided_filter, join_colours, predicted_blue
from device.values import Colour, Image
from tests.moving_retina import OTHER_RETINA, RETINA, field, seen

RED = np.asarray(0.6 + 0.4 * RETINA, np.float32)  # less contrast than green, as in a fundus
LIT = field()
INSIDE = ndimage.binary_erosion(LIT > 0.5, iterations=24)  # away from the edge, which moves with each channel


def correlation(left: Image, right: Image) -> float:
    return float(np.corrcoef(left[INSIDE], right[INSIDE])[0, 1])


def test_channels_are_moved_to_the_grid_of_green_and_their_shifts_reported() -> None:
    pictures: dict[Colour, Image] = {
        "red": seen(RED, (3.4, -5.2)),
        "green": seen(RETINA, (0, 0)),
        "blue": seen(RETINA, (-60, 2)),
    }
    joined = join_colours(pictures, LIT, 2)
    shifts = {channel.name: channel.shift_px for channel in joined.channels}
    assert shifts["green"] == (0, 0)
    assert shifts["red"] == pytest.approx((3.4, -5.2), abs=0.3)  # a sixth of a sample
    assert shifts["blue"] == pytest.approx((-60, 2), abs=0.6)  # two fifths of the field are in both frames
    assert (joined.doubtful, [channel.predicted for channel in joined.channels]) == ((), [False] * 3)
    assert correlation(joined.picture[..., 0], pictures["green"]) > 0.98
    assert joined.picture.shape == (*LIT.shape, 3)


def test_a_channel_that_shows_no_retina_is_not_moved_and_named() -> None:
    blank = np.asarray(LIT * np.random.default_rng(3).normal(1, 0.1, LIT.shape), np.float32)
    joined = join_colours({"green": seen(RETINA, (0, 0)), "red": blank}, LIT, 2)
    assert joined.doubtful == ("red",)
    assert joined.channels[1].shift_px == (0, 0)
    assert join_colours({"green": seen(RETINA, (0, 0)), "red": seen(RED, (1, 1))}, LIT, 2).doubtful == ()


@pytest.mark.parametrize(
    ("given", "predicted"),
    [("green", {"red", "blue"}), ("red", {"green", "blue"}), ("blue", {"red", "green"}), ("amber", {"green", "blue"})],
)
def test_every_channel_that_was_not_taken_is_marked(given: Colour, predicted: set[str]) -> None:
    joined = join_colours({given: seen(RETINA, (0, 0))}, LIT, 2)
    assert {channel.name for channel in joined.channels if channel.predicted} == predicted
    assert joined.picture.shape == (*LIT.shape, 3)


def test_a_missing_blue_is_predicted_and_marked_and_amber_stands_for_red() -> None:
    green, amber = seen(RETINA, (0, 0)), seen(RED, (2, 2))
    joined = join_colours({"amber": amber, "green": green}, LIT, 2)
    assert [(channel.name, channel.predicted, channel.shift_px is None) for channel in joined.channels] == [
        ("amber", False, False),
        ("green", False, False),
        ("blue", True, True),
    ]
    assert correlation(joined.picture[..., 0], seen(RED, (0, 0))) > 0.98
    blue = joined.picture[..., 2]
    assert blue[LIT == 0].max() == 0
    assert 0.4 < blue[INSIDE].mean() / green[INSIDE].mean() < 0.75  # the photographs of the fit


def test_a_predicted_blue_does_not_depend_on_the_exposures() -> None:
    red, green = seen(RED, (0, 0)), seen(RETINA, (0, 0))
    assert predicted_blue(7 * red, 3 * green, LIT) == pytest.approx(3 * predicted_blue(red, green, LIT), rel=1e-4)


def test_the_guided_filter_removes_noise_and_keeps_what_green_shows() -> None:
    green, red = seen(RETINA, (0, 0)), seen(RED, (0, 0))
    noisy = np.asarray(red + LIT * np.random.default_rng(4).normal(0, 0.05, LIT.shape), np.float32)
    filtered = guided_filter(noisy, green, LIT)
    before, after = (np.sqrt(((picture - red)[INSIDE] ** 2).mean()) for picture in (noisy, filtered))
    assert after < before / 4  # 289 pixels to a window, of which a line and an offset are fitted
    alone = guided_filter(seen(OTHER_RETINA, (0, 0)), np.ones_like(green), LIT)
    assert np.isfinite(alone).all()


def test_half_of_a_channel_stays_its_own_so_that_a_spot_that_green_lacks_is_kept() -> None:
    spot = np.zeros_like(LIT)
    spot[LIT.shape[0] // 2 - 3 : LIT.shape[0] // 2 + 4, LIT.shape[1] // 2 - 3 : LIT.shape[1] // 2 + 4] = 0.3
    green, red = seen(RETINA, (0, 0)), seen(RED, (0, 0))
    contrast = [
        join_colours({"green": green, "red": channel}, LIT, 2).picture[..., 0][spot > 0].mean()
        for channel in (red, red + spot)
    ]
    assert contrast[1] - contrast[0] > 0.5 * 0.3  # GUIDED_SHARE keeps half, the filter a part of the rest
