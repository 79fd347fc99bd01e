"""Tests of darks, flats and point source on a simulated head, against the simulator's true values."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device.calibration.procedure.darks import (
    Darks,
    fit_normal,
    has_two_counts_only,
    measure_darks,
    quantised_moments,
    read_noise_dn,
    widest_normal,
)
from device.calibration.procedure.flats import Flats, measure_flats
from device.calibration.procedure.moments import Moments
from device.calibration.procedure.point_source import MotionCheck, measure_point_source
from device.clock import VirtualClock
from device.config.head_file import load_head
from device.errors import CalibrationRefused
from device.sim import calibration_targets
from device.sim.camera import SimCamera
from device.sim.effects.sensor import hot_pixels
from device.sim.light import SimLight
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import flat_frame
from device.sim.world import World
from device.values import ExposureSettings, Frame, Illumination, Image
from tests.simulated import with_keys

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
FLAWS = {"prnu": 0.01, "dsnu_e": 2.0, "dark_e_per_s": 50.0, "hot_pixels": 1e-3, "nonlinearity": -0.01}
E_PER_S = 160_000.0


def small_world(
    black_dn: float = 64.0, calibration: dict[str, Any] | None = None, coarser: int = 4, **flaws: Any
) -> World:
    spec = load_head(HEAD)
    rows, cols, pitch_um = spec.camera.rows // coarser, spec.camera.cols // coarser, coarser * spec.camera.pitch_um
    small = {"rows": rows, "cols": cols, "pitch_um": pitch_um, "black_dn": black_dn}
    spec = spec.model_copy(update={"camera": spec.camera.model_copy(update=small)})
    return World(with_keys(spec, sensor=flaws, calibration=calibration or {}), VirtualClock())


def taken(world: World, exposure_s: float, count: int = 16) -> Moments:
    camera = SimCamera(world)
    return Moments.over((camera.expose(ExposureSettings(exposure_s)) for _ in range(count)), world.shape, exposure_s)


def darks_of(world: World) -> Darks:
    world.target = calibration_targets.cap(world)
    return measure_darks([taken(world, exposure_s) for exposure_s in (0.001, 0.1, 0.4)], 0.1, 4095)


def flats_of(world: World, darks: Darks) -> Flats:
    world.target = calibration_targets.screen(world, E_PER_S)
    levels = [taken(world, exposure_s) for exposure_s in (0.01, 0.02, 0.04, 0.07, 0.1, 0.115)]
    return measure_flats(levels, taken(world, 0.3, 2), darks)


def bracketed(world: World, darks: Darks) -> list[Moments]:
    camera, found = SimCamera(world), []
    for exposure_s in (0.1, 0.4, 1.6):
        frames = (camera.expose(ExposureSettings(exposure_s)) for _ in range(16))
        found.append(Moments.over(MotionCheck(darks.at(exposure_s)).watch(frames), world.shape, exposure_s))
    return found


@pytest.fixture(scope="module")
def flawed() -> tuple[World, Darks, Flats]:
    world = small_world(64.3, **FLAWS)
    darks = darks_of(world)
    return world, darks, flats_of(world, darks)


def likeness(a: Image, b: Image) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("black_dn", [64.0, 64.3])  # half-way between two counts only these two occur
@pytest.mark.parametrize("dsnu_e", [0.0, 2.0])
def test_black_level_and_read_noise_are_measured_far_below_one_count(black_dn: float, dsnu_e: float) -> None:
    world = small_world(black_dn, dsnu_e=dsnu_e)
    darks, camera = darks_of(world), world.spec.camera
    assert darks.black_dn == pytest.approx(black_dn, abs=0.02)  # required: 0.2
    assert darks.read_noise_dn * camera.gain_e_per_dn == pytest.approx(camera.read_noise_e, rel=0.05)


@pytest.mark.parametrize("mean_dn", [64.0, 64.2, 64.5, 64.9])
@pytest.mark.parametrize("sigma_dn", [0.3, 1.0, 5.0])
def test_a_normal_distribution_is_recovered_from_the_moments_of_its_rounded_counts(
    mean_dn: float, sigma_dn: float
) -> None:
    assert fit_normal(*quantised_moments(mean_dn, sigma_dn)) == pytest.approx((mean_dn, sigma_dn), rel=1e-3)


@pytest.mark.parametrize("read_noise_e", [0.3, 0.6, 1.03])
def test_half_way_between_two_counts_read_noise_is_the_upper_bound(read_noise_e: float) -> None:
    """Up to 1.03 electrons only 64 and 65 occur, each half of the time, whatever the noise is."""
    assert fitted_or_most(64.5, read_noise_e / 5.706) == pytest.approx((64.5, 0.212), rel=0.01)


def fitted_or_most(mean_dn: float, sigma_dn: float) -> tuple[float, float]:
    seen = *quantised_moments(mean_dn, sigma_dn), 2_000_000
    return widest_normal(mean_dn, seen[2]) if has_two_counts_only(*seen) else fit_normal(*seen[:2])


def test_read_noise_is_separated_from_a_fixed_pattern() -> None:
    rng = np.random.default_rng(5)
    zeros = 64.3 + 0.35 * rng.standard_normal((1, 200_000))
    counts = np.rint(zeros + 0.18 * rng.standard_normal((8, 200_000)))
    total_dn = float(np.hypot(0.35, 0.18))
    temporal_dn2 = float(counts.var(0, ddof=1).mean())
    assert read_noise_dn(64.3, total_dn, temporal_dn2) == pytest.approx(0.18, rel=0.01)


def test_dark_current_and_hot_pixels_are_measured(flawed: tuple[World, Darks, Flats]) -> None:
    world, darks, _ = flawed
    hot = hot_pixels(world.scene)
    assert darks.dark_dn_per_s * world.spec.camera.gain_e_per_dn == pytest.approx(50, rel=0.02)
    assert hot.any()
    assert not (hot & ~darks.hot).any()
    assert (darks.hot & ~hot).mean() < 1e-4


def test_gain_response_nonlinearity_and_saturation_are_measured(flawed: tuple[World, Darks, Flats]) -> None:
    world, darks, flats = flawed
    assert flats.gain_e_per_dn == pytest.approx(world.spec.camera.gain_e_per_dn, rel=0.01)
    assert flats.nonlinearity == pytest.approx(-0.01, rel=0.05)
    assert flats.white_dn == 4095
    good, truth = ~darks.hot, flat_frame(world)
    assert truth is not None
    assert likeness(truth[good], flats.response[good]) >= 0.95


@pytest.mark.parametrize("flaws", [{}, FLAWS])
def test_the_psf_is_measured_and_centred(flaws: dict[str, float]) -> None:
    world = small_world(**flaws)
    darks = darks_of(world)
    flats = flats_of(world, darks)
    world.target = calibration_targets.point(world, E_PER_S, moved_px=(3, -2))
    point = measure_point_source(bracketed(world, darks), darks, flats)
    truth = crop_or_pad(world.psf("green"), world.shape)
    assert point.off_px == (3, -2)
    assert likeness(point.psf.pixels, truth) >= 0.999
    beyond = truth < 1e-6 * truth.max()
    assert abs(float(point.psf.pixels[beyond].sum())) < 0.005  # of a sum of 1: light outside the PSF
    assert point.residual < 0.005


def test_the_disc_of_the_source_is_deconvolved() -> None:
    """The paper's 275 um dot is 2.5 of these pixels wide."""
    world = small_world(calibration={"source_um": 275.0})
    darks = darks_of(world)
    flats = flats_of(world, darks)
    world.target = calibration_targets.point(world, E_PER_S)
    frames = bracketed(world, darks)
    truth = crop_or_pad(world.psf("green"), world.shape)
    plain, sharp = (measure_point_source(frames, darks, flats, disc_px) for disc_px in (0.0, 275 * 0.18 / 20.16))
    assert likeness(plain.psf.pixels, truth) < 0.95 < 0.98 < likeness(sharp.psf.pixels, truth)


