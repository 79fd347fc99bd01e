"""Quality figures and warnings: bad pictures (noise, wrong PSF, covered sensor, little light) and good ones."""

from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, ExposureSettings, Illumination, Psf
from tests import scenes
from tests.hard.cases import peak
from tests.hard.frames import Eye
from tests.simulated import SCENES, coarse, exposed_counts, with_keys

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
SMALL = {"rows": 540, "cols": 960, "pitch_um": 10.08}


@pytest.fixture(scope="module")
def world() -> World:
    spec = load_head(HEAD)
    return World(spec.model_copy(update={"camera": spec.camera.model_copy(update=SMALL)}), VirtualClock())


@pytest.fixture(scope="module")
def calibration(world: World) -> Calibration:
    return simulated_calibration(world)


def counts_of(world: World, exposure_s: float = 0.1) -> np.ndarray:
    camera = SimCamera(world)
    with SimLight(world).on(Illumination("green")):
        return camera.expose(ExposureSettings(exposure_s)).counts


def report_of(calibration: Calibration, counts: np.ndarray):
    make = Reconstructor(calibration, counts.shape, scenes.PLANNER, VirtualClock(), (Recipe("variation", 1),))
    return make(counts).report


@pytest.fixture(scope="module")
def good(world: World, calibration: Calibration):
    return report_of(calibration, counts_of(world))


def test_a_good_picture_has_no_warning(good) -> None:
    assert good.warnings == ()
    assert good.quality["coverage"] > 0.9
    assert 60 < good.quality["resolution_um"] < 300  # OPTICS.md 4.3: 137 um at 20 ke-, 244 um at 2 ke-
    assert good.residual == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_flickering_light_is_reported_and_gives_no_refraction(
    good, world: World, calibration: Calibration, share: float
) -> None:
    """A lamp that swings by 2 % during the readout costs a tenth of the correlation, without a higher rms residual."""
    counts, black_dn = counts_of(world), calibration.sensor.black_dn
    swing = 1 + share * np.sin(2 * np.pi * 3 * np.linspace(0, 1, len(counts)))
    flickered = report_of(calibration, np.round(black_dn + (counts - black_dn) * swing[:, None]).astype(np.uint16))
    assert good.quality["banding"] < 0.0013 < flickered.quality["banding"]
    assert any("steady light" in warning for warning in flickered.warnings)
    assert flickered.refraction_dpt is not None
    assert flickered.refraction_dpt["sphere"] is None
    assert flickered.refraction_dpt["refused"] is not None
    assert flickered.quality["resolution_um"] is None


@pytest.mark.parametrize(("seed", "m_dpt", "peak_e"), [(338, 0.8, 50), (14, 4.0, 250)])
def test_little_light_is_neither_a_foreign_psf_nor_flicker(seed: int, m_dpt: float, peak_e: float) -> None:
    """Two frames that caused these warnings, through the default schedule at full size."""
    eye = Eye("dim eye", "sim", {"sim.seed": seed, "sim.eye.m_dpt": m_dpt})
    take, frame = eye.clean.simulated, peak(peak_e)(eye)
    made = Reconstructor(take.calibration, take.shape, scenes.PLANNER, VirtualClock(), timed=False)(frame.raw)
    assert all("refraction" in words or "little light" in words for words in made.report.warnings)


@pytest.mark.parametrize(("head", "seed"), [("sim", 338), ("imx296", 5)])
def test_a_frame_with_too_little_light_for_vessels_says_so(head: str, seed: int) -> None:
    """At full size: at 50 electrons always, at 144 (the light of a human eye today) and 500 never."""
    eye = Eye("dim eye", head, {"sim.seed": seed})
    take = eye.clean.simulated
    make = Reconstructor(take.calibration, take.shape, scenes.PLANNER, VirtualClock(), timed=False)
    warned = {
        e: any("little light" in words for words in make(peak(e)(eye).raw).report.warnings) for e in (50, 144, 500)
    }
    assert warned == {50: True, 144: False, 500: False}


def test_less_light_gives_a_coarser_resolution(good, world: World, calibration: Calibration) -> None:
    dim = report_of(calibration, counts_of(world, 0.04))
    assert dim.quality["resolution_um"] > 1.15 * good.quality["resolution_um"]


@pytest.mark.parametrize("times", [1.0, 0.3])
def test_a_dim_eye_is_accepted_and_an_even_screen_of_equal_brightness_is_not(times: float) -> None:
    """In little light few frequencies explain a good picture; a rule over all frequencies rejected such eyes."""
    spec = coarse(load_head(SCENES / "dim.toml"), 4)
    dim = World(with_keys(spec, peak_e=spec.sim.peak_e * times), VirtualClock())
    calibration = simulated_calibration(World(spec, VirtualClock()))
    dim.electrons_per_s("green")
    warnings = report_of(calibration, exposed_counts(dim)).warnings
    allowed = ("refraction", "little light")  # both are true of a sixteenth of the pixels
    assert all(any(word in words for word in allowed) for words in warnings)
    dim.faults.add("eye.closed")
    assert report_of(calibration, exposed_counts(dim)).warnings[0].startswith("No eye found")


@pytest.mark.parametrize("case", ["noise", "mirrored psf"])
def test_a_frame_that_does_not_come_through_the_psf_is_reported(
    case: str, world: World, calibration: Calibration
) -> None:
    counts = counts_of(world)
    if case == "noise":
        counts = np.random.default_rng(0).poisson(600, counts.shape).astype(np.uint16)
    else:
        mirrored = Psf(np.ascontiguousarray(calibration.psfs[0].pixels[::-1]))
        calibration = Calibration((mirrored,), calibration.sensor, calibration.geometry, calibration.field_deg)
    report = report_of(calibration, counts)
    assert report.quality["structure_sure"] is None  # no figure that uses a PSF that does not match
    (words,) = [words for words in report.warnings if "lit" not in words]
    assert words.startswith("No eye found" if case == "noise" else "The PSF does not match this frame")


def test_detail_in_the_stopband_does_not_reach_the_picture(world: World, calibration: Calibration) -> None:
    """Two objects that differ only in the stopband of the OTF give one picture: the prior adds no detail."""
    counts = counts_of(world).astype(np.float32)
    H = np.abs(np.fft.rfft2(np.fft.ifftshift(calibration.psfs[0].pixels)))
    rng = np.random.default_rng(4)
    hidden = np.fft.irfft2(
        np.where(np.quantile(H, 0.2) > H, np.fft.rfft2(rng.normal(0, 1, counts.shape)), 0), counts.shape
    )
    hidden *= 300 / hidden.std()  # an object far above the noise, in the stopband of the optics
    arriving = np.fft.irfft2(
        np.fft.rfft2(hidden) * np.fft.rfft2(np.fft.ifftshift(calibration.psfs[0].pixels)), counts.shape
    )
    make = Reconstructor(calibration, counts.shape, scenes.PLANNER, VirtualClock(), (Recipe("variation", 1),))
    without = make(counts).picture.copy()
    with_hidden = make((counts + arriving).astype(np.float32)).picture
    lit = without > 0
    assert np.linalg.norm((with_hidden - without)[lit]) < 0.01 * np.linalg.norm(hidden[lit])
