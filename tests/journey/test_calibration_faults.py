"""`diffuscope calibrate` with an injected fault at a step: refusal with a number, calibration in force unchanged."""

import re
from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import CalibrationRefused, SettingError
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate
from tests.journey.conftest import SMALL_HEAD, Diffuscope

SMALL = (
    SMALL_HEAD.replace("rows = 270", "rows = 136")
    .replace("cols = 480", "cols = 240")
    .replace("20.16", "40.32")
    .replace("haemorrhages = 3", 'kind = "point"')
    + "\n[sim.sensor]\nprnu = 0.01\ndsnu_e = 2.0\n"
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, InstrumentSpec]:
    path = tmp_path_factory.mktemp("mishaps") / "head.toml"
    path.write_text(SMALL)
    return path, load_head(path)


def calibrate_with_faults(spec: InstrumentSpec, archive: Path, **mishaps: str) -> list[str]:
    """Run a calibration with injected faults by stand; return its progress messages."""
    messages: list[str] = []
    clock = VirtualClock()
    clock.sleep(len(list(archive.glob("*"))))  # another time gives another calibration id
    calibrate(
        spec, CalibrationRequest(archive, None, "Ada", None, faults=mishaps), clock, messages.append, messages.append
    )
    return messages


@pytest.fixture(scope="module")
def before(small: tuple[Path, InstrumentSpec], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive with one calibration in force."""
    archive = tmp_path_factory.mktemp("before") / "archive"
    calibrate_with_faults(small[1], archive)
    return archive


@pytest.mark.parametrize(
    ("stand", "mishap", "words"),
    [
        ("cap", "lamp on", "the lamp was on in frame 1: green at 1"),
        ("cap", "cap off", r"the dark frames are bright: \d+ of 4095 DN"),
        ("cap", "other mode", r"frame 1 is \(68, 120\), this head gives \(136, 240\)"),
        ("screen", "cap on", r"it is dark: -?\d+ DN in 3 s \(at least 81\)"),
        ("screen", "lamp on", "the lamp was on in frame"),
        ("screen", "finger", r"one part of the flat differs by \d+\.\d% from its surroundings"),
        ("screen", "other mode", r"is \(68, 120\), this head gives"),
        ("point", "too bright", r"\d"),
        ("point", "too dark", r"the point source is too dark: \d+ DN at 0.6 s \(at least \d+\)"),
        ("point", "moving", r"the point source has moved by 1\.0 pixels by frame \d+"),
        ("point", "cap on", r"the point source is too dark: -?\d+ DN"),
        ("point", "other mode", r"is \(68, 120\), this head gives"),
    ],
)
def test_an_injected_fault_is_refused_with_a_number_and_changes_nothing(
    small: tuple[Path, InstrumentSpec], before: Path, stand: str, mishap: str, words: str
) -> None:
    archive = Archive(before)
    old, kept = archive.active_id(), {path.name for path in (before / ".steps").glob("*.npz")}
    with pytest.raises(CalibrationRefused, match=words) as caught:
        calibrate_with_faults(small[1], before, **{stand: mishap})
    assert re.search(r"\d", caught.value.message)
    assert len(caught.value.remedy) > 20
    assert archive.active_id() == old
    assert len(archive.ids()) == 1
    assert {path.name for path in (before / ".steps").glob("*.npz")} >= kept  # earlier steps stay on disk


def test_the_calibrate_command_resumes_after_a_fault(
    diffuscope: Diffuscope, small: tuple[Path, InstrumentSpec], tmp_path: Path
) -> None:
    quick = tmp_path / "head.toml"  # a tenth of the exposure: the command runs in real time
    quick.write_text(small[0].read_text().replace("[camera]", "[camera]\nexposure_s = 0.01\npreview_exposure_s = 0.01"))
    words = ("calibrate", "--head", quick, "--archive", tmp_path / "archive")
    failed = diffuscope(*words, "--mishap", "point=moving")
    assert failed.returncode == 2
    assert failed.stdout.splitlines() == ["darks: done", "flats: done"]
    assert "error: the point source has moved by 1.0 pixels" in failed.stderr
    assert "Fix source and head to one table" in failed.stderr
    done = diffuscope(*words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[:2] == [
        "darks: measured before, taken up again",
        "flats: measured before, taken up again",
    ]


@pytest.mark.parametrize(("stand", "mishap"), [("eye", "moving"), ("cap", "rain"), ("cap", "")])
def test_an_unknown_fault_is_refused_with_the_list_of_faults(
    small: tuple[Path, InstrumentSpec], tmp_path: Path, stand: str, mishap: str
) -> None:
    with pytest.raises(SettingError) as caught:
        calibrate_with_faults(small[1], tmp_path / "archive", **{stand: mishap})
    assert "Choose from" in caught.value.remedy
