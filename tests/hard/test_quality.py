"""A bad picture must be known as bad: noise, a wrong PSF, a covered sensor, little light - and a good one as good."""

from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.recon.reconstructor import Recipe, Reconstructor
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.world import World
from device.spec import load_head
from device.values import Calibration, Glow, Psf, Shot
from services.instrument.hard_cases.cases import peak
from services.instrument.hard_cases.frames import Eye
from tests import scenes
from tests.simulated import SCENES, coarse, exposed, having

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
SMALL = {"rows": 540, "cols": 960, "pitch_um": 10.08}


@pytest.fixture(scope="module")
def world() -> World:
    spec = load_head(HEAD)
    return World(spec.model_copy(update={"camera": spec.camera.model_copy(update=SMALL)}), VirtualClock())


@pytest.fixture(scope="module")
def calibration(world: World) -> Calibration:
    return simulated_calibration(world)


def seen(world: World, exposure_s: float = 0.1) -> np.ndarray:
    camera = SimCamera(world)
    with SimLight(world).on(Glow("green")):
        return camera.expose(Shot(exposure_s)).counts


def look(calibration: Calibration, counts: np.ndarray):
    make = Reconstructor(calibration, counts.shape, scenes.PLANNER, VirtualClock(), (Recipe("variation", 1),))
    return make(counts).report


@pytest.fixture(scope="module")
def good(world: World, calibration: Calibration):
    return look(calibration, seen(world))


def test_a_good_picture_has_no_complaint(good) -> None:
    assert good.warnings == ()
    assert good.quality["coverage"] > 0.9
    assert 60 < good.quality["resolution_um"] < 300  # optics.md 8.2: 137 um at 20 ke-, 244 um at 2 ke-
    assert good.residual == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_flickering_light_is_reported_and_gives_no_refraction(
    good, world: World, calibration: Calibration, share: float
) -> None:
    """A lamp that swings by 2 % while rows are read costs a tenth of the correlation, and the rms hides it."""
    counts, black_dn = seen(world), calibration.sensor.black_dn
    swing = 1 + share * np.sin(2 * np.pi * 3 * np.linspace(0, 1, len(counts)))
    flickered = look(calibration, np.round(black_dn + (counts - black_dn) * swing[:, None]).astype(np.uint16))
    assert good.quality["banding"] < 0.0013 < flickered.quality["banding"]
    assert any("steady light" in warning for warning in flickered.warnings)
    assert flickered.refraction_dpt is None
    assert flickered.quality["resolution_um"] is None


@pytest.mark.parametrize(("seed", "m_dpt", "peak_e"), [(338, 0.8, 50), (14, 4.0, 250)])
def test_little_light_is_neither_a_foreign_psf_nor_flicker(seed: int, m_dpt: float, peak_e: float) -> None:
    """Two frames that had these messages, through the instrument's ladder at full size."""
    eye = Eye("dim eye", "sim", {"sim.seed": seed, "sim.eye.m_dpt": m_dpt})
    take, frame = eye.clean.take, peak(peak_e)(eye)
    made = Reconstructor(take.calibration, take.shape, scenes.PLANNER, VirtualClock(), timed=False)(frame.raw)
    assert all("refraction" in words for words in made.report.warnings)


def test_less_light_resolves_less(good, world: World, calibration: Calibration) -> None:
    dim = look(calibration, seen(world, 0.04))
    assert dim.quality["resolution_um"] > 1.15 * good.quality["resolution_um"]


@pytest.mark.parametrize("times", [1.0, 0.3])
def test_a_dim_eye_is_an_eye_and_an_even_screen_as_bright_is_none(times: float) -> None:
    """In little light a good picture is explained by few frequencies; a rule that asked all of them saw no eye."""
    spec = coarse(load_head(SCENES / "dim.toml"), 4)
    dim = World(having(spec, peak_e=spec.sim.peak_e * times), VirtualClock())
    calibration = simulated_calibration(World(spec, VirtualClock()))
    dim.electrons_per_s("green")
    assert look(calibration, exposed(dim)).warnings == ()
    dim.faults.add("eye.closed")
    assert look(calibration, exposed(dim)).warnings[0].startswith("No eye was seen")


@pytest.mark.parametrize("case", ["noise", "mirrored psf"])
def test_what_this_psf_did_not_make_is_said_so(case: str, world: World, calibration: Calibration) -> None:
    counts = seen(world)
    if case == "noise":
        counts = np.random.default_rng(0).poisson(600, counts.shape).astype(np.uint16)
    else:
        mirrored = Psf(np.ascontiguousarray(calibration.psfs[0].pixels[::-1]))
        calibration = Calibration((mirrored,), calibration.sensor, calibration.geometry, calibration.field_deg)
    report = look(calibration, counts)
    assert report.quality["structure_sure"] is None  # no figure through a PSF that does not match
    (words,) = [words for words in report.warnings if "lit" not in words]
    assert words.startswith("No eye was seen" if case == "noise" else "The PSF does not match this frame")


def test_detail_that_the_frame_does_not_hold_is_not_painted(world: World, calibration: Calibration) -> None:
    """Two objects that differ only where the OTF is empty give one picture: nothing is invented from the prior."""
    counts = seen(world).astype(np.float32)
    H = np.abs(np.fft.rfft2(np.fft.ifftshift(calibration.psfs[0].pixels)))
    rng = np.random.default_rng(4)
    hidden = np.fft.irfft2(
        np.where(np.quantile(H, 0.2) > H, np.fft.rfft2(rng.normal(0, 1, counts.shape)), 0), counts.shape
    )
    hidden *= 300 / hidden.std()  # an object far stronger than the noise, which the optics does not pass
    arriving = np.fft.irfft2(
        np.fft.rfft2(hidden) * np.fft.rfft2(np.fft.ifftshift(calibration.psfs[0].pixels)), counts.shape
    )
    make = Reconstructor(calibration, counts.shape, scenes.PLANNER, VirtualClock(), (Recipe("variation", 1),))
    without = make(counts).picture.copy()
    with_hidden = make((counts + arriving).astype(np.float32)).picture
    lit = without > 0
    assert np.linalg.norm((with_hidden - without)[lit]) < 0.01 * np.linalg.norm(hidden[lit])
