"""Tests of the dioptre step: scale per dioptre from a moved point source, and refusal of other movements."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.calibration.procedure.calibration_sequence import (
    AXIAL_OFFSETS_MM,
    CalibrationJob,
    CalibrationTarget,
)
from device.calibration.procedure.dioptres import (
    PsfSimilarity,
    fit_dioptre_scale,
    fit_similarity,
    mean_sphere_dpt,
    refuse_wrong_position,
)
from device.clock import VirtualClock
from device.errors import CalibrationRefused
from device.head import target_placer
from device.recon.estimation.psf_warp import warped
from device.sim import calibration_targets
from device.sim.world import World
from device.values import Psf
from tests.scenes import GEOMETRY, speckle
from tests.unit.test_calibration_measurements import FLAWS, small_world
from tests.unit.test_calibration_sequence import CalibrationBench

E_PER_S = 160_000.0
OTHER_OPTICS = {"diffuser_to_sensor_um": 8000.0, "angular_magnification": 0.6, "iris_um": 2600.0}
SHALLOW = {
    "diffuser_to_sensor_um": 6600.0
}  # a head whose diffuser is 10 % farther from the sensor than in its drawings


class Rail(CalibrationBench):
    """Bench on which the source is moved; the light path of the world may differ from the drawings by `built`."""

    def __init__(self, root: Path, built: dict[str, float] | None = None, **flaws: Any) -> None:
        spec = small_world(**flaws).spec
        optics = spec.optics
        assert optics is not None
        moved = spec.model_copy(update={"optics": optics.model_copy(update=built or {})})
        super().__init__(root, World(moved, VirtualClock()))
        self.spec, self.work = spec, root / "archive" / ".steps"

    def run(self) -> str:
        return self.calibrate(CalibrationJob(self.spec, "D-1", "a technician", "0.1.0", dioptres=True))


def at(moved_mm: float, moved_px: tuple[int, int] = (0, 0)) -> Callable[[World], None]:
    def put(world: World) -> None:
        world.target = calibration_targets.point(world, E_PER_S, moved_px, moved_mm)

    return put


def power_cut(world: World) -> None:
    raise KeyboardInterrupt


def test_the_factor_of_a_head_is_found_within_one_percent(tmp_path: Path) -> None:
    """For another geometry than the paper's; the paper's is in `python -m tests.bench calibration`."""
    rail = Rail(tmp_path, OTHER_OPTICS, **FLAWS)
    rail.spec = rail.world.spec
    kept = rail.archive.load(rail.run())
    assert rail.requested == ["cap", "screen", "point", *AXIAL_OFFSETS_MM]
    found, truth = kept.calibration.geometry, rail.world.geometry
    assert found is not None
    assert found.measured_scale_per_dpt == pytest.approx(truth.nominal_scale_per_dpt, rel=0.01)
    assert found.scale_per_dpt == found.measured_scale_per_dpt == dict(kept.provenance.figures)["scale_per_dpt"]
    assert not rail.work.exists()


def test_a_head_that_differs_from_its_drawings_is_measured_as_built(tmp_path: Path) -> None:
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
        ("point +4 mm", lambda world: target_placer(world)("cap"), "too dark"),
    ],
)
def test_a_source_at_a_wrong_position_is_refused_and_requested_again(
    tmp_path: Path, stand: CalibrationTarget, fault: Callable[[World], None], words: str
) -> None:
    rail = Rail(tmp_path, coarser=8)
    rail.wrong[stand] = power_cut
    with pytest.raises(KeyboardInterrupt):
        rail.run()
    rail.wrong[stand] = fault
    with pytest.raises(CalibrationRefused, match=words) as caught:
        rail.run()
    assert rail.requested[0] == stand, "the steps before the power cut are kept"
    assert any(digit.isdigit() for digit in caught.value.message)
    assert not rail.archive.ids()
    rail.wrong.clear()
    if words == "beside the line":  # the wrong position is unknown
        rail.run()
        assert rail.requested == list(AXIAL_OFFSETS_MM)


@settings(max_examples=25)
@given(st.floats(-0.06, 0.06), st.tuples(st.integers(-3, 3), st.integers(-3, 3)))
def test_a_known_scale_and_shift_are_recovered(by: float, moved_px: tuple[int, int]) -> None:
    """At half the pixel pitch; the second PSF is made by recon's own warp, which shares no code."""
    psf = Psf(speckle((120, 128), grain_px=2.0))
    other = warped(psf, (1 + by) * np.eye(2))
    found = fit_similarity(psf, Psf(np.roll(other.pixels, moved_px, (0, 1))), pitch_um=10.0)
    assert found.scale - 1 == pytest.approx(by, abs=3e-4)
    assert found.moved_px == pytest.approx(moved_px, abs=0.05)
    assert found.correlation > 0.99


def test_another_source_is_refused_by_its_correlation() -> None:
    found = fit_similarity(Psf(speckle((120, 128), 1, 2.0)), Psf(speckle((120, 128), 2, 2.0)), 10.0)
    with pytest.raises(CalibrationRefused, match="correlation 0"):
        refuse_wrong_position(found, 2.0, 25.0, GEOMETRY)
    refuse_wrong_position(
        PsfSimilarity(1 - 0.003375 * mean_sphere_dpt(2.0, 25.0), (0.0, 0.0), 0.99), 2.0, 25.0, GEOMETRY
    )


def test_sphere_matches_the_screen_positions_of_the_paper() -> None:
    """-5.5 and +7.6 dpt of spectacle correction at +-4 mm (paper, "Refractive error"); M has the other sign."""
    assert mean_sphere_dpt(4, 25) == pytest.approx(5.517, abs=1e-3)
    assert mean_sphere_dpt(-4, 25) == pytest.approx(-7.619, abs=1e-3)


def test_a_single_position_is_refused() -> None:
    with pytest.raises(CalibrationRefused, match="1 places"):
        fit_dioptre_scale({2.0: 0.99}, 25.0)
