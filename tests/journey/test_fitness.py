"""Five ways in which a calibration does not fit, each from the head or the button to its code and its remedy."""

import os
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device.calibration.archive import CURRENT, Archive, Provenance
from device.clock import VirtualClock
from device.errors import CalibrationDamaged, CalibrationOld, CalibrationOtherMode, DiffuscopeError
from device.head import Head, open_head
from device.ledger import MemoryLedger
from device.spec import CalibrationTable, InstrumentSpec
from device.values import Calibration, Psf
from services.instrument.api import refusal
from services.instrument.checking import checked, table
from tests.journey.conftest import Diffuscope

WEEK_S = 7 * 86400.0
CODES = {"age", "psf", "shift", "width", "hot pixels", "black level"}


def turned(calibration: Calibration) -> Calibration:
    """A PSF as it was before the diffuser had turned by a quarter."""
    return replace(calibration, psfs=(Psf(np.ascontiguousarray(_quarter(calibration.psfs[0].pixels))),))


def put_in_force(current: Path, at: datetime) -> None:
    current.parent.mkdir(exist_ok=True)
    current.touch()
    os.utime(current, (at.timestamp(), at.timestamp()))


def _quarter(pixels: np.ndarray) -> np.ndarray:
    side = min(pixels.shape) // 2 - 1
    rows, cols = (size // 2 for size in pixels.shape)
    out = pixels.copy()
    middle = slice(rows - side, rows + side + 1), slice(cols - side, cols + side + 1)
    out[middle] = np.rot90(pixels[middle])
    return out


def health(rig: Any) -> dict[str, Any]:
    answer = rig.request("GET", "/api/health").json()
    return {one["name"]: one for one in answer["calibration"]} | {"ok": answer["ok"]}


def test_a_good_head_is_looked_at_after_each_press_and_goes_on(rig: Any, wait_until: Callable[..., None]) -> None:
    for _ in range(2):
        assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
    wait_until(lambda: not rig.exam.fitness.due)
    found = health(rig)
    assert found["ok"]
    assert set(found) - {"ok"} == CODES - {"age"}  # the simulated calibration was never made
    assert all(one["ok"] for name, one in found.items() if name != "ok")
    assert rig.request("GET", "/api/status").json()["notices"] == []


def test_a_stale_calibration_is_refused_after_two_pictures_and_after_a_restart(
    make_rig: Any, wait_until: Callable[..., None], tmp_path: Path
) -> None:
    current = tmp_path / "archive" / CURRENT
    put_in_force(current, VirtualClock().wall())

    def with_another_psf(head: Head) -> Head:
        spec = head.spec.model_copy(update={"calibration": CalibrationTable(archive=current.parent)})
        return replace(head, spec=spec, calibration=turned(head.calibration))

    rig = make_rig(head=with_another_psf)
    for _ in range(2):
        assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
        wait_until(lambda: not rig.exam.fitness.due)
    refused = rig.request("POST", "/api/captures", json={"eye": "OD"})
    assert refused.status_code == 423
    assert refused.json()["code"] == "calibration.stale"
    assert "Calibrate" in refused.json()["remedy"]
    found = health(rig)
    assert not found["ok"]
    assert found["psf"]["value"] < 0.3
    assert found["psf"]["limit"] == 0.6
    assert len(rig.store.captures()) == 2
    assert rig.world.glow is None
    assert ("calibration", True) in [(kind, "findings" in data) for kind, data in rig.told()]
    rig.exam.close()
    again = make_rig(head=with_another_psf)
    wait_until(lambda: not again.exam.fitness.due)
    assert again.request("POST", "/api/captures", json={"eye": "OD"}).json()["code"] == "calibration.stale"
    again.exam.close()
    put_in_force(current, VirtualClock().wall() + timedelta(days=1))  # somebody repaired the head, and went back to it
    repaired = make_rig(head=with_another_psf)
    assert not repaired.exam.fitness.due
    assert repaired.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201


def test_a_calibration_that_grows_old_while_the_instrument_runs_is_a_notice_then_an_error(make_rig: Any) -> None:
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


# At the opening of a head


@pytest.fixture
def archived(spec: InstrumentSpec, template: Any, tmp_path: Path) -> tuple[InstrumentSpec, Archive]:
    """A small head whose file names an archive with its calibration."""
    world, calibration = template
    archive = Archive(tmp_path / "archive")
    archive.keep(calibration, Provenance("D-1", VirtualClock().wall(), "a technician", "0.1.0"))
    return world.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root)}), archive


