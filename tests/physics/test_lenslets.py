"""Lenslets at the iris against a direct Fresnel sum of the whole iris, and closed forms; OPTICS.md 2.8, 2.9."""

from math import hypot

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from device.config.element import ElementSpec, Lenses
from device.config.head_file import OpticsSpec
from device.config.scene import ElementFlaws
from device.optics.diffuser import Beam, Refraction
from device.optics.lens_layout import centroidal, hexagonal
from device.optics.lenslets import reach_um, spots
from tests.lens_packing import random_packing, square_array

Z_UM, ANGULAR = 6000.0, 0.75
THREE: Lenses = ((-250.0, -180.0, 6000.0), (310.0, -120.0, 6000.0), (20.0, 330.0, 6300.0))
ONE: Lenses = ((0.0, 0.0, 6000.0),)
CENTROIDAL = centroidal(22, 3200.0, 6000.0, 0)
Plane = NDArray[np.floating]


def optics(lenses: Lenses, iris_um: float, **element: object) -> OpticsSpec:
    return OpticsSpec(iris_um=iris_um, element=ElementSpec(kind="lenslets", lenses=lenses, **element))


def fresnel_sum(
    lenses: Lenses,
    iris_um: float,
    pitch_um: float,
    size: int,
    eye: Refraction,
    aperture_um: float = np.inf,
    wavelength_um: float = 0.55,
) -> Plane:
    """Return the coherent light of the whole iris by the Fresnel integral as a sum over its places; no code shared.

    Round lenses have clear gaps.
    """
    places = (np.arange(round(iris_um / 1.25)) + 0.5) * 1.25 - iris_um / 2
    right, down = np.meshgrid(places, places)
    squares = np.array([(right - x) ** 2 + (down - y) ** 2 for x, y, _ in lenses])
    focal = np.array([f for *_, f in lenses])[squares.argmin(axis=0)]
    path = np.where(squares.min(axis=0) < aperture_um**2 / 4, -squares.min(axis=0) / (2 * focal), 0)
    wavefront = eye.m_dpt * (right**2 + down**2) + eye.j0_dpt * (right**2 - down**2) + 2 * eye.j45_dpt * right * down
    path -= ANGULAR**2 * 1e-6 * wavefront / 2
    light = ((np.hypot(right, down) <= iris_um / 2) * np.exp(2j * np.pi * path / wavelength_um)).astype(np.complex64)
    parts = 5
    at = (np.arange(size * parts) - (size // 2) * parts - (parts - 1) / 2) * pitch_um / parts
    kernel = np.exp(1j * np.pi * (at[:, None] - places[None, :]) ** 2 / (wavelength_um * Z_UM)).astype(np.complex64)
    intensity = np.abs(kernel @ light @ kernel.T).astype(np.float64) ** 2
    pixels = intensity.reshape(size, parts, size, parts).sum(axis=(1, 3))
    return np.asarray(pixels / pixels.sum())


@pytest.mark.parametrize("eye", [Refraction(), Refraction(6, 0.8, -0.5), Refraction(-10)], ids=str)
def test_psf_is_the_fresnel_integral_of_the_whole_iris(eye: Refraction) -> None:
    """The interference between lenses, which the bandwidth washes out, is the difference."""
    psf = spots(optics(THREE, 1200.0), 3.45, 1, eye, lines=1)
    expected = fresnel_sum(THREE, 1200.0, 3.45, len(psf), eye)
    assert np.corrcoef(psf.ravel(), expected.ravel())[0, 1] > 0.99995
    assert np.linalg.norm(psf - expected) < 0.01 * np.linalg.norm(expected)


def test_clear_gaps_spread_their_light_as_the_whole_iris_does_in_the_light_of_an_led() -> None:
    """The light of a gap and that of its lens interfere in one wavelength, and hardly in the bandwidth."""
    psf = spots(optics(THREE, 1200.0, aperture_um=400.0, gaps="clear"), 3.45, 1, lines=1)
    in_led = [fresnel_sum(THREE, 1200.0, 3.45, len(psf), Refraction(), 400.0, um) for um in (0.53, 0.543, 0.557, 0.57)]
    expected = np.mean(in_led, axis=0)
    assert np.corrcoef(psf.ravel(), expected.ravel())[0, 1] > 0.9995
    rows, cols = (np.indices(psf.shape) - len(psf) // 2) * 3.45
    beside = np.min([np.hypot(cols - right, rows - down) for right, down, _ in THREE], axis=0) > 40
    gaps, sums = (ndimage.gaussian_filter(np.where(beside, plane, 0), 5)[beside] for plane in (psf, expected))
    assert gaps.sum() == pytest.approx(sums.sum(), rel=0.03)
    assert np.corrcoef(gaps, sums)[0, 1] > 0.97


@pytest.mark.parametrize("pitch_um", [3.45, 6.9, 10.08])
@pytest.mark.parametrize("lenses", [ONE, THREE], ids=["one lens", "three lenses"])
def test_any_pitch_of_the_sensor_shows_the_same_light(lenses: Lenses, pitch_um: float) -> None:
    """A lens of 1.2 mm in focus has lambda z / d = 2.75 um: its Airy disc lies in the pixels around the axis."""
    psf = spots(optics(lenses, 1200.0), pitch_um, 1, lines=1)
    assert psf.sum(dtype=np.float64) == pytest.approx(1, abs=1e-4)
    rows, cols = np.indices(psf.shape) - len(psf) // 2
    middle_um = [pitch_um * float((axis * psf).sum(dtype=np.float64)) for axis in (cols, rows)]
    areas = spots_areas(lenses)
    assert middle_um == pytest.approx(np.array(lenses)[:, :2].T @ areas, abs=4.0)
    if lenses == ONE:
        assert psf[np.hypot(rows, cols) * pitch_um < 20].sum() > 0.9


def spots_areas(lenses: Lenses) -> Plane:
    """Return the share of each lens in an iris of 1.2 mm."""
    places = np.linspace(-600, 600, 481)
    right, down = np.meshgrid(places, places)
    owners = np.array([(right - x) ** 2 + (down - y) ** 2 for x, y, _ in lenses]).argmin(axis=0)
    return (
        np.bincount(owners[np.hypot(right, down) <= 600], minlength=len(lenses)) / (np.hypot(right, down) <= 600).sum()
    )


def centroid_and_width_um(psf: Plane, pitch_um: float, near_um: tuple[float, float], radius_um: float) -> Plane:
    """Return the centroid (right, down) of the light around a place and its standard deviation along both axes."""
    rows, cols = (np.indices(psf.shape) - len(psf) // 2) * pitch_um
    light = np.where(np.hypot(cols - near_um[0], rows - near_um[1]) < radius_um, psf, 0).astype(np.float64)
    right, down = ((axis * light).sum() / light.sum() for axis in (cols, rows))
    widths = [np.sqrt(((axis - at) ** 2 * light).sum() / light.sum()) for axis, at in ((cols, right), (rows, down))]
    return np.array([right, down, *widths])


@pytest.mark.parametrize("eye", [Refraction(4), Refraction(-7, 1.0, 0.8)], ids=str)
def test_spots_move_by_the_slope_of_the_eye_times_the_distance(eye: Refraction) -> None:
    """A round lens has its centroid at its vertex, so its spot lies at c + z grad W(c), in focus or not."""
    lenses: Lenses = ((-700.0, 0.0, 6000.0), (700.0, 0.0, 6000.0), (0.0, 900.0, 6000.0))
    psf = spots(optics(lenses, 3200.0, aperture_um=500.0), 3.45, 1, eye, lines=1)
    slope = ANGULAR**2 * 1e-6 * np.array([[eye.m_dpt + eye.j0_dpt, eye.j45_dpt], [eye.j45_dpt, eye.m_dpt - eye.j0_dpt]])
    for right, down, _ in lenses:
        expected = np.array([right, down]) - Z_UM * slope @ (right, down)
        found = centroid_and_width_um(psf, 3.45, tuple(expected), 60.0)
        assert found[:2] == pytest.approx(expected, abs=0.3)
    assert Z_UM * np.linalg.norm(slope, 2) * 700 > 9, "the shift is far beyond the tolerance"


def test_a_spot_out_of_focus_is_as_wide_as_geometry_says() -> None:
    """A round lens of diameter w with the residual curvature K spreads its light over w z K, uniformly."""
    eye = Refraction(-15)
    psf = spots(optics(ONE, 3200.0, aperture_um=800.0), 3.45, 1, eye, lines=1)
    wide_um = 800 * Z_UM * ANGULAR**2 * 15e-6
    *_, across, down = centroid_and_width_um(psf, 3.45, (0.0, 0.0), wide_um)
    pixel_um = 3.45 / 12**0.5
    assert (across, down) == pytest.approx((hypot(wide_um / 4, pixel_um),) * 2, rel=0.05)


def test_a_beam_and_black_gaps_take_their_share_and_clear_gaps_none() -> None:
    places = CENTROIDAL
    whole = optics(places, 3200.0)
    half = spots(whole, 6.9, 1, beam=Beam(1600.0, 0.0, 1600.0), lines=1)
    overlap = 2 * np.arccos(0.5) / np.pi - 0.5 * np.sqrt(4 - 1) / np.pi
    assert half.sum(dtype=np.float64) == pytest.approx(overlap, abs=3e-3)
    black, clear = (
        spots(optics(places, 3200.0, aperture_um=500.0, gaps=gaps), 6.9, 1, lines=1) for gaps in ("black", "clear")
    )
    assert clear.sum(dtype=np.float64) == pytest.approx(1, abs=2e-3)
    assert black.sum(dtype=np.float64) == pytest.approx(22 * (500 / 3200) ** 2, rel=0.03)
    assert (clear - black).max() < 0.05 * black.max(), "the light of the gaps is spread"


def test_grains_of_dust_stop_the_light_of_their_area_and_diffract_as_much() -> None:
    """Babinet's principle: small grains spread as much light as they stop, most of it beside the spot."""
    one = optics(ONE, 1200.0)
    clean, dusty = (spots(one, 3.45, 1, lines=1, flaws=ElementFlaws(dust_grains=n, dust_um=40.0)) for n in (0, 20))
    stopped = 1 - dusty.sum(dtype=np.float64)
    assert stopped == pytest.approx(20 * (40 / 1200) ** 2, rel=0.1)
    rows, cols = np.indices(clean.shape) - len(clean) // 2
    beside = np.hypot(rows, cols) * 3.45 > 20
    assert 0.5 * stopped < (dusty - clean)[beside].sum() < stopped


def test_curved_lenses_focus_the_edge_of_the_field_before_the_sensor() -> None:
    """OPTICS.md 2.9: the lens is as much stronger as an eye of that sphere and cylinder; its spot does not move."""
    slope, index = (0.15, 0.2), 1.5
    sagittal, tangential = ((0.15**2 + 0.2**2) / 2 * (s + 1 / index) / Z_UM / (ANGULAR**2 * 1e-6) for s in (1.0, 3.0))
    turn = 2 * np.arctan2(slope[1], slope[0])
    mean, half = (sagittal + tangential) / 2, (tangential - sagittal) / 2
    curved = spots(optics(ONE, 800.0, index=index), 3.45, 1, lines=1, slope=slope)
    eye = spots(optics(ONE, 800.0), 3.45, 1, Refraction(mean, half * np.cos(turn), half * np.sin(turn)), lines=1)
    assert np.abs(curved - eye).max() < 1e-3 * eye.max()
    assert tangential > 20 > sagittal > 10, "the field's edge of this head"


@pytest.mark.parametrize("abbe", [28.0, 57.0])
def test_another_colour_has_the_focal_length_of_the_plates_dispersion(abbe: float) -> None:
    """OPTICS.md 2.8; the Abbe number is (n_d - 1) / (n_F - n_C), so n - 1 is given by it at those lines."""
    power = np.interp([0.4861**-2, 0.6563**-2], [0.6563**-2, 0.4861**-2], [0, 1 / abbe])
    blue, red = (
        optics(ONE, 800.0, abbe=abbe, focal_at_um=0.5876).model_copy(update={"wavelength_um": um})
        for um in (0.4861, 0.6563)
    )
    middle = (0.5876**-2 - 0.6563**-2) / (0.4861**-2 - 0.6563**-2) / abbe
    for head, part in zip((blue, red), power, strict=True):
        focal_um = 6000 / (1 + part - middle)
        same = optics(((0.0, 0.0, focal_um),), 800.0, focal_at_um=head.wavelength_um)
        same = same.model_copy(update={"wavelength_um": head.wavelength_um})
        assert np.abs(spots(head, 3.45, 1, lines=1) - spots(same, 3.45, 1, lines=1)).max() < 1e-4


def test_flaws_spread_the_light_and_shifts_move_it() -> None:
    head = optics(CENTROIDAL, 3200.0)
    perfect = spots(head, 6.9, 1, lines=1)
    assert np.array_equal(perfect, spots(head, 6.9, 2, lines=1)), "without flaws no number is drawn"
    for flaws in ({"focal_spread": 0.1}, {"surface_waves": 0.2}, {"moved_um": 8.0}, {"centre_um": 8.0}):
        spread = spots(head, 6.9, 1, lines=1, flaws=ElementFlaws(**flaws))
        assert spread.sum(dtype=np.float64) == pytest.approx(1, abs=1e-4)
        assert 0.05 < np.linalg.norm(spread - perfect) / np.linalg.norm(perfect) < 1.4
        if "moved_um" not in flaws and "centre_um" not in flaws:
            assert (spread**2).sum() < 0.95 * (perfect**2).sum()
    strehl = spots(optics(ONE, 800.0), 1.0, 1, lines=1, flaws=ElementFlaws(surface_waves=0.07)).max()
    strehl /= spots(optics(ONE, 800.0), 1.0, 1, lines=1).max()
    assert strehl == pytest.approx(np.exp(-((2 * np.pi * 0.07) ** 2)), abs=0.03), "Marechal"


def test_layouts_are_centroidal_hexagonal_and_reach_the_whole_iris() -> None:
    lenses = CENTROIDAL
    assert lenses != centroidal(22, 3200.0, 6000.0, 1)
    places = np.random.default_rng(1).uniform(-1600, 1600, (40000, 2))
    places = places[np.hypot(*places.T) < 1600]
    owners = np.hypot(*(places[:, None] - np.array(lenses)[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    for number, lens in enumerate(lenses):
        assert np.mean(places[owners == number], axis=0) == pytest.approx(lens[:2], abs=25)
    assert np.bincount(owners).max() < 1.6 * np.bincount(owners).min(), "nearly equal areas"
    array = np.array(hexagonal(1000.0, 3200.0, 6000.0))
    apart = np.hypot(*(array[:, None, :2] - array[None, :, :2]).transpose(2, 0, 1))
    assert apart[apart > 0].min() == pytest.approx(1000)
    assert len(array) == 19
    assert reach_um(optics(lenses, 3200.0)) < 2000


def test_packings_to_compare_with_are_filled_and_square() -> None:
    wide_um = 4000.0
    places = random_packing(400.0, wide_um, 1)
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(places))
    assert apart.min() >= 0.83 * 400
    assert int((np.abs(places) < wide_um / 2).all(axis=1).sum()) == pytest.approx((wide_um / 400) ** 2, rel=0.1)
    assert len(square_array(400.0, 3200.0)) == 11**2
