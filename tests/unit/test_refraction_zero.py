"""Zero of the refraction: stated distance of the point source, and comparison with an earlier calibration."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from device.calibration.archive import Provenance, StoredCalibration
from device.calibration.monitoring import head_check
from device.calibration.procedure.calibration_sequence import CalibrationJob
from device.calibration.procedure.refraction_zero import MIN_SAME_PATTERN, compare_zero, is_in_focus
from device.errors import CalibrationRefused
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Image, Psf, RefractionOffset
from tests.unit.test_calibration_measurements import small_world
from tests.unit.test_calibration_sequence import CalibrationBench
from tests.unit.test_dioptres import at

NOW = datetime(2026, 11, 28, tzinfo=UTC)
FOCUS_MM = 25.0
FARTHER_MM, FARTHER_DPT = 1.3, 1000 / 25 - 1000 / 26.3


@pytest.fixture(scope="module")
def world() -> World:
    return small_world()


@pytest.fixture(scope="module")
def first(world: World) -> Calibration:
    return simulated_calibration(world)


def stored(calibration: Calibration) -> StoredCalibration:
    return StoredCalibration(calibration, Provenance("D-1", NOW, "a technician", "0.1.0"))


def keystone(psf: Psf, share: float) -> Psf:
    """Return the PSF on a tilted sensor: its scale changes by `share` over half the rows of a side."""
    rows, cols = (np.arange(size) - size // 2 for size in psf.shape)
    grow = 1 + share * cols[None] / (psf.shape[0] / 2)
    places = [rows[:, None] * grow + psf.shape[0] // 2, cols[None] * grow + psf.shape[1] // 2]
    return Psf(ndimage.map_coordinates(psf.pixels, np.broadcast_arrays(*places), order=3))


def magnified(psf: Psf, scale: float) -> Psf:
    middle = np.array(psf.shape) // 2
    pixels: Image = ndimage.affine_transform(psf.pixels, np.eye(2) / scale, middle - middle / scale, order=3)
    return Psf(pixels)


@pytest.mark.parametrize(("source_mm", "known"), [(None, False), (25.0, True), (25.1, True)])
def test_only_a_stated_distance_fixes_the_zero(source_mm: float | None, known: bool) -> None:
    assert is_in_focus(source_mm, FOCUS_MM) is known


@pytest.mark.parametrize("source_mm", [24.5, 25.5])
def test_a_source_out_of_focus_is_refused_with_its_place(source_mm: float) -> None:
    with pytest.raises(CalibrationRefused) as caught:
        is_in_focus(source_mm, FOCUS_MM)
    assert "25 mm from the lens" in (caught.value.remedy or "")


def test_a_magnified_psf_is_the_refraction_that_frames_cannot_tell(world: World, first: Calibration) -> None:
    found = compare_zero(stored(first), magnified(first.psfs[0], 1.007), "green", world.geometry)
    assert found is not None
    assert found.change_dpt == pytest.approx(-2.07, abs=0.05)
    assert found.contradicts


def test_an_earlier_offset_by_trial_lenses_is_part_of_the_zero(world: World, first: Calibration) -> None:
    """The earlier source was out of focus by 0.4 dpt, as the lenses have shown; the new one is in the focus."""
    offset = RefractionOffset(0.4, 0, 0, 0.03, 0.02, 0.02)
    earlier = stored(replace(first, refraction_offset=offset))
    refocused = magnified(first.psfs[0], 1 + 0.4 * world.geometry.scale_per_dpt)
    found = compare_zero(earlier, refocused, "green", world.geometry)
    assert found is not None
    assert found.change_dpt == pytest.approx(0, abs=0.05)


def test_a_tilted_sensor_has_another_pattern_and_another_diffuser_says_nothing(
    world: World, first: Calibration
) -> None:
    tilted = compare_zero(stored(first), keystone(first.psfs[0], 0.03), "green", world.geometry)
    assert tilted is not None
    assert tilted.likeness < MIN_SAME_PATTERN
    assert tilted.change_dpt is None
    assert "pattern" in tilted.words
    other = compare_zero(stored(first), Psf(first.psfs[0].pixels[::-1, ::-1]), "green", world.geometry)
    assert other is not None
    assert other.figures == {}


def test_a_calibration_says_by_what_its_zero_is_known_and_contradicts_a_moved_source(tmp_path: Path) -> None:
    bench = CalibrationBench(tmp_path, small_world())
    job = CalibrationJob(bench.world.spec, "D-1", "a technician", "0.1.0")
    plain = bench.archive.load(bench.calibrate(job))
    assert plain.calibration.refraction_zero == "relative"
    job = replace(job, source_mm=FOCUS_MM)
    known = bench.archive.load(bench.calibrate(job))
    assert known.calibration.refraction_zero == "point source"
    bench.wrong["point"] = at(FARTHER_MM)
    moved = bench.archive.load(bench.calibrate(job))
    assert moved.calibration.refraction_zero == "relative"
    change_dpt = dict(moved.provenance.figures)["zero_change_dpt"]
    assert change_dpt == pytest.approx(FARTHER_DPT, abs=0.1)
    assert any("the zero is not known" in message for message in bench.messages)
    findings = {finding.name: finding for finding in head_check.check(moved.calibration, moved.provenance, (), (), NOW)}
    assert findings["zero"].hint
    assert findings["pattern"].ok
    bench.wrong.clear()
    again = bench.archive.load(bench.calibrate(job))
    assert again.calibration.refraction_zero == "point source", "compared with the last one whose zero is known"