# Refusals of each step


def refusal_message(step: Any, *arguments: Any) -> str:
    with pytest.raises(CalibrationRefused) as caught:
        step(*arguments)
    assert any(digit.isdigit() for digit in caught.value.message), "a number says how far off it is"
    assert caught.value.remedy.endswith(".")
    return caught.value.message


def test_dark_frames_with_lamp_or_stray_light_are_refused() -> None:
    world = small_world()
    with SimLight(world).on(Illumination("green")):
        assert "lamp was on" in refusal_message(taken, world, 0.1)
    retina = World(world.spec, VirtualClock(), ambient_e_per_s=2000.0)
    bright = [taken(retina, exposure_s, 4) for exposure_s in (0.001, 0.1, 1.0)]
    assert "rise by" in refusal_message(measure_darks, bright, 0.1, 4095)
    world.target = calibration_targets.screen(world, 300.0) * np.linspace(
        0, 1, 480, dtype=np.float32
    )  # a light leak on one side
    assert "brighter than another" in refusal_message(measure_darks, several(world, (0.001, 0.1, 0.4)), 0.1, 4095)


def several(world: World, exposures_s: Sequence[float]) -> list[Moments]:
    return [taken(world, exposure_s, 4) for exposure_s in exposures_s]


def test_a_frame_of_another_sensor_mode_is_refused() -> None:
    moments = Moments((4, 6), 0.1)
    assert "(6, 4)" in refusal_message(moments.add, Frame(np.zeros((6, 4), np.uint16), 0.1, 1, None, True))
    assert "0.2 s" in refusal_message(moments.add, Frame(np.zeros((4, 6), np.uint16), 0.2, 1, None, True))


