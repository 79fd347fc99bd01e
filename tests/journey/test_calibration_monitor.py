"""Calibration monitor and calibration validity: five invalid calibrations, each with its code and remedy."""

import os
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from device.calibration.archive import CURRENT, Archive, Provenance
from device.clock import VirtualClock
from device.config.head_file import CalibrationTable, InstrumentSpec
from device.errors import CalibrationDamaged, CalibrationExpired, CalibrationModeMismatch, DiffuscopeError, FrameError
from device.head import Head, open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.values import Calibration, Psf
from services.http.problem_responses import problem_response
from services.imaging.picture_files import raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.instrument.calibration_monitor import exposures
from services.workshop.check_head import check_calibration, table
from tests.journey.conftest import Diffuscope
from tests.journey.faults import simulated_light

WEEK_S = 7 * 86400.0
CODES = {"age", "psf", "shift", "width", "hot pixels", "black level"}


def with_rotated_psf(calibration: Calibration) -> Calibration:
    """Return the calibration with the centre of its PSF rotated by 90 degrees."""
    return replace(calibration, psfs=(Psf(np.ascontiguousarray(_rotate_centre(calibration.psfs[0].pixels))),))


def activate(current: Path, at: datetime) -> None:
    current.parent.mkdir(exist_ok=True)
    current.touch()
    os.utime(current, (at.timestamp(), at.timestamp()))


def _rotate_centre(pixels: np.ndarray) -> np.ndarray:
    side = min(pixels.shape) // 2 - 1
    rows, cols = (size // 2 for size in pixels.shape)
    out = pixels.copy()
    middle = slice(rows - side, rows + side + 1), slice(cols - side, cols + side + 1)
    out[middle] = np.rot90(pixels[middle])
    return out


def health(rig: Any) -> dict[str, Any]:
    answer = rig.request("GET", "/api/health").json()
    return {check["name"]: check for check in answer["calibration"]} | {"ok": answer["ok"]}


def test_a_valid_calibration_is_checked_after_each_press_without_notice(
    rig: Any, wait_until: Callable[..., None]
) -> None:
    for _ in range(2):
        assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
    wait_until(lambda: not rig.exam.calibration_monitor.has_pending)
    found = health(rig)
    assert found["ok"]
    assert set(found) - {"ok"} == CODES - {"age"}  # the simulated calibration has no date
    assert all(check["ok"] for name, check in found.items() if name != "ok")
    assert rig.request("GET", "/api/status").json()["notices"] == []


def test_a_stale_calibration_is_refused_after_two_pictures_and_after_a_restart(
    make_rig: Any, wait_until: Callable[..., None], tmp_path: Path
) -> None:
    current = tmp_path / "archive" / CURRENT
    activate(current, VirtualClock().wall())

    def with_another_psf(head: Head) -> Head:
        spec = head.spec.model_copy(update={"calibration": CalibrationTable(archive=current.parent)})
        return replace(head, spec=spec, calibration=with_rotated_psf(head.calibration))

    rig = make_rig(head=with_another_psf)
    for _ in range(2):
        assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
        wait_until(lambda: not rig.exam.calibration_monitor.has_pending)
    refused = rig.request("POST", "/api/captures", json={"eye": "OD"})
    assert refused.status_code == 423
    assert refused.json()["code"] == "calibration.stale"
    assert "Calibrate" in refused.json()["remedy"]
    found = health(rig)
    assert not found["ok"]
    assert found["psf"]["value"] < 0.3
    assert found["psf"]["limit"] == 0.6
    assert len(rig.store.captures()) == 2
    assert rig.world.illumination is None
    assert ("calibration", True) in [(kind, "findings" in data) for kind, data in rig.published_events()]
    rig.exam.close()
    again = make_rig(head=with_another_psf)
    wait_until(lambda: not again.exam.calibration_monitor.has_pending)
    assert again.request("POST", "/api/captures", json={"eye": "OD"}).json()["code"] == "calibration.stale"
    again.exam.close()
    activate(current, VirtualClock().wall() + timedelta(days=1))  # a technician repaired the head and rolled back
    repaired = make_rig(head=with_another_psf)
    assert not repaired.exam.calibration_monitor.has_pending
    assert repaired.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201


@pytest.mark.parametrize(
    ("times", "eye"),
    [(1.0, {"pupil_um": 1500.0}), (1.0, {"pupil_um": 4000.0, "decentred_um": 2500.0}), (0.01, {"pupil_um": 1500.0})],
    ids=["small pupil", "half a picture", "dark"],
)
def test_pictures_without_a_whole_eye_say_nothing_about_the_head(
    rig: Any, wait_until: Callable[..., None], times: float, eye: dict[str, float]
) -> None:
    """A pupil that cuts the beam has another PSF: it scores 0.1 to 0.2 where a whole one scores 1.1."""
    with simulated_light(rig, times, eye=eye):
        for _ in range(3):
            assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
            wait_until(lambda: not rig.exam.calibration_monitor.has_pending)
    assert all(not capture.report.verdict.is_good for capture in rig.store.captures())
    found = health(rig)
    assert found["ok"]
    assert set(found) - {"ok"} == {"hot pixels", "black level"}, "the dark frames are judged, and nothing else"
    assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201


def test_an_ageing_calibration_gives_a_notice_then_an_error(make_rig: Any) -> None:
    made_at = VirtualClock().wall()
    known = Provenance("D-1", made_at, "a technician", "0.1.0")
    rig = make_rig(head=lambda head: replace(head, provenance=known))
    assert health(rig)["age"]["ok"]
    rig.clock.sleep(27 * WEEK_S)
    assert health(rig)["age"]["hint"]
    assert rig.request("GET", "/api/status").json()["standing"] == [{"code": "cal.old", "n": 27}]
    assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
    rig.clock.sleep(35 * WEEK_S)
    refused = rig.request("POST", "/api/captures", json={"eye": "OD"})
    assert (refused.status_code, refused.json()["code"]) == (423, "calibration.old")
    assert not health(rig)["ok"]


# Opening of a head


@pytest.fixture
def archived(spec: InstrumentSpec, template: Any, tmp_path: Path) -> tuple[InstrumentSpec, Archive]:
    """Return the specification of a small head with a calibration archive, and the archive."""
    world, calibration = template
    archive = Archive(tmp_path / "archive")
    archive.add_and_activate(calibration, Provenance("D-1", VirtualClock().wall(), "a technician", "0.1.0"))
    return world.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root)}), archive


