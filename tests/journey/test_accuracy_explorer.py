"""Accuracy explorer: measurement in a subprocess, reconstruction by recipe, and the selected time budget."""

import threading
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import DiffuscopeError, SettingError
from device.recon.stage import Recipe
from device.sim.scene_files import simulate_exposure
from services.errors import Busy, RecordNotFound
from services.imaging.picture_files import raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.instrument.accuracy_explorer import (
    SCENE,
    SHIPPED_HEAD,
    AccuracyExplorer,
    StoredCapture,
    simulated_head,
)
from services.instrument.background import run_in_subprocess
from services.instrument.measured_frontier import MeasuredFrontier
from services.research.frontier import measure_scene
from tests.journey.conftest import SMALL_HEAD


def _exit_early(report: Any) -> None:
    report("going")
    raise SystemExit(3)


def _raise_refusal(word: str, report: Any) -> None:
    raise SettingError(f"{word} is not one", "Take another.")


def _measured_at_once(*arguments: Any) -> tuple[MeasuredFrontier, str]:
    arguments[-1]("timing")
    return MeasuredFrontier(scene="at once", budget_s=0.26, points=()), "<svg/>"


@pytest.fixture
def spec(tmp_path: Path) -> InstrumentSpec:
    head = tmp_path / "head.toml"
    head.write_text(SMALL_HEAD.replace("270", "68").replace("480", "120").replace("20.16", "80.64"))
    return load_head(head)


@pytest.fixture
def messages() -> list[str]:
    return []


@pytest.fixture
def explorer(tmp_path: Path, spec: InstrumentSpec, messages: list[str]) -> AccuracyExplorer:
    def publish(kind: str, progress: str) -> None:
        assert kind == "accuracy"
        messages.append(progress)

    return AccuracyExplorer(tmp_path / "accuracy", tmp_path / "plans", VirtualClock(), spec, publish, measure_scene)


def test_a_diffuscope_error_crosses_the_process_boundary_with_its_remedy() -> None:
    with pytest.raises(SettingError, match="blue is not one") as caught:
        run_in_subprocess(_raise_refusal, "blue", report=print)
    assert caught.value.remedy == "Take another."


def test_a_killed_subprocess_raises_an_error() -> None:
    received: list[str] = []
    with pytest.raises(DiffuscopeError, match="without a result"):
        run_in_subprocess(_exit_early, report=received.append)
    assert received == ["going"]


def test_a_measurement_uses_the_sensor_of_this_device_and_is_stored(
    explorer: AccuracyExplorer, messages: list[str], tmp_path: Path, spec: InstrumentSpec
) -> None:
    explorer.measure()
    with pytest.raises(Busy):
        explorer.measure()
    for thread in _threads("frontier"):
        thread.join(120)
    state = explorer.state()
    assert state.problem is None
    found = state.measured
    assert found is not None
    assert found.model_dump()["frame"] == {"rows": 68, "cols": 120}
    assert "Small simulated head" in found.scene
    assert (found.measured_at or "").startswith("2026-01-01")
    assert any(point.pareto for point in found.points)
    assert not state.shipped
    assert "Small simulated head" in explorer.plot()
    assert any("timing, turn" in message for message in messages)
    assert messages[-1] == ""
    again = AccuracyExplorer(
        tmp_path / "accuracy", tmp_path / "plans", VirtualClock(), spec, lambda kind, progress: None, measure_scene
    )
    assert again.state().measured == found


def test_the_simulated_head_shows_the_shipped_measurement_until_its_own(tmp_path: Path) -> None:
    spec = load_head(SHIPPED_HEAD)
    explorer = AccuracyExplorer(
        tmp_path / "own", tmp_path / "plans", VirtualClock(), spec, lambda kind, progress: None, _measured_at_once
    )
    before = explorer.state()
    assert before.measured is not None
    assert before.shipped
    assert before.measured.scene == simulated_head(spec, load_head(SCENE)).name, "write it again: make frontier"
    assert before.measured.model_dump()["machine"]["cpu"]
    assert before.measured.scene in explorer.plot()
    explorer.measure()
    for thread in _threads("frontier"):
        thread.join(60)
    after = explorer.state()
    assert after.measured is not None
    assert not after.shipped
    assert (after.measured.scene, explorer.plot()) == ("at once", "<svg/>")


def test_another_head_has_no_measurement_before_its_own(explorer: AccuracyExplorer) -> None:
    assert explorer.state().measured is None
    with pytest.raises(RecordNotFound):
        explorer.plot()


def test_a_capture_is_reconstructed_by_another_method_and_marked_as_simulated(
    explorer: AccuracyExplorer, spec: InstrumentSpec, messages: list[str]
) -> None:
    scene = simulate_exposure(spec)
    raw = raw_tiff(scene.counts, RawMetadata())
    dark = raw_tiff(np.full_like(scene.counts, 64), RawMetadata())
    kept = StoredCapture(raw, dark, scene.calibration, simulated=True)
    picture = Image.open(BytesIO(explorer.reconstruct(kept, Recipe("gradient", 1))))
    assert picture.info["simulated"] == "true"
    assert np.asarray(picture).std() > 10
    assert messages == ["making plans", "computing", ""]
    with pytest.raises(SettingError, match="no method guess"):
        explorer.reconstruct(kept, Recipe("guess", 1))


def test_the_selected_time_budget_is_stored(explorer: AccuracyExplorer, tmp_path: Path, spec: InstrumentSpec) -> None:
    assert (explorer.pace, explorer.budget_s) == ("standard", 5.0)
    explorer.choose("grey")
    again = AccuracyExplorer(
        tmp_path / "accuracy", tmp_path / "plans", VirtualClock(), spec, lambda kind, progress: None, measure_scene
    )
    assert (again.pace, again.budget_s) == ("grey", 0.26)
    (tmp_path / "accuracy" / "choice.json").write_bytes(b"{half a fi")
    assert again.pace == "standard"


def test_a_recording_without_optics_is_measured_on_the_default_scene(spec: InstrumentSpec) -> None:
    without_optics = spec.model_copy(update={"optics": None})
    assert simulated_head(without_optics, spec) is spec


def _threads(name: str) -> list[Any]:
    return [thread for thread in threading.enumerate() if thread.name == name]
