"""Parametric PSF of lenslets against the simulator's wave optics, and what calibration finds wrong with them."""

from dataclasses import replace
from functools import cache, partial
from math import radians, tan

import numpy as np
import pytest

from device.calibration.procedure.lens_check import lens_figures, lens_messages, lenses_without_spot, shift_um
from device.config.element import ElementSpec
from device.config.head_file import OpticsSpec, load_head
from device.config.scene import ElementFlaws
from device.optics import lenslets
from device.optics.diffuser import Refraction
from device.recon.estimation.psf_warp import transform, warped
from device.recon.estimation.refraction.spot_stretch import SpotStretch
from device.recon.model.spots import GAP_LIGHT, Spots, find_spots, without_noise
from device.recon.stage import default_schedule
from device.sim.plan import decide
from device.sim.render import convolved_with_disc
from device.values import Calibration, Geometry, Image, Psf, Sensor
from services import resources
from tests.lens_packing import random_packing
from tests.paper.bench import Bench
from tests.scenes import speckle

HEAD = load_head(resources.HEADS / "imx296_lenslets.toml")
PITCH_UM = 6.9
NO_EYE, NO_FLAWS = Refraction(), ElementFlaws()


def optics(**element: object) -> OpticsSpec:
    assert HEAD.optics is not None
    changed = HEAD.optics.element.model_dump() | element
    return HEAD.optics.model_copy(update={"element": ElementSpec(**changed)})


def geometry() -> Geometry:
    return optics().geometry(PITCH_UM)


@cache
def seen(eye: Refraction = NO_EYE, flaws: ElementFlaws = NO_FLAWS, noise: float = 0.0, seed: int = 1) -> Psf:
    pixels = lenslets.spots(optics(), PITCH_UM, seed, eye, flaws=flaws)
    drawn = np.random.default_rng(seed).standard_normal(pixels.shape).astype(np.float32)
    return Psf(pixels + np.float32(noise * pixels.max()) * drawn)


def found(psf: Psf) -> Spots:
    spots = find_spots(psf, geometry())
    assert spots is not None
    return spots


def correlation(image: Psf, truth: Psf) -> float:
    return float(np.corrcoef(image.pixels.ravel(), truth.pixels.ravel())[0, 1])


