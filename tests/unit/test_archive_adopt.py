"""Adoption of results by a store, in one process: pictures, and what is refused with a remedy."""

import json
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from device.clock import VirtualClock
from device.errors import SettingError
from device.values import ChannelUse
from services.archive.adopt import Adopted, adopt_results
from services.archive.content import software
from services.archive.plan import Plan, PlannedCalibration, PlannedCapture, PlanSettings
from services.archive.result import ResultFolder, Stored
from services.records.capture import RecordOrigin
from services.records.capture_store import CaptureStore
from services.records.device_identity import FILE
from tests.stored_captures import write_store

RAW = np.full((6, 8), 100, np.uint16)
NAMES = ("one", "two")
HERE, ELSEWHERE = "6f2b2c9e-0d5b-4a57-9a3c-0b8f3f0f7a11", "7f2b2c9e-0d5b-4a57-9a3c-0b8f3f0f7a12"


@pytest.fixture
def store(tmp_path: Path) -> Path:
    write_store(tmp_path / "store", RAW, "0123456789abcdef", NAMES, RecordOrigin(uuid=HERE))
    (tmp_path / "store" / FILE).write_text(json.dumps({"uuid": HERE, "serial": "1"}))
    return tmp_path / "store"


def planned(store: Path, name: str) -> PlannedCapture:
    with CaptureStore(store, reserve_bytes=0) as opened:
        files = opened.get(name).files
    place = store / "captures" / name
    return PlannedCapture(
        id=name,
        source=str(store),
        raw=str(place / "raw.tiff"),
        raw_sha256=files["raw.tiff"],
        calibration="c",
        result=name.encode().hex().ljust(32, "0"),
        dark=str(place / "dark.tiff"),
        dark_sha256=files["dark.tiff"],
        origin=HERE,
    )


def write_results(
    folder: Path, captures: list[PlannedCapture], without: tuple[str, ...] = (), simulated: bool = True
) -> Path:
    """Write a folder of results: a picture of 6 x 8 pixels whose field is 4 x 6, and one in colour."""
    plan = Plan(
        made_at="2026-01-01",
        sources=("a",),
        settings=PlanSettings(),
        software=software(),
        captures=tuple(captures),
        calibrations=(PlannedCalibration(digest="c", label="c", files=()),),
    )
    results, picture = ResultFolder(folder), np.arange(48, dtype=np.float32).reshape(6, 8) + 1
    folder.mkdir()
    results.prepare(plan)
    report = {"method": "variation", "channels": [asdict(ChannelUse("blue", None, predicted=True))]}
    document = {"report": report, "simulated": simulated, "field_px": [1, 5, 1, 7]}
    for capture in captures:
        if capture.id not in without:
            pictures = {"picture.tiff": encoded(picture), "colour.tiff": encoded(np.stack([picture[1:5, 1:7]] * 3, 2))}
            results.add(capture.result, pictures | {"report.json": json.dumps(document).encode(), "run.json": b"{}"})
    return folder


def encoded(picture: np.ndarray) -> bytes:
    out = BytesIO()
    tifffile.imwrite(out, picture, photometric="rgb" if picture.ndim == 3 else "minisblack")
    return out.getvalue()


def adopted(folder: Path, store: Path) -> Adopted:
    return adopt_results(folder, store, VirtualClock(), lambda _: None)


def test_the_field_of_each_result_becomes_a_picture_with_its_marks(store: Path, tmp_path: Path) -> None:
    captures = [planned(store, name) for name in NAMES]
    done = adopted(write_results(tmp_path / "out", captures, without=("two",)), store)
    assert done == Adopted(adopted=1, known=0, missing=1, refused=())
    with CaptureStore(store, reserve_bytes=0) as kept:
        (version,) = kept.get("one").report.versions
        assert version.result == captures[0].result
        picture, colour = (Image.open(BytesIO(kept.read("one", name))) for name in (version.picture, version.colour))
        assert (picture.size, picture.mode, colour.size, colour.mode) == ((6, 4), "L", (6, 4), "RGB")
        assert picture.info["simulated"] == "true"
        assert picture.info["note"] == "OD 2026-01-01, reconstructed again"
        assert colour.info["predicted"] == "blue"
        assert json.loads(kept.read("one", version.report))["report"]["method"] == "variation"
        assert kept.get("two").report.versions == ()
    assert adopted(tmp_path / "out", store) == Adopted(adopted=0, known=1, missing=1, refused=())


def test_a_result_that_does_not_say_which_colours_are_predicted_is_refused() -> None:
    whole, half = asdict(ChannelUse("blue", None, predicted=True)), {"name": "blue", "predicted": True}
    assert Stored({"report": {"method": "variation", "channels": [whole]}}, {}).predicted == ("blue",)
    with pytest.raises(SettingError, match="channels"):
        _ = Stored({"report": {"method": "variation", "channels": [half]}}, {}).predicted


def test_what_does_not_belong_to_the_store_is_refused_and_the_rest_adopted(store: Path, tmp_path: Path) -> None:
    first, second = (planned(store, name) for name in NAMES)
    captures = [
        first,
        second.model_copy(update={"raw_sha256": "0" * 64}),
        first.model_copy(update={"id": "three", "result": "3" * 32}),
        first.model_copy(update={"id": "four", "result": "4" * 32, "origin": ELSEWHERE}),
        first.model_copy(update={"result": "5" * 32, "origin": ELSEWHERE}),
    ]
    done = adopted(write_results(tmp_path / "out", captures), store)
    assert (done.adopted, [refusal.id for refusal in done.refused]) == (1, ["two", "three", "four", "one"])
    frames, unknown, foreign, of_another = (f"{refusal.reason}. {refusal.remedy}" for refusal in done.refused)
    assert "holds other frames" in frames
    assert "raw.tiff. Plan and run the archive again" in frames
    assert "no capture named 'three'. Give the store that holds it." in unknown
    assert "erased patient" in unknown
    assert f"device {ELSEWHERE}, and this store is that of {HERE}. Adopt it in the store of that device." in foreign
    assert f"by the device {HERE}, and the new picture by {ELSEWHERE}" in of_another