def opened(spec: InstrumentSpec, weeks: float = 0.0) -> Head:
    clock = VirtualClock(elapsed_s=weeks * WEEK_S)
    return open_head(spec, clock, MemoryLedger(clock))


def refused_as(error: DiffuscopeError) -> tuple[int, str]:
    answer = refusal(error)
    assert error.remedy.encode() in bytes(answer.body)
    return answer.status_code, error.code


def test_a_fitting_calibration_opens_and_the_head_knows_where_it_comes_from(archived: Any) -> None:
    spec, archive = archived
    head = opened(spec)
    assert head.calibration.id == archive.current()
    assert head.provenance.serial == "D-1"
    assert opened(spec, weeks=30).calibration.id == head.calibration.id


def test_an_old_one_does_not_open(archived: Any) -> None:
    with pytest.raises(CalibrationOld) as caught:
        opened(archived[0], weeks=62)
    assert refused_as(caught.value) == (423, "calibration.old")


@pytest.mark.parametrize("changed", [{"rows": 134}, {"pitch_um": 20.16}, {"bit_depth": 10}, {"black_dn": 256.0}])
def test_one_of_another_mode_does_not_open(archived: Any, changed: dict[str, Any]) -> None:
    spec = archived[0]
    other = spec.model_copy(update={"camera": spec.camera.model_copy(update=changed)})
    with pytest.raises(CalibrationOtherMode) as caught:
        opened(other)
    assert refused_as(caught.value) == (423, "calibration.mode")


def test_a_damaged_one_does_not_open(archived: Any) -> None:
    spec, archive = archived
    path = archive.root / archive.current() / "psf0.npy"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(CalibrationDamaged) as caught:
        opened(spec)
    assert refused_as(caught.value) == (423, "calibration.damaged")


# By hand


def test_what_the_shelf_tells_by_hand(make_rig: Any, wait_until: Callable[..., None], tmp_path: Path) -> None:
    archive = Archive(tmp_path / "archive")
    wrong: list[InstrumentSpec] = []

    def with_another_psf(head: Head) -> Head:
        strange, long_ago = turned(head.calibration), VirtualClock().wall() - timedelta(weeks=70)
        archive.keep(strange, Provenance("D-1", long_ago, "a technician", "0.1.0"))
        put_in_force(archive.root / CURRENT, VirtualClock().wall())
        wrong.append(head.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root)}))
        return replace(head, spec=wrong[0], calibration=strange)

    rig = make_rig(head=with_another_psf)
    for _ in range(2):
        rig.exam.press("OD").result(30)
    wait_until(lambda: not rig.exam.fitness.due)
    found = checked(wrong[0], rig.store.folder, rig.clock, [].append)
    assert (found.captures, found.darks) == (2, 0)
    assert {one.name for one in found.findings if one.fails} == {"psf", "age"}
    lines = table(found).splitlines()
    assert lines[0].startswith("FAIL  age                  70 weeks  limit 61")
    assert lines[1] == f"      {CalibrationOld.default_remedy}"


@pytest.fixture
def calibrated(diffuscope: Diffuscope, head_file: Path, tmp_path: Path) -> Path:
    """The file of a head that was calibrated beside it; a tenth of the exposure, because time is real here."""
    quick = head_file.read_text().replace("[camera]", "[camera]\nexposure_s = 0.01\npreview_exposure_s = 0.01")
    path = tmp_path / "head.toml"
    path.write_text(quick + '\n[calibration]\narchive = "calibrations"\n')
    done = diffuscope("calibrate", "--head", path, "--archive", tmp_path / "calibrations")
    assert done.returncode == 0, done.stderr
    return path


def test_the_command_prints_each_finding_and_its_exit_status_tells(
    diffuscope: Diffuscope, calibrated: Path, tmp_path: Path
) -> None:
    asked = diffuscope("check", "--head", calibrated, "--data", tmp_path / "none")
    assert asked.returncode == 0, asked.stderr
    assert "taking dark frames now" in asked.stderr
    lines = asked.stdout.splitlines()
    assert [line.split()[0] for line in lines[1:5]] == ["ok"] * 4
    assert "black level" in asked.stdout
    assert "Take a picture of an eye" in lines[-1]
    other = tmp_path / "other.toml"
    other.write_text(calibrated.read_text().replace("rows = 270", "rows = 272"))
    refused = diffuscope("check", "--head", other)
    assert refused.returncode == 2
    assert "270 x 480" in refused.stderr
    assert CalibrationOtherMode.default_remedy in refused.stderr
    nothing = diffuscope("check", "--head", "hardware/heads/sim.toml")
    assert nothing.returncode == 2
    assert "--archive" in nothing.stderr
