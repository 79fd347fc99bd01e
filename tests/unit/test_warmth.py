"""Dark steps at several temperatures make a law, and the law foretells the dark frame of another one."""

from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.calibration.archive import Archive
from device.calibration.procedure import Job, Operator, Procedure
from device.calibration.warmth import Dark, dark_dn_at, fitted_warmth
from device.sim import stage
from device.sim.camera import SimCamera
from device.sim.chips import SimThermometer
from device.sim.world import World
from device.values import Shot
from services.instrument.calibrating import staging
from tests.unit.test_measure import small_world


def calibrated(world: World, root: Path, warm_c: float, said: list[str], serial: str = "D-1") -> str:
    world.celsius = warm_c
    job, operator = Job(world.spec, serial, "a technician", "0.1.0"), Operator(staging(world), said.append)
    work = root / ".steps"
    return Procedure(job, SimCamera(world), operator, world.clock, work, SimThermometer(world)).run(Archive(root))


def test_the_law_of_three_calibrations_foretells_the_dark_better_than_the_nearest_of_them(tmp_path: Path) -> None:
    world, archive, said = small_world(coarser=8, dark_e_per_s=400.0, dark_doubling_c=6.5), Archive(tmp_path), []
    kept = {warm_c: archive.load(calibrated(world, tmp_path, warm_c, said)) for warm_c in (22.0, 25.0, 31.0)}
    figures = dict(kept[31.0].provenance.figures)
    assert figures["dark_doubling_c"] == pytest.approx(6.5, rel=0.03)
    assert figures["dark_25c_e_per_s"] == pytest.approx(400, rel=0.03)
    assert figures["dark_law_steps"] == 3
    assert "dark_doubling_c" not in dict(kept[22.0].provenance.figures)
    assert sum("twice that every" in line for line in said) == 2
    world.celsius, world.stage = 38.0, stage.cap(world)
    exposure_s = world.spec.camera.exposure_s
    seen = np.mean([SimCamera(world).expose(Shot(exposure_s)).counts.mean() for _ in range(8)])
    nearest, foretold = kept[31.0].calibration.dark_dn, dark_dn_at(kept[31.0], 38.0)
    assert nearest is not None
    assert foretold is not None
    assert abs(nearest.mean() - seen) > 5
    assert abs(foretold.mean() - seen) < 0.5
    assert dark_dn_at(kept[22.0], 38.0) is None


def test_another_heads_dark_steps_do_not_count(tmp_path: Path) -> None:
    world, said = small_world(coarser=8, dark_e_per_s=400.0), list[str]()
    for serial, warm_c in (("D-1", 22.0), ("D-2", 31.0)):
        calibrated(world, tmp_path, warm_c, said, serial)
    assert not any("twice that every" in line for line in said)


def test_a_law_that_is_not_silicons_is_told_and_not_kept(tmp_path: Path) -> None:
    world, said = small_world(coarser=8, dark_e_per_s=400.0, dark_doubling_c=60.0), list[str]()
    for warm_c in (22.0, 31.0):
        id = calibrated(world, tmp_path, warm_c, said)
    assert any("light leaks in" in line for line in said)
    assert "dark_doubling_c" not in dict(Archive(tmp_path).load(id).provenance.figures)


@given(st.floats(5, 9), st.floats(30, 1000), st.floats(10, 20), st.floats(23, 50))
def test_two_steps_tell_the_law(doubling_c: float, e_per_s: float, cold_c: float, warm_c: float) -> None:
    law = fitted_warmth(Dark(c, e_per_s * 2 ** ((c - 25) / doubling_c)) for c in (cold_c, warm_c))
    assert law is not None
    assert law.doubling_c == pytest.approx(doubling_c)
    assert law.at(warm_c + 5) == pytest.approx(e_per_s * 2 ** ((warm_c - 20) / doubling_c))
    assert law.is_plausible


@pytest.mark.parametrize(
    "darks", [[], [Dark(20, 5)], [Dark(20, 5), Dark(22, 6)], [Dark(20, 5), Dark(nan, 9)], [Dark(20, 0.1), Dark(30, 9)]]
)
def test_what_is_too_little_is_no_law(darks: list[Dark]) -> None:
    assert fitted_warmth(darks) is None
