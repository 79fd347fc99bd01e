"""The program on a disk that takes no changes: it shows, exports and backs up everything, and gives no light."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from device.values import EYES
from tests.browser.conftest import copy_small_plans, free_port
from tests.hard.test_capture_store_full import own_disk
from tests.signed_in_server import signed_in_server
from tests.simulated import small_head_toml
from tests.store_damage import filled_store

DISK = 'mount -o remount,size=300m "$1" && cp -a "$2" "$1/data" && '
CASES = {  # what happens on the disk before the start; the first start wrote a reserve file
    "full": "dd if=/dev/zero of=$1/filler bs=1M 2>/dev/null; rm $1/data/reserve.bin; "
    "dd if=/dev/zero of=$1/filler2 bs=1k 2>/dev/null; true",
    "full, with the reserve": "dd if=/dev/zero of=$1/filler bs=1k 2>/dev/null; true",
    "read-only": 'mount -o remount,ro "$1"',
}
CODES = {"full": "store.full", "full, with the reserve": "store.full", "read-only": "store.readonly"}


@dataclass(frozen=True)
class Prepared:
    """Folder with a head file and a data folder that the program has used, and what it shows of the data."""

    folder: Path
    shown: dict[str, Any]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """A data folder that two starts have used, with one finished visit and its captures."""
    folder = tmp_path_factory.mktemp("prepared")
    filled_store(folder, with_log=False).rename(folder / "data")
    shutil.rmtree(folder / "data/calibrations")
    copy_small_plans(folder / "data")
    (folder / "head.toml").write_text(small_head_toml("Small simulated head"))
    with running(folder, folder / "data", ()) as client:
        press(client)
    assert (folder / "data/reserve.bin").stat().st_blocks * 512 >= 8_000_000
    with running(folder, folder / "data", ()) as client:
        return Prepared(folder, seen(client))


@contextmanager
def running(folder: Path, data: Path, prefix: tuple[str, ...]) -> Iterator[httpx.Client]:
    """Run the program on a data folder; `prefix`: words before its command."""
    port = free_port()
    program = str(Path(sys.executable).parent / "diffuscope")
    words = [program, "run", "--head", str(folder / "head.toml"), "--data", str(data), "--port", str(port)]
    with signed_in_server([*prefix, *words], folder / "log", port) as client:
        yield client


def press(client: httpx.Client) -> Any:
    answer = client.post("/api/captures", json={"eye": "OD"})
    assert answer.status_code == 201
    return answer.json()


def seen(client: httpx.Client) -> dict[str, Any]:
    """Return what a person can see: lists, visits, every file of every capture, an export."""
    captures = client.get("/api/captures?limit=100").json()["captures"]
    visits = client.get("/api/visits").json()["visits"]
    files = {
        (capture["id"], name): client.get(f"/api/captures/{capture['id']}/{name}").content
        for capture in captures
        for name in ("picture.png", "raw.tiff")
    }
    exports = {visit["id"]: client.get(f"/api/visits/{visit['id']}/export.zip").status_code for visit in visits}
    return {"captures": captures, "visits": visits, "files": files, "exports": exports}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("case", CASES)
def test_the_program_starts_for_reading_on_a_disk_that_takes_no_changes(
    case: str, prepared: Prepared, tmp_path: Path
) -> None:
    (tmp_path / "disk").mkdir()
    prefix = own_disk(tmp_path / "disk")
    if prefix is None:
        pytest.skip("no permission to mount")  # a user who may not mount has no disk to fill; CI runs as root
    script = f'{DISK} {{ {CASES[case]}; }} && shift 2 && exec "$@"'
    inside = (*prefix, "sh", "-c", script, "sh", str(tmp_path / "disk"), str(prepared.folder / "data"))
    with running(prepared.folder, tmp_path / "disk/data", inside) as client:
        assert seen(client) == prepared.shown
        for eye in EYES:
            answer = client.post("/api/captures", json={"eye": eye}).json()
            assert answer["code"] == CODES[case]
            assert len(answer["remedy"]) > 20
        assert client.get("/api/preview?after=0&eye=OD", headers={"X-Controller": "a" * 16}).status_code == 204
        status = client.get("/api/status").json()
        assert (status["problem"]["code"], status["space_left"]) == (CODES[case], 0)
        failed = {check["name"] for check in client.get("/api/health").json()["checks"] if not check["ok"]}
        assert failed >= {"camera", "space"}
        # Beside the reserve, which was released, records can be written: a visit that is under way can be finished.
        begun = client.post("/api/visits", json={"key": "0123456789abcdef"}, headers={"X-Controller": "a" * 16})
        assert (begun.status_code == 201) == (case == "full, with the reserve")
