"""Damage to the write-ahead log after a kill: lost rows of captures are rebuilt, and no dose is lost."""

import random
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from device.clock import VirtualClock
from device.errors import StoreFull
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.patient_keys import FILES
from services.records.programme import load_programme
from services.records.quarantine import REQUIRED_FILES
from services.records.record_files import CAPTURE_RECORD as RECORD
from services.records.visit_repository import VisitRepository
from tests.journey.test_cli_server import Server

FLIPS, SERVED = 10, 2
BIG = {"raw.tiff": b"r" * 50_000}


@pytest.fixture(scope="module")
def killed(
    served_head: Path, environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[str]]:
    """Return the data folder of an instrument that was killed after three captures, to be copied, and their ids."""
    data = tmp_path_factory.mktemp("killed") / "data"
    server = Server(served_head, data, environment)
    with server.running() as process:
        visit = server.ask("POST", "/api/visits", {"key": "0" * 16})["id"]
        server.ask("PATCH", f"/api/visits/{visit}", {"key": "f" * 16, "field": "consent", "value": "agreed"})
        presses: list[dict[str, Any]] = [
            {"eye": "OD"},
            {"eye": "OS"},
            {"eye": "OD", "visit": visit, "slot": "R-centre"},
        ]
        kept = [
            str(server.ask("POST", "/api/captures", {"key": f"{number:016x}", **press})["id"])
            for number, press in enumerate(presses, 1)
        ]
        process.send_signal(signal.SIGKILL)
        process.wait()
    return data, kept


def flip(log: Path, random_source: random.Random) -> str:
    content = bytearray(log.read_bytes())
    at, bit = random_source.randrange(len(content)), random_source.randrange(8)
    content[at] ^= 1 << bit
    log.write_bytes(content)
    log.with_name("store.sqlite-shm").unlink(missing_ok=True)  # as after a power cut
    return f"bit {bit} of byte {at}"


def complete_captures(data: Path) -> set[str]:
    return {
        path.parent.name
        for path in data.glob("*/*/raw.tiff")
        if {file.name for file in path.parent.iterdir()} >= REQUIRED_FILES
    }


def test_a_flipped_bit_in_the_log_costs_no_picture_and_lowers_no_dose(
    killed: tuple[Path, list[str]], served_head: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    (data, kept), random_source = killed, random.Random(16)
    log = data / "store.sqlite-wal"
    assert log.stat().st_size > 0, "the log is empty, so the test shows nothing"
    spent = spent_of(shutil.copytree(data, tmp_path / "as-it-was"))
    adopted = 0
    for turn in range(FLIPS):
        folder = shutil.copytree(data, tmp_path / f"{turn}")
        flipped = flip(folder / log.name, random_source)
        if turn < SERVED:
            with Server(served_head, folder, environment).running():
                pass
        with CaptureStore(folder, reserve_bytes=0) as store:
            listed = {capture.id for capture in store.captures()}
            assert listed == set(kept), flipped
            assert not store.quarantine.sizes_bytes(), flipped
            adopted += len(store.recovery.adopted)
            VisitRepository(store.engine, load_programme(), VirtualClock()).visits(10)
        assert complete_captures(folder) == set(kept), flipped
        now = spent_of(folder)
        assert all(now[eye] >= spent[eye] - 1e-9 for eye in spent), flipped
    assert adopted > 0, "no flip lost a row, so the test shows nothing"


def spent_of(folder: Path) -> dict[str, float]:
    with CaptureStore(folder, reserve_bytes=0) as store:
        ledger = DoseLedgerStore(store.engine, VirtualClock(), 86_400.0)
        return {"OD": ledger.spent_j_per_cm2("OD"), "OS": ledger.spent_j_per_cm2("OS")}


def test_health_counts_orphans_and_gives_a_remedy(
    killed: tuple[Path, list[str]], served_head: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    """The copy has captures, database and keys of a killed instrument; health counts the one without a record."""
    (data, kept), copy = killed, tmp_path / "copy"
    shutil.copytree(data / "captures", copy / "captures")
    shutil.copytree(data / "access", copy / "access")
    for name in ("store.sqlite", *FILES):
        shutil.copyfile(data / name, copy / name)
    (copy / "captures" / kept[0] / RECORD).unlink()  # as a release before the record wrote it
    with Server(served_head, copy, environment).running():
        pass  # a start, and a kill
    again = Server(served_head, copy, environment)
    with again.running() as process:
        checks = {check["name"]: check for check in again.ask("GET", "/api/health")["checks"]}
        assert set(again.listed()) == set(kept[1:])
        assert checks["captures"]["value"] == "1 capture is on the disk without an entry in the database"
        assert not checks["captures"]["ok"]
        assert "remove nothing" in checks["captures"]["remedy"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    assert complete_captures(copy) == set(kept)


@pytest.mark.parametrize("place", ["captures", "quarantine"])
def test_a_full_disk_deletes_incomplete_captures_only(tmp_path: Path, place: str) -> None:
    """Complete captures in quarantine, which had not got their name yet, stay too."""

    def free_bytes(folder: Path) -> int:
        return 120_000 - sum(path.stat().st_size for path in folder.rglob("*/*/*"))

    with CaptureStore(tmp_path, reserve_bytes=0, free_bytes=free_bytes):
        pass
    for name, files in {"a-whole": dict.fromkeys(REQUIRED_FILES, b"w" * 8_000), "b-half": BIG}.items():
        (tmp_path / place / name).mkdir()
        for file, content in files.items():
            (tmp_path / place / name / file).write_bytes(content)
    with CaptureStore(tmp_path, reserve_bytes=0, free_bytes=free_bytes) as store:
        assert store.quarantine.orphans() == ["a-whole"]
        assert list(store.quarantine.sizes_bytes()) == ["b-half"]
        taken = Capture("new", "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {})
        store.save(taken, {"raw.tiff": b"n" * 60_000})
        with pytest.raises(StoreFull):
            store.save(
                Capture("more", "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {}),
                {"raw.tiff": b"n" * 40_000},
            )
        assert store.quarantine.orphans() == ["a-whole"]
    assert {path.name for path in (tmp_path / place / "a-whole").iterdir()} == REQUIRED_FILES
