"""PSF consistency check: no warning for the right PSF of a hard frame, the right warning for each wrong PSF."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from device.config.head_file import load_head
from device.recon.assessment.psf_consistency import Consistency, Match, PsfConsistency
from device.recon.assessment.quality_figures import MISMATCHES
from device.sim.scene_files import SimulatedExposure, simulate_exposure
from device.values import Calibration, Counts, Image, Psf
from services.research.reconstruct_file import reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions
from tests import scenes
from tests.simulated import coarse, with_keys
from tests.wrong_psfs import orientations, shuffled

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"
SPEC = coarse(load_head(HEAD), 2)


@cache
def shot(m_dpt: float = 0.0, light: float = 1.0, seed: int = 1) -> SimulatedExposure:
    assert SPEC.sim is not None
    return simulate_exposure(with_keys(SPEC, eye={"m_dpt": m_dpt}, peak_e=SPEC.sim.peak_e * light, seed=seed))


def checked(counts: Counts, psf: Image | None = None, calibration: Calibration | None = None) -> Consistency:
    known = calibration or shot().calibration
    psfs = (known.psfs[0] if psf is None else Psf(psf),)
    of = Calibration(psfs, known.sensor, bad=known.bad)
    found = PsfConsistency(of, counts.shape[:2])(counts)
    assert found is not None
    return found


@pytest.mark.parametrize("m_dpt", [-8.0, -3.0, 0.0, 3.0, 8.0])
def test_an_eye_of_any_refraction_is_consistent_with_the_stored_psf(m_dpt: float) -> None:
    found = checked(shot(m_dpt).counts)
    assert found.match is Match.CONSISTENT
    assert found.orientation > 8


def test_dim_light_and_gaps_give_no_mismatch() -> None:
    counts, rng = shot().counts, np.random.default_rng(3)
    dead, warm, glare = counts.copy(), counts.copy(), counts.copy()
    dead[:, rng.choice(counts.shape[1], 12, replace=False)] = 0
    warm[rng.random(counts.shape) < 1e-3] += 1500
    glare[240:270, 430:460] = int(shot().calibration.sensor.white_dn)
    for frame in (shot(light=1 / 30).counts, dead, warm, glare):
        assert checked(frame).match in (Match.CONSISTENT, Match.UNKNOWN)


def test_wrong_psfs_are_distinguished() -> None:
    counts, right = shot().counts, shot().calibration.psfs[0].pixels
    found = {kind: checked(counts, psf).match for kind, psf in orientations(right).items()}
    assert found == {
        "mirrored left-right": Match.MIRRORED_LEFT_RIGHT,
        "mirrored up-down": Match.MIRRORED_UP_DOWN,
        "rotated by 180": Match.ROTATED,
    }
    assert checked(counts, shuffled(right)).match is Match.FOREIGN
    another = scenes.speckle(counts.shape[:2], 5)
    assert checked(counts, another).match is Match.FOREIGN
    assert checked(counts, shot(seed=77).calibration.psfs[0].pixels).match is Match.FOREIGN


def test_frames_without_information_give_no_result() -> None:
    noise = np.random.default_rng(0).poisson(600, shot().counts.shape).astype(np.uint16)
    for frame in (noise, np.full_like(noise, 600), np.zeros_like(noise)):
        known = shot().calibration
        found = PsfConsistency(Calibration(known.psfs, known.sensor), frame.shape)(frame)
        assert found is None or found.match is Match.UNKNOWN
    even = Calibration((Psf(scenes.delta(noise.shape)),), shot().calibration.sensor)  # a point equals its own rotation
    assert PsfConsistency(even, noise.shape)(shot().counts) is None


def test_the_command_warns_of_a_rotated_and_a_mirrored_psf(tmp_path: Path) -> None:
    right = shot().calibration.psfs[0].pixels
    np.save(tmp_path / "raw.npy", shot().counts)
    warnings = {}
    for name, psf in {"right": right, "rotated": right[::-1, ::-1], "mirrored": right[:, ::-1]}.items():
        np.save(tmp_path / f"{name}.npy", psf)
        order = ReconstructOptions(psfs=(tmp_path / f"{name}.npy",), method="gradient", plans=tmp_path)
        made = reconstruct_file(tmp_path / "raw.npy", order)
        warnings[name] = tuple(words for words in made.report.warnings if "PSF" in words)
    mirrored = (MISMATCHES[Match.MIRRORED_LEFT_RIGHT],)
    assert warnings == {"right": (), "rotated": (MISMATCHES[Match.ROTATED],), "mirrored": mirrored}