def opened(spec: InstrumentSpec, weeks: float = 0.0) -> Head:
    clock = VirtualClock(elapsed_s=weeks * WEEK_S)
    return open_head(spec, clock, MemoryLedger(clock))


def refused_as(error: DiffuscopeError) -> tuple[int, str]:
    answer = problem_response(error)
    assert error.remedy.encode() in bytes(answer.body)
    return answer.status_code, error.code


def test_a_valid_calibration_opens_with_its_provenance(archived: Any) -> None:
    spec, archive = archived
    head = opened(spec)
    assert head.calibration.id == archive.active_id()
    assert head.provenance.serial == "D-1"
    assert opened(spec, weeks=30).calibration.id == head.calibration.id


def test_an_expired_calibration_is_refused_at_opening(archived: Any) -> None:
    with pytest.raises(CalibrationExpired) as caught:
        opened(archived[0], weeks=62)
    assert refused_as(caught.value) == (423, "calibration.old")


@pytest.mark.parametrize("changed", [{"rows": 134}, {"pitch_um": 20.16}, {"bit_depth": 10}, {"black_dn": 256.0}])
def test_a_calibration_of_another_sensor_mode_is_refused_at_opening(archived: Any, changed: dict[str, Any]) -> None:
    spec = archived[0]
    other = spec.model_copy(update={"camera": spec.camera.model_copy(update=changed)})
    with pytest.raises(CalibrationModeMismatch) as caught:
        opened(other)
    assert refused_as(caught.value) == (423, "calibration.mode")


