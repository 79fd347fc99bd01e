"""The point source in other colours: a PSF of its own where it differs, and where the source was moved a refusal."""

from pathlib import Path

import pytest

from device.calibration.archive import Archive, Kept
from device.calibration.colours import SAME
from device.calibration.procedure import Job, Operator, Procedure, Stand
from device.clock import VirtualClock
from device.errors import CalibrationRefused
from device.sim import stage
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Colour
from services.instrument.calibrating import staging
from tests.unit.test_measure import E_PER_S, small_world


def narrow_world() -> World:
    """Half of the paper's iris and a sensor to match, with pixels of 10 um: fine enough to tell colours apart."""
    spec = small_world(coarser=2).spec
    assert spec.optics is not None
    camera = spec.camera.model_copy(update={"rows": 270, "cols": 270})
    optics = spec.optics.model_copy(update={"iris_um": 1600.0, "field_deg": 15.0})
    return World(spec.model_copy(update={"camera": camera, "optics": optics}), VirtualClock())


def calibrated(
    world: World, root: Path, colours: tuple[Colour, ...], wrong: World | None = None
) -> tuple[Kept, list[Stand]]:
    asked: list[Stand] = []

    def put(stand: Stand) -> None:
        asked.append(stand)
        staging(world)(stand)
        if wrong is not None and stand == "point red":
            world.stage = wrong.stage

    job = Job(world.spec, "D-1", "a technician", "0.1.0", colours=colours)
    procedure = Procedure(job, SimCamera(world), Operator(put, lambda line: None), world.clock, root / ".steps")
    id = procedure.run(Archive(root))
    assert asked == list(job.stands)
    return Archive(root).load(id), asked


def test_a_psf_that_differs_by_its_colour_is_kept_beside_the_pictures(tmp_path: Path) -> None:
    world = narrow_world()
    kept, asked = calibrated(world, tmp_path, ("green", "red"))
    assert asked[-1] == "point red"
    assert [psf.colour for psf in kept.calibration.psfs] == ["green", "red"]
    figures = dict(kept.provenance.figures)
    assert 0.98 < figures["psf_red_likeness"] < SAME
    assert figures["psf_red_scale"] == pytest.approx(1, abs=1e-3)


def test_colours_that_make_the_same_psf_share_it(tmp_path: Path) -> None:
    kept, asked = calibrated(small_world(coarser=8), tmp_path, ("red", "green", "blue"))
    assert asked[-2:] == ["point red", "point blue"]
    assert [psf.colour for psf in kept.calibration.psfs] == [None]
    assert dict(kept.provenance.figures)["psf_blue_likeness"] > SAME


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
    wrong.stage = stage.point(wrong, E_PER_S, moved_px, moved_mm, "red")
    with pytest.raises(CalibrationRefused, match=words):
        calibrated(world, tmp_path, ("red",), wrong)
