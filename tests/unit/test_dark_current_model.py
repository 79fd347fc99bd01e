"""Tests of the dark-current model: fitted to dark steps at several temperatures, and used for another temperature."""

from math import nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.monitoring.dark_current_model import (
    REFERENCE_C,
    DarkCurrentModel,
    DarkStep,
    fit_dark_current,
)
from device.calibration.procedure.calibration_sequence import CalibrationJob, CalibrationSequence, Operator
from device.head import target_placer
from device.sim import calibration_targets
from device.sim.camera import SimCamera
from device.sim.chips import SimThermometer
from device.sim.world import World
from device.values import ExposureSettings, Image
from tests.unit.test_calibration_measurements import small_world


def e_per_s_at(model: DarkCurrentModel, temperature_c: float) -> float:
    """Return the dark current of a model at a temperature, electrons per second."""
    return model.reference_e_per_s * 2 ** ((temperature_c - REFERENCE_C) / model.doubling_c)


def dark_dn_at(kept: StoredCalibration, temperature_c: float) -> Image | None:
    """Return the dark frame at another temperature, (rows, cols), DN; None without a model, a dark frame or a gain."""
    figures = dict(kept.provenance.figures)
    sensor = kept.calibration.sensor
    dark_dn = kept.calibration.dark_dn
    if "dark_doubling_c" not in figures or dark_dn is None or sensor.gain_e_per_dn is None:
        return None
    model = DarkCurrentModel(figures["dark_25c_e_per_s"], figures["dark_doubling_c"], int(figures["dark_law_steps"]))
    more_e = (e_per_s_at(model, temperature_c) - e_per_s_at(model, figures["dark_c"])) * figures["dark_map_s"]
    return np.asarray(dark_dn + np.float32(more_e / sensor.gain_e_per_dn))


def calibrated(world: World, root: Path, temperature_c: float, messages: list[str], serial: str = "D-1") -> str:
    world.temperature_c = temperature_c
    job, operator = (
        CalibrationJob(world.spec, serial, "a technician", "0.1.0"),
        Operator(target_placer(world), messages.append),
    )
    work = root / ".steps"
    return CalibrationSequence(job, SimCamera(world), operator, world.clock, work, SimThermometer(world)).run(
        Archive(root)
    )


def test_a_model_of_three_calibrations_predicts_the_dark_better_than_the_nearest_of_them(tmp_path: Path) -> None:
    world, archive, messages = small_world(coarser=8, dark_e_per_s=400.0, dark_doubling_c=6.5), Archive(tmp_path), []
    kept = {
        temperature_c: archive.load(calibrated(world, tmp_path, temperature_c, messages))
        for temperature_c in (22.0, 25.0, 31.0)
    }
    figures = dict(kept[31.0].provenance.figures)
    assert figures["dark_doubling_c"] == pytest.approx(6.5, rel=0.03)
    assert figures["dark_25c_e_per_s"] == pytest.approx(400, rel=0.03)
    assert figures["dark_law_steps"] == 3
    assert "dark_doubling_c" not in dict(kept[22.0].provenance.figures)
    assert sum("twice that every" in line for line in messages) == 2
    world.temperature_c, world.target = 38.0, calibration_targets.cap(world)
    exposure_s = world.spec.camera.exposure_s
    seen = np.mean([SimCamera(world).expose(ExposureSettings(exposure_s)).counts.mean() for _ in range(8)])
    nearest, predicted = kept[31.0].calibration.dark_dn, dark_dn_at(kept[31.0], 38.0)
    assert nearest is not None
    assert predicted is not None
    assert abs(nearest.mean() - seen) > 5
    assert abs(predicted.mean() - seen) < 0.5
    assert dark_dn_at(kept[22.0], 38.0) is None


def test_another_heads_dark_steps_do_not_count(tmp_path: Path) -> None:
    world, messages = small_world(coarser=8, dark_e_per_s=400.0), list[str]()
    for serial, temperature_c in (("D-1", 22.0), ("D-2", 31.0)):
        calibrated(world, tmp_path, temperature_c, messages, serial)
    assert not any("twice that every" in line for line in messages)


def test_an_implausible_model_is_reported_and_not_stored(tmp_path: Path) -> None:
    world, messages = small_world(coarser=8, dark_e_per_s=400.0, dark_doubling_c=60.0), list[str]()
    for temperature_c in (22.0, 31.0):
        id = calibrated(world, tmp_path, temperature_c, messages)
    assert any("light leaks in" in line for line in messages)
    assert "dark_doubling_c" not in dict(Archive(tmp_path).load(id).provenance.figures)


@given(st.floats(5, 9), st.floats(30, 1000), st.floats(10, 20), st.floats(23, 50))
def test_two_dark_steps_define_the_model(doubling_c: float, e_per_s: float, cold_c: float, warm_c: float) -> None:
    model = fit_dark_current(DarkStep(c, e_per_s * 2 ** ((c - 25) / doubling_c)) for c in (cold_c, warm_c))
    assert model is not None
    assert model.doubling_c == pytest.approx(doubling_c)
    assert e_per_s_at(model, warm_c + 5) == pytest.approx(e_per_s * 2 ** ((warm_c - 20) / doubling_c))
    assert model.is_plausible


@pytest.mark.parametrize(
    "darks",
    [
        [],
        [DarkStep(20, 5)],
        [DarkStep(20, 5), DarkStep(22, 6)],
        [DarkStep(20, 5), DarkStep(nan, 9)],
        [DarkStep(20, 0.1), DarkStep(30, 9)],
    ],
)
def test_too_few_dark_steps_give_no_model(darks: list[DarkStep]) -> None:
    assert fit_dark_current(darks) is None