def test_a_damaged_calibration_is_refused_at_opening(archived: Any) -> None:
    spec, archive = archived
    path = archive.root / archive.active_id() / "psf0.npy"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(CalibrationDamaged) as caught:
        opened(spec)
    assert refused_as(caught.value) == (423, "calibration.damaged")


def test_a_capture_without_exposure_time_is_no_evidence() -> None:
    """FrameError: the monitor then skips the capture."""
    data = raw_tiff(np.zeros((4, 4), np.uint16), RawMetadata(id="a"))
    store: Any = SimpleNamespace(read=lambda id, name: data)
    capture: Any = SimpleNamespace(id="a", taken_at=datetime.fromisoformat("2026-03-02T12:00:00+00:00"))
    with pytest.raises(FrameError, match="no exposure time"):
        exposures(store, capture)


# The command `diffuscope check`


def test_check_head_reads_the_stored_captures(make_rig: Any, wait_until: Callable[..., None], tmp_path: Path) -> None:
    archive = Archive(tmp_path / "archive")
    specs: list[InstrumentSpec] = []

    def with_another_psf(head: Head) -> Head:
        rotated, long_ago = with_rotated_psf(head.calibration), VirtualClock().wall() - timedelta(weeks=70)
        archive.add_and_activate(rotated, Provenance("D-1", long_ago, "a technician", "0.1.0"))
        activate(archive.root / CURRENT, VirtualClock().wall())
        specs.append(head.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root)}))
        return replace(head, spec=specs[0], calibration=rotated)

    rig = make_rig(head=with_another_psf)
    for _ in range(2):
        rig.exam.press("OD").result(30)
    wait_until(lambda: not rig.exam.calibration_monitor.has_pending)
    found = check_calibration(specs[0], rig.store.folder, rig.clock, [].append)
    assert (found.captures, found.darks) == (2, 0)
    assert {finding.name for finding in found.findings if finding.fails} == {"psf", "age"}
    lines = table(found).splitlines()
    assert lines[0].startswith("FAIL  age                  70 weeks  limit 61")
    assert lines[1] == f"      {CalibrationExpired.default_remedy}"


@pytest.fixture
def calibrated(diffuscope: Diffuscope, head_file: Path, tmp_path: Path) -> Path:
    """Return the file of a calibrated head; its exposure is a tenth, because the command runs in real time."""
    quick = head_file.read_text().replace("[camera]", "[camera]\nexposure_s = 0.01\npreview_exposure_s = 0.01")
    path = tmp_path / "head.toml"
    path.write_text(quick + '\n[calibration]\narchive = "calibrations"\n')
    done = diffuscope("calibrate", "--head", path, "--archive", tmp_path / "calibrations")
    assert done.returncode == 0, done.stderr
    return path


def test_the_check_command_prints_each_finding_and_sets_its_exit_status(
    diffuscope: Diffuscope, calibrated: Path, tmp_path: Path
) -> None:
    fitting = diffuscope("check", "--head", calibrated, "--data", tmp_path / "none")
    assert fitting.returncode == 0, fitting.stderr
    assert "taking dark frames now" in fitting.stderr
    lines = fitting.stdout.splitlines()
    assert [line.split()[0] for line in lines[1:5]] == ["ok"] * 4
    assert "black level" in fitting.stdout
    assert "Take a picture of an eye" in lines[-1]
    other = tmp_path / "other.toml"
    other.write_text(calibrated.read_text().replace("rows = 270", "rows = 272"))
    refused = diffuscope("check", "--head", other)
    assert refused.returncode == 2
    assert "270 x 480" in refused.stderr
    assert CalibrationModeMismatch.default_remedy in refused.stderr
    without_archive = diffuscope("check", "--head", "hardware/heads/sim.toml")
    assert without_archive.returncode == 2
    assert "--archive" in without_archive.stderr