def test_a_dark_shaded_dim_or_saturated_flat_is_refused(
    flawed: tuple[World, Darks, Flats],
) -> None:
    world, darks, _ = flawed
    world.target = calibration_targets.screen(world, E_PER_S)
    bright = taken(world, 0.3, 2)
    world.target = calibration_targets.cap(world)
    capped = several(world, (0.02, 0.05, 0.1))
    assert "is dark" in refusal_message(measure_flats, capped, bright, darks)
    world.target = calibration_targets.screen(world, E_PER_S)
    world.target[200:, 300:340] *= np.float32(0.9)  # a finger's shadow
    assert "surroundings" in refusal_message(measure_flats, several(world, (0.02, 0.05, 0.1)), bright, darks)
    world.target = calibration_targets.screen(world, E_PER_S)
    world.target[:, 300:] *= np.float32(0.3)  # a hand
    assert "darker" in refusal_message(measure_flats, several(world, (0.02, 0.05, 0.1)), bright, darks)
    world.target = calibration_targets.screen(world, E_PER_S)
    levels = several(world, (0.02, 0.05, 0.1))
    assert "not saturated" in refusal_message(measure_flats, levels, taken(world, 0.12, 2), darks)
    assert "is saturated" in refusal_message(measure_flats, several(world, (0.02, 0.1, 0.2)), bright, darks)


def test_a_nonlinear_flat_is_refused() -> None:
    world = small_world(coarser=8, nonlinearity=-0.15)
    assert "bend by -15" in refusal_message(flats_of, world, darks_of(world))


def test_a_dark_saturated_or_moving_point_source_is_refused(flawed: tuple[World, Darks, Flats]) -> None:
    world, darks, flats = flawed
    for e_per_s, words in ((2_000.0, "too dark"), (400_000.0, "saturated")):
        world.target = calibration_targets.point(world, e_per_s)
        assert words in refusal_message(measure_point_source, several(world, (0.1, 0.4)), darks, flats)
    places = (calibration_targets.point(world, E_PER_S, moved_px=(row, 0)) for row in (0, 0, 1))
    camera = SimCamera(world)

    def moving_frames() -> Any:
        for world.target in places:
            yield camera.expose(ExposureSettings(0.1))

    assert "moved by 1.0 pixels" in refusal_message(list, MotionCheck(darks.at(0.1)).watch(moving_frames()))
    world.target = calibration_targets.point(world, E_PER_S) + np.linspace(0, 2000, 480, dtype=np.float32)  # room light
    assert "border" in refusal_message(measure_point_source, several(world, (0.1, 0.4)), darks, flats)
