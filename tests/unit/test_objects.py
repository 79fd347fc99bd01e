"""Objects of a scene: drawings at the right place, of the right size, anti-aliased by covered area."""

from math import atan, degrees, pi

import numpy as np
import pytest
from PIL import Image as Pictures
from scipy import ndimage
from scipy.spatial.transform import Rotation

from device.config.head_file import OpticsSpec
from device.config.scene import EyeSpec, ObjectSpec, SimSpec
from device.errors import SpecError
from device.sim.fundus import fundus
from device.sim.objects import draw_object

PX_PER_DEG = 8.0
F_UM = 25000.0


def optics(field_deg):
    return OpticsSpec(iris_um=3200, diffuser_to_sensor_um=6000, angular_magnification=0.75, field_deg=field_deg)


def seen(field_deg=33.4, shape=(300, 301), gaze_deg=(0.0, 0.0), **what):
    scene = SimSpec(object=ObjectSpec(**what), eye=EyeSpec(gaze_deg=gaze_deg))
    return draw_object(scene, optics(field_deg), "OD", shape, PX_PER_DEG)


def centre(plane):
    """Return the centroid of a plane's light, degrees right and down of the middle."""
    row, col = ndimage.center_of_mass(plane)
    return (col - (plane.shape[1] - 1) / 2) / PX_PER_DEG, (row - (plane.shape[0] - 1) / 2) / PX_PER_DEG


def test_a_dot_on_the_axis_has_its_area_and_its_place() -> None:
    """275 um behind 25 mm are 0.630 degrees (OPTICS.md 1.1); the disc's light is its area to a few parts in 1000."""
    plane = seen(kind="point").reflectance["green"]
    radius_px = degrees(atan(137.5 / F_UM)) * PX_PER_DEG
    assert plane.sum() == pytest.approx(pi * radius_px**2, rel=0.003)
    assert centre(plane) == pytest.approx((0, 0), abs=1e-4)
    assert plane.max() == 1
    assert plane.dtype == np.float32


@pytest.mark.parametrize("at_deg", [(5.03, -2.41), (-9.3, 8.8)])
def test_place_and_gaze_move_an_object_by_parts_of_a_pixel(at_deg) -> None:
    plane = seen(kind="point", at_deg=at_deg).reflectance["green"]
    assert centre(plane) == pytest.approx(at_deg, abs=0.01)
    half = (at_deg[0] / 2, at_deg[1] / 2)
    assert seen(kind="point", at_deg=half, gaze_deg=half).reflectance["green"] == pytest.approx(plane, abs=1e-5)


def test_dots_are_at_their_field_angles() -> None:
    """+-12 mm are +-25.64 degrees: the angular distance of the dots shrinks towards the edge, as atan(h / f)."""
    plane = seen(field_deg=60, shape=(500, 500), kind="dots").reflectance["green"]
    labels, count = ndimage.label(plane > 0.5)
    assert count == 13 * 7
    places = np.array(ndimage.center_of_mass(plane, labels, range(1, count + 1)))
    across = np.sort((places[:, 1] - 249.5) / PX_PER_DEG)
    row = places[np.abs(places[:, 0] - 249.5) < 1]
    angles = np.sort((row[:, 1] - 249.5) / PX_PER_DEG)
    assert angles == pytest.approx([degrees(atan(k * 2000 / F_UM)) for k in range(-6, 7)], abs=0.01)
    assert across[-1] <= angles[-1] + 0.01  # off the middle row 12 mm are farther away, and so a smaller angle


def test_a_ruler_of_15_mm_spans_33_4_degrees_and_has_a_tick_each_millimetre() -> None:
    plane = seen(field_deg=40, shape=(340, 340), kind="ruler").reflectance["green"]
    line = plane[169:171].mean(axis=0)
    inside = np.flatnonzero(line > 0.5)
    assert (inside[-1] - inside[0] + 1) / PX_PER_DEG == pytest.approx(33.398, abs=0.15)
    ticks = ndimage.label(plane[169 - round(1.1 / 25 * 180 / pi * PX_PER_DEG)] > 0.25)[1]
    assert ticks == 15  # 1 mm apart within 15 mm, one in the middle


