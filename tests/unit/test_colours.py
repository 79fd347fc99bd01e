"""Tests of the colour step: a separate PSF only where it differs, and a refusal if the source moved."""

from pathlib import Path

import pytest

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.procedure.calibration_sequence import (
    CalibrationJob,
    CalibrationSequence,
    CalibrationTarget,
    Operator,
)
from device.calibration.procedure.colours import SAME_PSF_CORRELATION
from device.clock import VirtualClock
from device.errors import CalibrationRefused
from device.head import target_placer
from device.sim import calibration_targets
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Colour
from tests.unit.test_calibration_measurements import E_PER_S, small_world


def narrow_world() -> World:
    """Return half of the paper's iris on a matching sensor with 10 um pixels, fine enough to separate colours."""
    spec = small_world(coarser=2).spec
    assert spec.optics is not None
    camera = spec.camera.model_copy(update={"rows": 270, "cols": 270})
    optics = spec.optics.model_copy(update={"iris_um": 1600.0, "field_deg": 15.0})
    return World(spec.model_copy(update={"camera": camera, "optics": optics}), VirtualClock())


def calibrated(
    world: World, root: Path, colours: tuple[Colour, ...], wrong: World | None = None
) -> tuple[StoredCalibration, list[CalibrationTarget]]:
    requested: list[CalibrationTarget] = []

    def put(stand: CalibrationTarget) -> None:
        requested.append(stand)
        target_placer(world)(stand)
        if wrong is not None and stand == "point red":
            world.target = wrong.target

    job = CalibrationJob(world.spec, "D-1", "a technician", "0.1.0", colours=colours)
    procedure = CalibrationSequence(
        job, SimCamera(world), Operator(put, lambda line: None), world.clock, root / ".steps"
    )
    id = procedure.run(Archive(root))
    assert requested == list(job.targets)
    return Archive(root).load(id), requested


def test_a_psf_that_differs_by_colour_is_stored_separately(tmp_path: Path) -> None:
    world = narrow_world()
    kept, requested = calibrated(world, tmp_path, ("green", "red"))
    assert requested[-1] == "point red"
    assert [psf.colour for psf in kept.calibration.psfs] == ["green", "red"]
    figures = dict(kept.provenance.figures)
    assert 0.98 < figures["psf_red_likeness"] < SAME_PSF_CORRELATION
    assert figures["psf_red_scale"] == pytest.approx(1, abs=1e-3)


def test_colours_that_make_the_same_psf_share_it(tmp_path: Path) -> None:
    kept, requested = calibrated(small_world(coarser=8), tmp_path, ("red", "green", "blue"))
    assert requested[-2:] == ["point red", "point blue"]
    assert [psf.colour for psf in kept.calibration.psfs] == [None]
    assert dict(kept.provenance.figures)["psf_blue_likeness"] > SAME_PSF_CORRELATION


@pytest.mark.parametrize(
    ("moved_px", "moved_mm", "seed", "words"),
    [((0, 3), 0.0, 1, "1.54 degrees beside"), ((0, 0), 4.0, 1, "stretched by -1.8"), ((0, 0), 0.0, 2, "another one")],
)
def test_a_source_that_moved_with_its_colour_is_refused(
    tmp_path: Path, moved_px: tuple[int, int], moved_mm: float, seed: int, words: str
) -> None:
    world = small_world(coarser=8)
    assert world.spec.sim is not None
    spec = world.spec.model_copy(update={"sim": world.spec.sim.model_copy(update={"seed": seed})})
    wrong = World(spec, world.clock)
    wrong.target = calibration_targets.point(wrong, E_PER_S, moved_px, moved_mm, "red")
    with pytest.raises(CalibrationRefused, match=words):
        calibrated(world, tmp_path, ("red",), wrong)
