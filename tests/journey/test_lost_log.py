"""After a kill the last rows are in the log of the database; a damaged log costs entries, never pictures."""

import random
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from device.clock import VirtualClock
from device.errors import StoreFull
from device.values import Capture
from services.records.light_book import LightBook
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import WHOLE, Store
from tests.journey.test_cli_server import Server

FLIPS, SERVED = 10, 2
BIG = {"raw.tiff": b"r" * 50_000}


def killed(server: Server) -> list[str]:
    """Press, and kill: what was acknowledged."""
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
    return kept


def flip(log: Path, chance: random.Random) -> str:
    content = bytearray(log.read_bytes())
    at, bit = chance.randrange(len(content)), chance.randrange(8)
    content[at] ^= 1 << bit
    log.write_bytes(content)
    log.with_name("shelf.sqlite-shm").unlink(missing_ok=True)  # as after a power cut
    return f"bit {bit} of byte {at}"


def whole(data: Path) -> set[str]:
    return {
        path.parent.name for path in data.glob("*/*/raw.tiff") if {one.name for one in path.parent.iterdir()} >= WHOLE
    }


def test_no_bit_of_the_log_costs_a_picture_or_lowers_a_dose_and_what_has_no_entry_is_counted(
    head_file: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    data, chance = tmp_path / "data", random.Random(16)
    kept = killed(Server(head_file, data, environment))
    log = data / "shelf.sqlite-wal"
    assert log.stat().st_size > 0, "nothing was in the log, so nothing is shown"
    spent = spent_of(shutil.copytree(data, tmp_path / "as-it-was"))
    without = 0
    for turn in range(FLIPS):
        folder = shutil.copytree(data, tmp_path / f"{turn}")
        said = flip(folder / log.name, chance)
        if turn < SERVED:
            with Server(head_file, folder, environment).running():
                pass
        with Store(folder, reserve_bytes=0) as store:
            listed = {one.id for one in store.captures()}
            assert listed | set(store.orphans()) == set(kept), said
            assert not store.torn(), said
            without += len(store.orphans())
            People(store.engine, load_protocol(), VirtualClock()).visits(10)
        assert whole(folder) == set(kept), said
        now = spent_of(folder)
        assert all(now[eye] >= spent[eye] - 1e-9 for eye in spent), said
    assert without > 0, "no flip lost a row, so nothing is shown"


def spent_of(folder: Path) -> dict[str, float]:
    with Store(folder, reserve_bytes=0) as store:
        book = LightBook(store.engine, VirtualClock(), 86_400.0)
        return {"OD": book.spent_j_per_cm2("OD"), "OS": book.spent_j_per_cm2("OS")}


def test_health_counts_what_has_no_entry_and_says_what_to_do(
    head_file: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    """A copy of captures/ and shelf.sqlite, without the log, of an instrument that was killed."""
    server, data, copy = Server(head_file, tmp_path / "data", environment), tmp_path / "data", tmp_path / "copy"
    kept = killed(server)
    shutil.copytree(data / "captures", copy / "captures")
    shutil.copyfile(data / "shelf.sqlite", copy / "shelf.sqlite")
    with Server(head_file, copy, environment).running():
        pass  # a start, and a kill
    again = Server(head_file, copy, environment)
    with again.running() as process:
        checks = {check["name"]: check for check in again.ask("GET", "/api/health")["checks"]}
        missing = set(kept) - set(again.listed())
        assert missing
        many = "1 capture is" if len(missing) == 1 else f"{len(missing)} captures are"
        assert checks["captures"]["value"] == f"{many} on the disk without an entry in the database"
        assert not checks["captures"]["ok"]
        assert "remove nothing" in checks["captures"]["remedy"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    assert whole(copy) == set(kept)


@pytest.mark.parametrize("place", ["captures", "torn"])
def test_a_full_disk_removes_half_captures_and_no_whole_one(tmp_path: Path, place: str) -> None:
    """Also what an earlier release moved to torn/."""

    def free_bytes(folder: Path) -> int:
        return 120_000 - sum(path.stat().st_size for path in folder.rglob("*/*/*"))

    with Store(tmp_path, reserve_bytes=0, free_bytes=free_bytes):
        pass
    for name, files in {"a-whole": dict.fromkeys(WHOLE, b"w" * 8_000), "b-half": BIG}.items():
        (tmp_path / place / name).mkdir()
        for file, content in files.items():
            (tmp_path / place / name / file).write_bytes(content)
    with Store(tmp_path, reserve_bytes=0, free_bytes=free_bytes) as store:
        assert store.orphans() == ["a-whole"]
        assert list(store.torn()) == ["b-half"]
        taken = Capture("new", "OD", VirtualClock().wall(), True, "00ff", {}, {})
        store.keep(taken, {"raw.tiff": b"n" * 60_000})
        with pytest.raises(StoreFull):
            store.keep(Capture("more", "OD", VirtualClock().wall(), True, "00ff", {}, {}), {"raw.tiff": b"n" * 40_000})
        assert store.orphans() == ["a-whole"]
    assert {path.name for path in (tmp_path / place / "a-whole").iterdir()} == WHOLE