def test_negative_ruler_is_the_complement_of_the_positive_one() -> None:
    positive, negative = (seen(kind="ruler", polarity=p) for p in ("positive", "negative"))
    total = positive.reflectance["green"] + negative.reflectance["green"]
    assert total[positive.field].min() > 0.49  # the soft rim
    assert np.median(total[positive.field]) == 1
    assert total[~ndimage.binary_dilation(positive.field)].max() == 0


@pytest.mark.parametrize(
    ("what", "key"),
    [
        ({"kind": "dots"}, "half_size_um"),
        ({"kind": "ruler", "length_um": 15500.0}, "length_um"),
        ({"kind": "ruler", "at_deg": (2.0, 0.0)}, "length_um"),
        ({"kind": "point", "at_deg": (16.6, 0.0)}, "dot_um"),
    ],
)
def test_object_beyond_the_field_is_refused_with_key_value_and_range(what, key) -> None:
    with pytest.raises(SpecError, match=rf"sim\.object\.{key} = .* ends at 16\.7") as refused:
        seen(**what)
    assert "within 0 to 7500 um" in refused.value.remedy


def test_unshifted_retina_equals_the_fundus() -> None:
    plain = fundus((300, 301), PX_PER_DEG, 33.4, 1, haemorrhages=2)
    found = seen(haemorrhages=2)
    assert (found.reflectance["green"] == plain.reflectance["green"]).all()
    assert (found.vessels == plain.vessels).all()
    assert (found.disc, found.fovea) == (plain.disc, plain.fovea)


def test_shifted_retina_keeps_the_field() -> None:
    """One print at two places: the common part is the same, 4 degrees apart."""
    centred, shifted = (seen(size_deg=50, at_deg=at) for at in ((0.0, 0.0), (4.0, -2.0)))
    assert (centred.field == shifted.field).all()
    right, down = 32, -16
    moved = np.roll(centred.reflectance["green"], (down, right), axis=(0, 1))
    both = ndimage.binary_erosion(centred.field & np.roll(centred.field, (down, right), axis=(0, 1)), iterations=3)
    assert moved[both] == pytest.approx(shifted.reflectance["green"][both], abs=1e-4)
    assert shifted.disc == pytest.approx((centred.disc[0] + down, centred.disc[1] + right))
    assert shifted.reflectance["green"][~ndimage.binary_dilation(shifted.field)].max() == 0


def test_shifted_photograph_is_dark_outside_its_edge(tmp_path) -> None:
    Pictures.new("RGB", (64, 64), (255, 128, 0)).save(tmp_path / "even.png")
    found = seen(kind="image", image=tmp_path / "even.png", at_deg=(8.0, 0.0))
    red = found.reflectance["red"][150]
    assert red[150 + round(8 * PX_PER_DEG)] == pytest.approx(1, abs=0.01)
    assert red[150 - round(12 * PX_PER_DEG)] == 0


