"""Pigments of a drawn retina: reflectances and contrasts by the Beer-Lambert law, and the mean eye unchanged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.sim.fundus import BLOOD, CHOROID, COLOURS, LEVEL, MACULA, fundus
from device.sim.pigments import AT_FOVEA, Pigments
from device.values import Colour

colours = st.sampled_from(COLOURS)


@pytest.mark.parametrize("colour", COLOURS)
def test_the_mean_eye_is_that_of_the_table_to_the_last_bit(colour: Colour) -> None:
    mean = Pigments()
    assert mean.reflectance(colour, LEVEL[colour]) == LEVEL[colour]
    assert mean.macula(colour, MACULA[colour]) == MACULA[colour]
    assert mean.blood(BLOOD[colour]) == BLOOD[colour]
    assert mean.choroid(colour, CHOROID[colour]) == CHOROID[colour]


def test_melanin_varies_the_reflectance_as_between_persons() -> None:
    """OPTICS.md 4.1: 25 % below 575 nm and 50 % above 600 nm."""
    for colour, factor in (("red", 1.5), ("green", 1.25), ("blue", 1.25)):
        assert Pigments(melanin=-1).reflectance(colour, 1.0) == pytest.approx(factor, rel=0.01)
        assert Pigments(melanin=1).reflectance(colour, 1.0) == pytest.approx(1 / factor, rel=0.01)


@given(colours, st.floats(0, 3), st.floats(0, 3))
def test_absorbances_add(colour: Colour, left: float, right: float) -> None:
    """A pigment in two layers transmits the product of what each of them transmits."""
    clear = 1 - Pigments(haemoglobin=0).blood(BLOOD[colour])
    first, second = (1 - Pigments(haemoglobin=part).blood(BLOOD[colour]) for part in (left, right))
    both = (1 - BLOOD[colour]) ** (left + right)
    assert clear == 1
    assert first * second == pytest.approx(both)


@given(st.floats(0, 3))
def test_macular_pigment_is_seen_in_blue_and_not_in_red(quantity: float) -> None:
    eye = Pigments(macular=quantity)
    assert eye.macula("red", MACULA["red"]) == pytest.approx(MACULA["red"])
    assert (eye.macula("blue", MACULA["blue"]) - MACULA["blue"]) * (quantity - 1) >= 0


@given(colours, st.floats(0, 3))
def test_macular_pigment_absorbs_at_the_fovea_and_never_below_0(colour: Colour, quantity: float) -> None:
    mean, eye = (1 - AT_FOVEA * Pigments(macular=amount).macula(colour, MACULA[colour]) for amount in (1.0, quantity))
    assert eye > 0
    assert eye / mean == pytest.approx(
        10 ** (-2 * 0.35 * {"red": 0, "green": 0.15, "blue": 0.95}[colour] * (quantity - 1))
    )


def test_a_dark_fundus_with_little_haemoglobin_is_drawn_so() -> None:
    usual = fundus((120, 120), 4.0, 28.0, 3)
    dark = fundus((120, 120), 4.0, 28.0, 3, pigments=Pigments(melanin=2))
    pale = fundus((120, 120), 4.0, 28.0, 3, pigments=Pigments(haemoglobin=0.4))
    inside = usual.field
    assert usual.vessels is not None
    for colour, factor in (("red", np.exp(-2 * 0.41)), ("green", np.exp(-2 * 0.22))):
        ratio = dark.reflectance[colour][inside].mean() / usual.reflectance[colour][inside].mean()
        assert ratio == pytest.approx(factor, rel=0.02)  # the pattern of the choroid fades, too
    vessels = usual.vessels & inside  # most of them are thin
    assert pale.reflectance["green"][vessels].mean() > 1.04 * usual.reflectance["green"][vessels].mean()
    tissue = inside & (pale.reflectance["green"] == usual.reflectance["green"])
    assert tissue.mean() > 0.3, "what holds no vessel is unchanged"
