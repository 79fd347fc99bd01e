"""Refraction of textbook frames (`tests/textbook`), which share no code with simulator and estimator."""

from functools import cache

import numpy as np
import pytest

from device.recon.estimation.psf_warp import transform, warped
from device.recon.estimation.refraction.estimator import NoRefraction, Refraction, RefractionEstimator
from device.recon.estimation.refraction.notation import report_of
from device.recon.model.fft_plans import Planner
from device.values import Calibration, Geometry, Psf, Sensor
from tests.textbook.fundus_frame import Camera, Counts, FieldEdge, blurred, degrees
from tests.textbook.propagation import Optics, Plane, Prescription, caustic, diffuser

OPTICS = Optics(pitch_um=6.9)  # two pixels of an IMX296: a quarter of the samples
CAMERA = Camera((544, 728), 20000.0, 2.2, 12, 60.0)
FIELD_DEG = 33.4
SURFACE = diffuser(OPTICS, 560, 3)
PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")
GEOMETRY = Geometry(OPTICS.pitch_um, OPTICS.distance_um, OPTICS.magnification)


def retina(right_deg: Plane, down_deg: Plane) -> Plane:
    """Return a synthetic retina: fine texture with a power that falls as 1/f^2, a bright disc, and vessels."""
    samples = len(right_deg)
    rng = np.random.default_rng(5)
    frequency = np.hypot(np.fft.fftfreq(samples)[:, None], np.fft.rfftfreq(samples)[None])
    frequency[0, 0] = np.inf
    texture = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((samples, samples))) / frequency, (samples, samples))
    disc = np.hypot(right_deg - 8, down_deg) < 3
    arcs = ((0.02, 1), (-0.03, -1))
    vessels = sum(np.exp(-(((down_deg - a * (right_deg - 8) ** 2 - b) / 0.25) ** 2)) for a, b in arcs)
    return np.asarray((1 + 0.6 * disc) * (1 + 0.06 * texture / texture.std()) * (1 - 0.4 * vessels))