@pytest.mark.parametrize("eye", ["OD", "OS"])
def test_a_turned_eye_shows_the_same_retina_as_a_sphere_and_what_is_beyond_its_field(eye) -> None:
    sim, lens = SimSpec(object=ObjectSpec(kind="retina", haemorrhages=2)), optics(33.4)
    down_deg, right_deg = 0.6, -8.0
    straight = draw_object(sim, lens, eye, (300, 301), PX_PER_DEG)
    turned = draw_object(sim, lens, eye, (300, 301), PX_PER_DEG, (right_deg, down_deg))
    back = Rotation.from_rotvec([right_deg, -down_deg, 0.0], degrees=True)  # (down, right, axis), the turn inverted
    middle = (np.array(straight.field.shape) - 1) / 2
    angles = np.radians((np.indices(straight.field.shape).reshape(2, -1).T - middle) / PX_PER_DEG)
    away = np.linalg.norm(angles, axis=1, keepdims=True)
    seen_from = back.apply(np.hstack([np.sin(away) * angles / away.clip(1e-9), np.cos(away)]))
    azimuth = np.arctan2(seen_from[:, 1], seen_from[:, 0])
    radius_px = np.degrees(np.arccos(seen_from[:, 2])) * PX_PER_DEG
    at = middle[:, None] + radius_px * np.stack([np.cos(azimuth), np.sin(azimuth)])
    moved = ndimage.map_coordinates(straight.reflectance["green"], at, order=3).reshape(straight.field.shape)
    whole = ndimage.map_coordinates(straight.field.astype(float), at, order=1).reshape(straight.field.shape) > 0.99
    both = ndimage.binary_erosion(whole & turned.field, iterations=6)
    assert both.sum() > 0.6 * straight.field.sum()
    # the ends of vessels at the edge of the field of the straight view are continued, which changes their taper
    assert np.quantile(np.abs(moved - turned.reflectance["green"])[both] / moved[both], 0.99) < 0.01
    assert (turned.reflectance["green"] > 0).sum() == (straight.reflectance["green"] > 0).sum()
    assert straight.disc is not None
    assert turned.disc is not None
    near = np.hypot(at[0] - straight.disc[0], at[1] - straight.disc[1]).argmin()
    found = np.unravel_index(near, straight.field.shape)  # the pixel that shows the disc's middle
    assert turned.disc == pytest.approx(found, abs=0.8)  # half the diagonal of a pixel


def test_cut_retina_is_dark_above_and_below_and_unchanged_inside() -> None:
    whole, cut = seen(), seen(cut_deg=(40.0, 20.0))
    rows = whole.field.shape[0]
    deep = np.abs(np.arange(rows) - (rows - 1) / 2) < 10 * PX_PER_DEG - 1
    beyond = np.abs(np.arange(rows) - (rows - 1) / 2) > 10 * PX_PER_DEG + 1
    for colour, plane in whole.reflectance.items():
        assert (cut.reflectance[colour][deep] == plane[deep]).all()
        assert cut.reflectance[colour][beyond].max() == 0
    assert cut.field.sum() < whole.field.sum()
    assert not cut.vessels[~cut.field].any()
    assert (cut.disc, cut.fovea) == (whole.disc, whole.fovea)


@pytest.mark.parametrize("size", [(3, 200), (200, 3), (64, 64), (1, 1)])
@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I;16", "I", "F"])
def test_photograph_of_any_shape_and_depth_keeps_its_brightness(tmp_path, size, mode) -> None:
    """Half of white in every mode but "1": within the rounding of 8 bits and of a CMYK conversion."""
    path = tmp_path / "even.tif"
    if mode in ("I;16", "I", "F"):
        half = {"I;16": np.uint16(32768), "I": np.int32(32768), "F": np.float32(0.5)}[mode]
        values = np.full(size[::-1], half)
        values.flat[0] = 1.0 if mode == "F" else half
        Pictures.fromarray(values).save(path)
        level = 1.0 if mode == "F" and size == (1, 1) else 0.5
    else:
        Pictures.new("RGB", size, (128, 128, 128)).convert(mode).save(path)
        level = None if mode == "1" else 0.5
    for cut_deg in (None, (30.0, 20.0)):
        found = seen(kind="image", image=path, cut_deg=cut_deg)
        middle = [float(plane[150, 150]) for plane in found.reflectance.values()]
        assert np.isfinite(middle).all()
        if level is not None and size != (1, 1) and 3 not in size:
            assert middle == pytest.approx([level] * 3, abs=0.02)


def test_photograph_with_a_cut_keeps_its_shape(tmp_path) -> None:
    """3:2, a square in its middle: it stays a square, and is as wide as the photograph's width says."""
    picture = np.zeros((200, 300), np.uint8)
    picture[75:125, 125:175] = 255
    Pictures.fromarray(picture).save(tmp_path / "square.png")
    green = seen(kind="image", image=tmp_path / "square.png", cut_deg=(30.0, 20.0)).reflectance["green"] > 0.5
    rows, cols = np.flatnonzero(green.any(axis=1)), np.flatnonzero(green.any(axis=0))
    assert len(rows) == len(cols) == pytest.approx(30 * PX_PER_DEG * 50 / 300, abs=2)
