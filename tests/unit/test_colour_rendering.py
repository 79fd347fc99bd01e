"""A picture in colour as it is displayed: contrast of lesions, hue and range."""

from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from PIL import Image as Pillow
from scipy import ndimage

from device.recon.colour import RGB, predicted_blue
from device.recon.white_balance import balanced
from device.sim.fundus import fundus
from device.values import Image, Mask
from services.imaging.colour_rendering import BRIGHTEST, LUMINANCE, render_colour
from services.imaging.picture_files import DISPLAY, from_srgb, to_png

SHAPE, PX_PER_DEG, FIELD_DEG = (220, 220), 6.4, 33.4
LESIONS = {"haemorrhages": 6, "exudates": 8}
ROUNDING = 0.01  # of a contrast: 8 bits at the luminance of the darker picture, about 0.15
TOP = 243  # 8-bit sRGB of BRIGHTEST


def pixels_of(png: bytes) -> NDArray[np.uint8]:
    with Pillow.open(BytesIO(png)) as image:
        return np.asarray(image)


def drawn(seed: int, **lesions: int) -> Image:
    """Return red and green of a drawn retina with noise of one per cent, (rows, cols, 2)."""
    planes = fundus(SHAPE, PX_PER_DEG, FIELD_DEG, seed, **lesions).reflectance  # type: ignore[arg-type]
    return np.stack([planes["red"], planes["green"]], axis=2)


def contrast(light: Image, lesion: Mask, field: Mask) -> float:
    """Return the mean light of a lesion over that of its surroundings, minus one."""
    near = ndimage.binary_dilation(lesion, iterations=7) & ~ndimage.binary_dilation(lesion, iterations=2)
    return float(light[lesion & field].mean() / light[near & field].mean()) - 1


@pytest.mark.parametrize("seed", range(1, 7))
def test_lesions_have_the_contrast_of_the_picture_in_green(seed: int) -> None:
    """In luminance as displayed, without a white card: one window and the hue of photographs gave a third of it."""
    plain, ill = drawn(seed), drawn(seed, **LESIONS)
    noise = 1 + 0.01 * np.random.default_rng(seed).standard_normal(ill.shape)
    red, green = np.moveaxis((ill * noise).astype(np.float32), 2, 0)
    field = fundus(SHAPE, PX_PER_DEG, FIELD_DEG, seed).field
    lit = field.astype(np.float32)
    picture = balanced(np.stack([red, green, predicted_blue(red, green, lit)], axis=2), lit, {})
    shown = from_srgb(pixels_of(to_png(render_colour(picture), False, window=DISPLAY))) @ LUMINANCE
    in_green = from_srgb(pixels_of(to_png(green, False)))
    change = np.divide(ill[..., 1], plain[..., 1], out=np.ones(SHAPE, np.float32), where=plain[..., 1] > 0)
    inside = ndimage.binary_erosion(field, iterations=8)
    for lesion in (change < 0.8, change > 1.25):
        of_green, of_colour = (contrast(light, lesion, inside) for light in (in_green, shown))
        assert abs(of_green) > 0.15
        assert of_colour == pytest.approx(of_green, abs=ROUNDING)


@given(
    picture=npst.arrays(np.float32, (6, 7, 3), elements=st.floats(-1, 100, width=32)),
    red_over_green=st.floats(0.1, 20),
)
def test_no_channel_is_cut_and_luminance_is_that_of_green(picture: Image, red_over_green: float) -> None:
    picture = picture * np.array([red_over_green, 1, 0.5], np.float32)
    light = render_colour(picture)
    assert light.shape == picture.shape
    assert 0 <= light.min() <= light.max() <= BRIGHTEST * (1 + 1e-5)
    assert pixels_of(to_png(light, False, window=DISPLAY)).max() <= TOP
    in_green = from_srgb(pixels_of(to_png(picture[..., 1], False)))
    luminance = light @ LUMINANCE
    if luminance.max() > 0:
        share = float(luminance.max() / in_green.max())
        assert luminance == pytest.approx(share * in_green, abs=0.01)


def test_the_hue_of_a_card_is_kept_and_grey_stays_grey() -> None:
    ramp = np.linspace(1, 2, 400, dtype=np.float32).reshape(20, 20)
    for hue in ((5.0, 1.0, 0.4), (1.0, 1.0, 1.0), (0.3, 1.0, 2.0)):
        light = render_colour(ramp[..., None] * np.array(hue, np.float32))
        seen = light[15, 5] / light[15, 5, 1]  # in the middle of the range: the brightest pixels lose saturation
        assert dict(zip(RGB, seen, strict=True)) == pytest.approx(dict(zip(RGB, hue, strict=True)), rel=1e-4)
    assert not render_colour(np.zeros((4, 4, 3), np.float32)).any()
