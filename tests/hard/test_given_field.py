"""Field that was given for a frame, compared with the lit disc in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.errors import SettingError
from device.recon.assessment.lit_disc import disc_radius
from device.sim.scene_files import lit_frames
from device.sim.world import World
from services.research.reconstruct_capture import CaptureFrames, CaptureReconstructor
from services.research.reconstruct_file import FileReconstruction, FileReconstructor
from tests.hard.cells import CaseRunner
from tests.hard.frames import Eye, HardFrame, crescent_dark

EYE = Eye("relaxed eye, merged", "sim", {"sim.seed": 1}, merged=4)
FIELD_DEG = 33.4  # of the head


def reconstructed(frame: HardFrame, folder: Path, field_deg: float | None, fixed: bool = False) -> FileReconstruction:
    raw, options, _ = CaseRunner(EYE, folder, ()).files(frame, "variation")
    return FileReconstructor(replace(options, field_deg=field_deg, field_fixed=fixed))(raw)


def test_a_field_within_the_lit_disc_is_refused_with_the_one_that_fits(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"a disc of 33.4 degrees.*given as 28") as refused:
        reconstructed(EYE.clean, tmp_path, 28.0)
    assert "--field-deg 33.4" in refused.value.remedy


def test_a_fixed_field_is_kept(tmp_path: Path) -> None:
    made = reconstructed(EYE.clean, tmp_path, 28.0, fixed=True)
    assert not any("field was given" in warning for warning in made.report.warnings)


def test_a_field_beyond_the_lit_disc_gives_the_picture_of_the_disc_and_says_so(tmp_path: Path) -> None:
    made = reconstructed(EYE.clean, tmp_path, 40.0)
    (warning,) = made.report.warnings
    assert "--field-deg 33.4" in warning
    expected = reconstructed(EYE.clean, tmp_path, None)
    assert not expected.report.warnings
    np.testing.assert_array_equal(made.picture, expected.picture)


@pytest.mark.parametrize("field_deg", [28.0, 40.0])
def test_the_field_of_a_burst_and_of_colours_is_compared_too(field_deg: float, tmp_path: Path) -> None:
    _, whole, _ = CaseRunner(EYE, tmp_path, ()).files(EYE.clean, "variation")
    options = replace(whole, field_deg=field_deg)
    first, second = lit_frames(World(EYE.spec, VirtualClock()), 2)
    burst, colours = CaptureFrames((first, second)), CaptureFrames((first,), {"red": (second,)}, light="green")
    for frames in (burst, colours):
        reconstruct = CaptureReconstructor(options, of_colours={"red": options})
        if field_deg < FIELD_DEG:
            with pytest.raises(SettingError, match=r"a disc of 33.4 degrees.*given as 28"):
                reconstruct(frames)
        else:
            solved, expected = reconstruct(frames), CaptureReconstructor(whole, of_colours={"red": whole})(frames)
            assert any("--field-deg 33.4" in warning for warning in solved.made.report.warnings)
            np.testing.assert_allclose(
                solved.made.picture, expected.made.picture, atol=1e-3 * solved.made.picture.max()
            )


@pytest.mark.parametrize("m_dpt", [-4.0, 3.0])
def test_a_dark_border_costs_neither_the_refraction_nor_a_wrong_word(m_dpt: float, tmp_path: Path) -> None:
    eye = replace(EYE, changes={"sim.seed": 1, "sim.eye.m_dpt": m_dpt})
    made = reconstructed(eye.frame(shade=crescent_dark(0.0, 0.93 * FIELD_DEG / 2)), tmp_path, None)
    (warning,) = made.report.warnings
    assert warning.startswith("Only a disc of 3")
    assert made.report.refraction_dpt is not None
    assert made.report.refraction_dpt["sphere"] == pytest.approx(-m_dpt, abs=0.15)


@pytest.mark.parametrize("seen", [1.0, 0.5])
def test_only_a_whole_disc_has_a_radius(seen: float) -> None:
    disc = np.tile(np.clip(20.5 - np.arange(40.0), 0, 1), (16, 1))
    disc[: round(16 * (1 - seen))] = 0
    assert disc_radius(disc) == (pytest.approx(20.0, abs=0.6) if seen == 1 else None)


def test_in_too_little_light_nothing_is_said_about_the_field(tmp_path: Path) -> None:
    made = reconstructed(EYE.frame({"sim.peak_e": 50.0 * EYE.merged**2}), tmp_path, None)
    assert not any("Only a disc" in warning for warning in made.report.warnings)
