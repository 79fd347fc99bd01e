"""A moved point source says what one dioptre does to this head's PSF; whatever else moved is refused with a number."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.calibration.archive import Archive
from device.calibration.dioptres import Stretch, measured_dioptres, refuse_other_place, sphere_dpt, stretch
from device.calibration.procedure import MOVES, Job, Operator, Procedure, Stand
from device.clock import VirtualClock
from device.errors import CalibrationRefused
from device.recon.warp import warped
from device.sim import stage
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Psf
from services.instrument.calibrating import staging
from tests.scenes import GEOMETRY, speckle
from tests.unit.test_measure import FLAWS, small_world

E_PER_S = 160_000.0
OTHER_OPTICS = {"diffuser_to_sensor_um": 8000.0, "angular_magnification": 0.6, "iris_um": 2600.0}
SHALLOW = {"diffuser_to_sensor_um": 6600.0}  # a head whose diffuser sits 10 % farther than its drawings say


class Rail:
    """A bench on which the source is moved; `wrong` stands elsewhere than asked, where it says so."""

    def __init__(self, root: Path, built: dict[str, float] | None = None, **flaws: Any) -> None:
        world = small_world(**flaws)
        self.spec = world.spec
        optics = world.spec.optics
        assert optics is not None
        self.world = World(
            world.spec.model_copy(update={"optics": optics.model_copy(update=built or {})}), VirtualClock()
        )
        self.archive, self.work = Archive(root / "archive"), root / "archive" / ".steps"
        self.asked: list[Stand] = []
        self.said: list[str] = []
        self.wrong: dict[Stand, Callable[[World], None]] = {}

    def put(self, stand: Stand) -> None:
        self.asked.append(stand)
        staging(self.world)(stand)
        if stand in self.wrong:
            self.wrong[stand](self.world)

    def run(self) -> str:
        self.asked.clear()
        job = Job(self.spec, "D-1", "a technician", "0.1.0", dioptres=True)
        operator = Operator(self.put, self.said.append)
        return Procedure(job, SimCamera(self.world), operator, self.world.clock, self.work).run(self.archive)


def at(moved_mm: float, moved_px: tuple[int, int] = (0, 0)) -> Callable[[World], None]:
    def put(world: World) -> None:
        world.stage = stage.point(world, E_PER_S, moved_px, moved_mm)

    return put


def power_cut(world: World) -> None:
    raise KeyboardInterrupt


def test_the_factor_of_a_head_is_found_within_one_percent(tmp_path: Path) -> None:
    """Of the paper's geometry: `python -m tests.bench calibration`."""
    rail = Rail(tmp_path, OTHER_OPTICS, **FLAWS)
    rail.spec = rail.world.spec
    kept = rail.archive.load(rail.run())
    assert rail.asked == ["cap", "screen", "point", *MOVES]
    found, truth = kept.calibration.geometry, rail.world.geometry
    assert found is not None
    assert found.measured_scale_per_dpt == pytest.approx(truth.nominal_scale_per_dpt, rel=0.01)
    assert found.scale_per_dpt == found.measured_scale_per_dpt == dict(kept.provenance.figures)["scale_per_dpt"]
    assert not rail.work.exists()


def test_a_head_that_is_not_built_as_drawn_is_measured_as_built(tmp_path: Path) -> None:
    rail = Rail(tmp_path, SHALLOW)
    kept = rail.archive.load(rail.run()).calibration
    assert kept.geometry is not None
    assert kept.geometry.nominal_scale_per_dpt == pytest.approx(0.003375)
    assert kept.geometry.scale_per_dpt == pytest.approx(0.003375 * 1.1, rel=0.01)


@pytest.mark.parametrize(
    ("stand", "fault", "words"),
    [
        ("point -4 mm", at(0.0), "moved too little"),
        ("point -4 mm", at(4.0), "the other way"),
        ("point -2 mm", at(-4.0), "moved too far"),
        ("point +2 mm", at(2.0, (0, 2)), "sideways by 1.0"),
        ("point +4 mm", at(3.6), "beside the line"),
        ("point +4 mm", lambda world: staging(world)("cap"), "too dark"),
    ],
)
def test_a_source_that_stands_elsewhere_is_refused_and_asked_for_again(
    tmp_path: Path, stand: Stand, fault: Callable[[World], None], words: str
) -> None:
    rail = Rail(tmp_path, coarser=8)
    rail.wrong[stand] = power_cut
    with pytest.raises(KeyboardInterrupt):
        rail.run()
    rail.wrong[stand] = fault
    with pytest.raises(CalibrationRefused, match=words) as told:
        rail.run()
    assert rail.asked[0] == stand, "the steps before the power cut are kept"
    assert any(digit.isdigit() for digit in told.value.message)
    assert not rail.archive.ids()
    rail.wrong.clear()
    if words == "beside the line":  # nobody knows which of the places is the wrong one
        rail.run()
        assert rail.asked == list(MOVES)


@settings(max_examples=25)
@given(st.floats(-0.06, 0.06), st.tuples(st.integers(-3, 3), st.integers(-3, 3)))
def test_a_stretch_is_found_again(by: float, moved_px: tuple[int, int]) -> None:
    """At half the pixels' own fineness; the other is made by recon's own warp, which shares no code."""
    psf = Psf(speckle((120, 128), grain_px=2.0))
    other = warped(psf, (1 + by) * np.eye(2))
    found = stretch(psf, Psf(np.roll(other.pixels, moved_px, (0, 1))), pitch_um=10.0)
    assert found.scale - 1 == pytest.approx(by, abs=3e-4)
    assert found.moved_px == pytest.approx(moved_px, abs=0.05)
    assert found.likeness > 0.99


def test_another_source_is_no_stretch_of_the_first() -> None:
    found = stretch(Psf(speckle((120, 128), 1, 2.0)), Psf(speckle((120, 128), 2, 2.0)), 10.0)
    with pytest.raises(CalibrationRefused, match="correlation 0"):
        refuse_other_place(found, 2.0, 25.0, GEOMETRY)
    refuse_other_place(Stretch(1 - 0.003375 * sphere_dpt(2.0, 25.0), (0.0, 0.0), 0.99), 2.0, 25.0, GEOMETRY)


def test_the_papers_steps_of_the_screen() -> None:
    """-5.5 and +7.6 dpt of spectacle correction at +-4 mm (paper, "Refractive error"); M has the other sign."""
    assert sphere_dpt(4, 25) == pytest.approx(5.517, abs=1e-3)
    assert sphere_dpt(-4, 25) == pytest.approx(-7.619, abs=1e-3)


def test_one_place_makes_no_line() -> None:
    with pytest.raises(CalibrationRefused, match="1 places"):
        measured_dioptres({2.0: 0.99}, 25.0)