def expose(eye: Prescription, edge: FieldEdge, moved_px: tuple[int, int] = (0, 0), seed: int = 6) -> Counts:
    """Return the counts of an eye behind the textbook optics at 85 % of the full well; its retina is moved."""
    right_deg, down_deg = degrees(OPTICS, round((FIELD_DEG + 3) * OPTICS.px_per_deg / 2) * 2)
    scene = np.roll(retina(right_deg, down_deg), moved_px, (0, 1)) * edge.light(right_deg, down_deg)
    light = blurred(scene, caustic(OPTICS, SURFACE, eye), CAMERA.shape)
    return CAMERA.read(light / light.max() * 0.85 * CAMERA.full_well_e, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def estimator() -> RefractionEstimator:
    sensor = Sensor(CAMERA.black_dn, CAMERA.gain_e_per_dn, CAMERA.read_noise_e, 2.0**CAMERA.bits - 1)
    psf = Psf(caustic(OPTICS, SURFACE, Prescription()).astype(np.float32))
    return RefractionEstimator(Calibration((psf,), sensor, GEOMETRY, FIELD_DEG), CAMERA.shape, PLANNER, 0)


def test_the_textbook_caustic_agrees_with_the_warp_and_its_signs() -> None:
    """A correction of -3.5 -1.0 x 20 is an eye of M = 4 with its cylinder at 20 deg counter-clockwise, y up.

    The warp is exact in geometrical optics; OPTICS.md 2.6 has 0.9995 against wave propagation up to 5.5 dpt.
    """
    eye = Prescription(-3.5, -1.0, 20.0)
    j0_dpt, j45_dpt = 0.5 * np.cos(np.deg2rad(40)), 0.5 * np.sin(np.deg2rad(40))
    stored, strained = (
        Psf(caustic(OPTICS, SURFACE, prescription).astype(np.float32)) for prescription in (Prescription(), eye)
    )
    found = warped(stored, transform(GEOMETRY, 4.0, -j0_dpt, j45_dpt))
    assert np.corrcoef(found.pixels.ravel(), strained.pixels.ravel())[0, 1] > 0.998
    mirrored = warped(stored, transform(GEOMETRY, 4.0, -j0_dpt, -j45_dpt))
    assert np.corrcoef(mirrored.pixels.ravel(), strained.pixels.ravel())[0, 1] < 0.99


@pytest.mark.parametrize(
    "edge",
    [
        FieldEdge(FIELD_DEG),
        FieldEdge(FIELD_DEG - 0.2),
        FieldEdge(FIELD_DEG, 0.08, -0.06),
        FieldEdge(FIELD_DEG, width_deg=1.0),
    ],
    ids=["exact", "0.2 deg too large", "off centre", "soft"],
)
def test_sphere_and_field_edge_are_found_together(estimator: RefractionEstimator, edge: FieldEdge) -> None:
    """With the calibrated edge an edge that is 0.2 deg too large costs 0.8 dpt, and one soft over 1 deg more."""
    found = estimator.find(expose(Prescription(-2.5), edge))
    assert isinstance(found, Refraction)
    assert abs(found.m_dpt - 2.5) < 3 * found.sd_dpt
    assert found.sd_dpt < 0.35
    assert found.edge.diameter_deg == pytest.approx(edge.diameter_deg, abs=0.1)
    assert (found.edge.right_deg, found.edge.down_deg) == pytest.approx((edge.right_deg, edge.down_deg), abs=0.06)
    assert found.edge.width_deg == pytest.approx(edge.width_deg, abs=0.5)


def test_the_cylinder_is_reported_on_the_axis_of_the_correcting_lens(estimator: RefractionEstimator) -> None:
    found = estimator.find(expose(Prescription(-1.0, -2.0, 30.0), FieldEdge(FIELD_DEG)))
    assert isinstance(found, Refraction)
    report = report_of(estimator.add_cylinder(found))
    assert report["refused"] is None
    assert report["sphere_sc"] == pytest.approx(-1.0, abs=0.25)  # 3 sd of M and of the cylinder
    assert report["cylinder"] == pytest.approx(-2.0, abs=0.35)  # 3 sd of a cylinder, which is twice hypot(J0, J45)
    assert report["axis_deg"] == pytest.approx(30.0, abs=5.0)
    assert report["sd"] < 0.08  # 0.17 before the refinement


def test_a_frame_without_detail_is_refused(estimator: RefractionEstimator) -> None:
    noise = np.random.default_rng(1).normal(900, 20, CAMERA.shape).astype(np.uint16)
    assert not isinstance(estimator.find(noise), Refraction)


MOVED_PX = ((0, 0), (2, -3), (-4, 1), (5, 4))  # of the retina, 0.2 to 0.7 deg; the lit field stands still
SPHERE_DPT = -2.5
CHI2_OF_ONE_PERCENT = 11.3  # chi^2 with three degrees of freedom, exceeded by 1 % of its values


@cache
def frame_of_burst(k: int, sphere_dpt: float = SPHERE_DPT) -> Counts:
    """Return frame `k` of a burst of an eye that needs this correction."""
    return expose(Prescription(sphere_dpt), FieldEdge(FIELD_DEG), MOVED_PX[k], 6 + k)


@pytest.fixture(scope="module")
def first(estimator: RefractionEstimator) -> Refraction:
    """Return the refraction of the first frame of each burst."""
    found = estimator.find(frame_of_burst(0))
    assert isinstance(found, Refraction)
    whole = estimator.add_cylinder(found)
    assert isinstance(whole, Refraction)
    return whole


def test_frames_of_one_eye_scatter_within_their_sd(estimator: RefractionEstimator, first: Refraction) -> None:
    burst = [frame_of_burst(k) for k in range(4)]
    whole = estimator.join(first, burst, None)
    assert isinstance(whole, Refraction)
    assert whole.scatter is not None
    assert (whole.scatter.count, whole.scatter.stated_sd_dpt) == (4, first.sd_dpt)
    assert 0 < whole.scatter.chi2 < CHI2_OF_ONE_PERCENT
    assert whole.sd_dpt == max(first.sd_dpt, whole.scatter.sd_dpt)
    assert abs(whole.m_dpt + SPHERE_DPT) < 3 * first.sd_dpt
    assert estimator.join(first, burst[:2], None) == first, "two frames have no scatter"


def test_an_eye_that_accommodates_between_the_frames_has_the_sd_of_its_scatter(
    estimator: RefractionEstimator, first: Refraction
) -> None:
    """The steps are good to 20 %, and a mean of four to 0.1 dpt: 2 sd of one frame."""
    spheres_dpt = (SPHERE_DPT, -2.9, -2.2, -3.0)
    burst = [frame_of_burst(k, sphere_dpt) for k, sphere_dpt in enumerate(spheres_dpt)]
    whole = estimator.join(first, burst, None)
    assert isinstance(whole, Refraction)
    assert whole.scatter is not None
    assert whole.scatter.chi2 > 3 * CHI2_OF_ONE_PERCENT
    assert whole.sd_dpt == whole.scatter.sd_dpt == pytest.approx(float(np.std(spheres_dpt, ddof=1)), rel=0.2)
    assert whole.m_dpt == pytest.approx(-np.mean(spheres_dpt), abs=0.1)
    assert abs(first.m_dpt - whole.m_dpt) > 0.1


def test_frames_with_too_different_refractions_are_refused(estimator: RefractionEstimator, first: Refraction) -> None:
    whole = estimator.join(first, [frame_of_burst(0), frame_of_burst(1, -0.5), frame_of_burst(2, -4.5)], None)
    assert isinstance(whole, NoRefraction)
    assert "another refraction" in whole.reason