def test_every_spot_is_found_with_place_light_and_focus() -> None:
    """The focus of the lenses is that of the drawings, and a spot stands where the rays of its cell have their mean."""
    spots = found(seen(noise=1e-3))
    lenses = np.array(optics().element.lenses)
    own = np.hypot(*(spots.places_um[:, None] - lenses[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    assert sorted(own) == list(range(22))
    shift = geometry().scale_per_dpt * geometry().lens_focus_dpt * (spots.centroids_um - lenses[own, :2])
    assert np.abs(spots.places_um - lenses[own, :2] - shift).max() < 0.6
    assert geometry().lens_focus_dpt == pytest.approx(6, abs=0.1)
    assert spots.focus_dpt[:, 0].mean() == pytest.approx(6, abs=0.4)
    assert spots.beside == pytest.approx(0, abs=0.02)
    assert spots.misfit < 0.05


@pytest.mark.parametrize("eye", [(-10.0, 0.0, 0.0), (-4.0, 0.8, -0.5), (10.0, 0.0, 0.0)], ids=str)
def test_psf_of_an_eye_has_each_spot_moved_and_out_of_its_own_focus(eye: tuple[float, float, float]) -> None:
    truth = seen(Refraction(*eye))
    assert correlation(found(seen()).of_eye(eye), truth) > 0.985
    if eye[0] == -10:
        assert correlation(warped(seen(), transform(geometry(), *eye)), truth) < 0.8, "a stretched PSF stays in focus"


def test_psf_of_a_field_is_the_mean_of_its_places_behind_curved_lenses() -> None:
    edge = tan(radians(0.75 * 16.7))
    places = [(edge * ((ring + 0.5) / 4) ** 0.5, turn * np.pi / 4) for ring in range(4) for turn in range(4)]
    slopes = [(tangent * np.cos(angle), tangent * np.sin(angle)) for tangent, angle in places]
    eye = (-6.0, 0.0, 0.0)
    parts = [lenslets.spots(optics(), PITCH_UM, 1, Refraction(*eye), lines=1, slope=slope) for slope in slopes]
    truth = Psf(np.mean(parts, axis=0))
    spots = found(seen())
    assert correlation(spots.of_eye(eye, 33.4), truth) > max(0.97, correlation(spots.of_eye(eye), truth) + 0.02)


def test_excess_of_the_field_is_that_of_its_outermost_ring_and_zero_with_a_flat_field() -> None:
    """OPTICS.md 2.9: 12.2 and 26.8 dpt at the edge for f = 6 mm; the last of three rings has 5/6 of it."""
    excess_dpt = geometry().lens_excess_dpt(33.4)[-1]
    assert excess_dpt == pytest.approx([(12.2 + 26.8) / 2 * 6000 / 6124 * 5 / 6, 0, 0], abs=0.1)
    assert not optics(flat_field=True).geometry(PITCH_UM).lens_excess_dpt(33.4).any()


def test_cells_end_at_the_iris_also_where_lenses_stand_beyond_it() -> None:
    """The outer lenses of the hexagonal array stand at 1732 um, the iris ends at 1600: their cells lie at 1425 um."""
    spots = hexagonal()
    outer = np.hypot(*spots.places_um.T) > 1600
    assert outer.sum() == 6
    assert np.hypot(*spots.centroids_um[outer].T) == pytest.approx(1425, abs=20)


def test_stretch_of_centred_cells_is_that_of_the_eye() -> None:
    """Within .01 dpt, of which .007 is the field's mean behind cells that are centred to 2 um."""
    stretch = SpotStretch(found(seen()), 33.4)
    for eye in ((-8.0, 0.0, 0.0), (0.0, 0.0, 0.0), (6.0, 0.8, -0.5)):
        off_dpt = (stretch(*eye) - transform(geometry(), *eye)) / geometry().scale_per_dpt
        assert np.abs(off_dpt).max() < 0.01, eye
    assert stretch.sd_dpt == pytest.approx(0.015, abs=0.002)


def test_stretch_of_cut_cells_is_that_of_the_spots_of_wave_optics() -> None:
    """Places of the simulated spots, on the axis. The stretch counts spots out of focus less, which is .12 dpt."""
    m_dpt = -6.0
    spots, seen_spots = hexagonal(), hexagonal(Refraction(m_dpt))
    weights = spots.light[:, None] ** 2 * spots.places_um**2
    moved = (seen_spots.places_um - spots.places_um) / np.where(spots.places_um == 0, 1, spots.places_um)
    seen_dpt = -np.sum(weights * moved, axis=0) / weights.sum(axis=0) / geometry().scale_per_dpt
    stretched_dpt = (1 - np.diag(SpotStretch(spots, 0.0)(m_dpt))) / geometry().scale_per_dpt
    assert stretched_dpt == pytest.approx(seen_dpt, abs=0.12)
    assert abs(stretched_dpt.mean() - seen_dpt.mean()) < abs(m_dpt - seen_dpt.mean()) - 0.03, (
        "the eye's own stretch is another one"
    )


def hexagonal(eye: Refraction = NO_EYE) -> Spots:
    """Return the spots of the stock array of 1 mm on the axis, the same ones in the same order for every eye."""
    head = load_head(resources.HEADS / "imx296_hexagonal.toml").optics
    assert head is not None
    spots = find_spots(Psf(lenslets.spots(head, PITCH_UM, 1, eye)), head.geometry(PITCH_UM))
    assert spots is not None
    order = np.lexsort(np.rint(spots.places_um / 200).T)
    return replace(
        spots,
        places_um=spots.places_um[order],
        light=spots.light[order],
        focus_dpt=spots.focus_dpt[order],
        centroids_um=spots.centroids_um[order],
        cells_um=tuple(spots.cells_um[number] for number in order),
    )


def test_noise_between_the_spots_is_left_out_and_the_spots_stay() -> None:
    psf, clean = seen(noise=3e-3), seen()
    calibration = Calibration((psf,), Sensor(), geometry())
    assert correlation(psf, clean) < 0.98
    assert correlation(without_noise(calibration).psfs[0], clean) > 0.998


@pytest.mark.parametrize(("pitch_um", "n"), [(3.45, 2), (6.9, 1)])
def test_a_sample_behind_lenslets_is_as_wide_as_the_spots_permit(pitch_um: float, n: int) -> None:
    """At the light of an eye finer samples cost nine times the time and detail (NUMERICS.md 7.11)."""
    scale = optics().geometry(pitch_um)
    calibration = Calibration((Psf(lenslets.spots(optics(), pitch_um, 1)),), Sensor(), scale, field_deg=33.4)
    _, full = default_schedule(calibration, (1088, 1456))
    assert full.bin == n


def test_psf_of_a_diffuser_stays_as_it_is() -> None:
    calibration = Calibration((Psf(speckle((200, 200))),), Sensor(), replace(geometry(), lens_focus_dpt=None))
    assert without_noise(calibration) is calibration
    assert find_spots(calibration.psfs[0], calibration.geometry) is None


def test_calibration_finds_lenses_without_spot_gaps_and_centres_that_moved() -> None:
    lenses = optics().element.lenses
    good = found(seen(noise=1e-3))
    before = Calibration((seen(noise=1e-3, seed=2),), Sensor(), geometry())
    figures = lens_figures(good, lenses, before)
    assert lenses_without_spot(good, lenses) == []
    assert figures["lens_moved_um"] < 0.1
    assert list(lens_messages(figures)) == []
    covered = found(without_spot(seen(noise=1e-3), lenses[4]))
    assert lenses_without_spot(covered, lenses) == [5]
    open_um = 500.0
    gaps = Psf(lenslets.spots(optics(aperture_um=open_um, gaps="clear"), PITCH_UM, 1))
    moved = found(seen(flaws=ElementFlaws(moved_um=2.0), noise=1e-3))
    change_um = shift_um(good.places_um, moved.places_um)
    assert change_um == pytest.approx(2, rel=0.25)
    assert found(gaps).beside > GAP_LIGHT
    for spots, word in ((covered, "covered"), (found(gaps), "gaps"), (moved, "moved by")):
        assert [word in message for message in lens_messages(lens_figures(spots, lenses, before))] == [True]
    assert "22" in " ".join(lens_messages(lens_figures(None, lenses, before)))  # too few spots to fit lenses to
    other = random_packing(600.0, optics().iris_um, 3)
    assert shift_um(good.places_um, other) > 30  # another plate


def test_spots_of_a_wider_point_source_than_stated_are_told_from_those_of_lenses() -> None:
    """A disc of 48 um, as 275 um behind 25 mm, and one of 9 um, which the spots hide."""
    wide, narrow = (Psf(convolved_with_disc(seen().pixels, um / PITCH_UM)) for um in (48, 9))
    lenses = optics().element.lenses
    assert list(lens_messages(lens_figures(found(narrow), lenses, None))) == []
    assert "see whether the point source is at most" in " ".join(lens_messages(lens_figures(found(wide), lenses, None)))


def without_spot(psf: Psf, lens: tuple[float, float, float]) -> Psf:
    """Return the PSF without the light of one lens."""
    rows, cols = (np.indices(psf.shape) - np.array(psf.shape)[:, None, None] // 2) * PITCH_UM
    near = np.hypot(cols - lens[0], rows - lens[1]) < 120
    pixels: Image = np.where(near, 0, psf.pixels)
    return Psf(pixels)


def test_refraction_of_a_bright_frame_is_not_refused() -> None:
    """Samples of 24 um, enough for a caustic, do not resolve the spots: the refinement explained no retina."""
    bench = Bench(2)
    flat = partial(decide, without=("lens_curvature",))
    take = bench.expose("human_eye_imx296_power_lenslets", {"sim.eye.m_dpt": 2.0, "sim.eye.j0_dpt": 0.5}, flat)
    assert bench.refraction(take) == pytest.approx((2.0, 0.5, 0.0), abs=0.1)
