"""Accuracy against time on this device, as a technician asks for it: measured apart, looked at, chosen."""

import threading
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.clock import VirtualClock
from device.errors import Busy, DiffuscopeError, SettingError
from device.recon.reconstructor import Recipe
from device.sim.staged import staged
from device.spec import InstrumentSpec, load_head
from services.instrument.apart import apart
from services.instrument.explorer import Explorer, Kept, like
from services.records.picture import raw_tiff
from tests.journey.conftest import SMALL_HEAD


def _dies(say: Any) -> None:
    say("going")
    raise SystemExit(3)


def _refuses(word: str, say: Any) -> None:
    raise SettingError(f"{word} is not one", "Take another.")


@pytest.fixture
def spec(tmp_path: Path) -> InstrumentSpec:
    head = tmp_path / "head.toml"
    head.write_text(SMALL_HEAD.replace("270", "68").replace("480", "120").replace("20.16", "80.64"))
    return load_head(head)


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def explorer(tmp_path: Path, spec: InstrumentSpec, told: list[str]) -> Explorer:
    def tell(kind: str, said: str) -> None:
        assert kind == "explorer"
        told.append(said)

    return Explorer(tmp_path / "explorer", tmp_path / "plans", VirtualClock(), spec, tell)


def test_an_error_of_ours_comes_back_from_another_process_with_its_remedy() -> None:
    with pytest.raises(SettingError, match="blue is not one") as caught:
        apart(_refuses, "blue", say=print)
    assert caught.value.remedy == "Take another."


def test_a_process_that_dies_is_an_error_and_not_a_wait_without_end() -> None:
    said: list[str] = []
    with pytest.raises(DiffuscopeError, match="without a result"):
        apart(_dies, say=said.append)
    assert said == ["going"]


def test_a_measurement_is_of_this_devices_own_pixels_and_is_still_there_afterwards(
    explorer: Explorer, told: list[str], tmp_path: Path, spec: InstrumentSpec
) -> None:
    explorer.measure()
    with pytest.raises(Busy):
        explorer.measure()
    for thread in _threads("frontier"):
        thread.join(120)
    state = explorer.state()
    assert state["problem"] is None
    found = state["measured"]
    assert found["frame"] == {"rows": 68, "cols": 120}
    assert "Small simulated head" in found["scene"]
    assert found["measured_at"].startswith("2026-01-01")
    assert any(point["pareto"] for point in found["points"])
    assert any("timing, turn" in said for said in told)
    assert told[-1] == ""
    again = Explorer(tmp_path / "explorer", tmp_path / "plans", VirtualClock(), spec, lambda kind, said: None)
    assert again.state()["measured"] == found


def test_a_capture_is_made_again_by_another_method_and_says_that_it_is_simulated(
    explorer: Explorer, spec: InstrumentSpec
) -> None:
    scene = staged(spec)
    raw, dark = raw_tiff(scene.counts, {}), raw_tiff(np.full_like(scene.counts, 64), {})
    kept = Kept(raw, dark, scene.calibration, simulated=True)
    picture = Image.open(BytesIO(explorer.picture(kept, Recipe("gradient", 1))))
    assert picture.text["simulated"] == "true"
    assert np.asarray(picture).std() > 10
    with pytest.raises(SettingError, match="no method guess"):
        explorer.picture(kept, Recipe("guess", 1))


def test_what_was_chosen_is_kept_and_is_a_time(explorer: Explorer, tmp_path: Path, spec: InstrumentSpec) -> None:
    assert (explorer.pace, explorer.budget_s) == ("standard", 5.0)
    explorer.choose("best")
    again = Explorer(tmp_path / "explorer", tmp_path / "plans", VirtualClock(), spec, lambda kind, said: None)
    assert (again.pace, again.budget_s) == ("best", 30.0)
    (tmp_path / "explorer" / "choice.json").write_bytes(b"{half a fi")
    assert again.pace == "standard"


def test_a_recording_whose_optics_nobody_knows_is_measured_on_the_scene_itself(spec: InstrumentSpec) -> None:
    unknown = spec.model_copy(update={"optics": None})
    assert like(unknown, spec) is spec


def _threads(name: str) -> list[Any]:
    return [thread for thread in threading.enumerate() if thread.name == name]
