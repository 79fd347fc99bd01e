"""An update as the technician's page asks for it: the API on one side, the real updater on the other, files between."""

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest

from device.clock import VirtualClock
from device.errors import UpdateDuringExam
from services.instrument.api import create_app
from services.instrument.updates_api import update_routes
from services.instrument.updating import MOST_BYTES, PATIENCE_S, UpdateDesk, news
from services.records.update_notes import TABLET, UPLOAD, WISH, Wish, leave
from services.update import gate
from services.update.updater import Updater
from tests.appliance.instrument import served
from tests.journey.conftest import Rig
from tests.updates import Board


@dataclass
class Page:
    """The technician's page, behind the PIN, of a device that runs 1.0."""

    rig: Rig
    board: Board
    clock: VirtualClock
    cookie: dict[str, str]

    def ask(self, method: str, path: str = "", **options: Any) -> httpx.Response:
        headers = self.cookie | options.pop("headers", {})
        return self.rig.request(method, f"/api/update{path}", headers=headers, **options)

    def told(self) -> dict[str, Any]:
        return dict(self.ask("GET").json())

    def answered(self, method: str, path: str, runs: str = "1.0", **options: Any) -> dict[str, Any]:
        """Ask for something, let the updater do it, and what the page shows then."""
        answer = self.ask(method, path, **options)
        assert (answer.status_code, answer.json()["state"]) == (202, "asked")
        self.board.updater(runs).answer()
        return self.told()

    def looked(self) -> dict[str, Any]:
        return self.answered("POST", "/check")

    def installed(self, id: str) -> dict[str, Any]:
        return self.answered("POST", "/install", json={"id": id})


@pytest.fixture(scope="module")
def rig(build: Callable[..., Rig], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield build(tmp_path_factory.mktemp("updated"), undo, wait=False)


@pytest.fixture
def page(rig: Rig, tmp_path: Path) -> Page:
    board, clock = Board.new(tmp_path / "board"), VirtualClock()
    desk = UpdateDesk(board.state, board.wishes, clock, "1.0")
    app = create_app(rig.owner, rig.door, names=("eye.local",), rooms=(update_routes(desk, rig.door),))
    new = replace(rig, app=app)
    door = "unlock" if rig.door.has_pin else "pin"
    entered = new.request("POST", f"/api/technician/{door}", json={"pin": "2580"})
    return Page(new, board, clock, {"Cookie": f"technician={entered.cookies['technician']}"})


def test_strangers_neither_look_nor_act(page: Page) -> None:
    page.cookie = {}
    for method, path in (("GET", ""), ("POST", "/check"), ("POST", "/restart"), ("PUT", "/file")):
        assert page.ask(method, path).status_code == 401
    assert page.ask("POST", "/install", json={"id": "0" * 16}).status_code == 401
    assert page.ask("PUT", "/file", content=b"x" * 20_000).json()["code"] == "technician.locked"
    assert list(page.board.wishes.iterdir()) == []


def test_from_a_stick_to_the_next_version(page: Page) -> None:
    page.board.bundle("two.raucb")
    assert page.told() | {"found": []} == page.told()
    (found,) = page.looked()["found"]
    assert (found["version"], found["where"], found["stick"], found["trouble"]) == ("2.0", "stick", "STICK", None)
    assert str(page.board.folder) not in json.dumps(page.told())  # no path leaves the updater
    now = page.installed(found["id"])
    assert (now["state"], now["version"], page.board.is_off, page.board.boot()) == ("restarting", "2.0", True, "B")
    page.board.chooser.set_good("B")
    page.board.updater("2.0")._journal.write(state="committed")
    after = UpdateDesk(page.board.state, page.board.wishes, page.clock, "2.0").told()
    assert (after["state"], after["runs"], after["trouble"]) == ("committed", "2.0", None)
    assert after["news"]


def test_how_long_an_update_takes_is_what_the_last_one_took_or_an_estimate(page: Page) -> None:
    """Timed from the copy to the restart, and from the start of the computer until it was found well."""
    board = page.board
    board.bundle("two.raucb")
    (found,) = page.looked()["found"]
    low_s, high_s = found["takes_s"]
    assert (0 < low_s < high_s, page.told()["took_s"]) == (True, None)
    page.installed(found["id"])
    board.boot()
    with served() as instrument:
        settings = board.settings(instrument=instrument.at, answer_s=2.0)
        Updater(settings, VirtualClock(elapsed_s=100.0), print, board.chooser, "2.0").settle()
    told = UpdateDesk(board.state, board.wishes, page.clock, "2.0").told()
    assert told["state"] == "committed"
    assert 100 < told["took_s"] < 160  # the install took a second or two
    board.bundle("three.raucb", "3.0")
    board.updater("2.0").look()
    assert UpdateDesk(board.state, board.wishes, page.clock, "2.0").told()["took_s"] == told["took_s"]


def test_a_version_that_is_not_well_is_taken_back_and_says_why(page: Page) -> None:
    page.board.bundle("two.raucb")
    page.installed(page.looked()["found"][0]["id"])
    assert page.board.boot() == "B"
    said = page.board.run("settle", "2.0")  # its page does not answer
    assert "UpdateFailed" in said
    assert page.board.boot() == "A"
    now = page.told()
    assert (now["state"], now["version"], now["trouble"]["code"]) == ("went back", "2.0", "update.failed")
    assert "page: does not answer" in now["trouble"]["message"]
    assert page.looked()["state"] == "none"  # it was read; now it is about the next one


def test_each_bundle_on_the_stick_says_why_it_is_none_for_this_device(page: Page) -> None:
    board = page.board
    board.bundle("foreign.raucb", signer="a stranger")
    board.bundle("other.raucb", compatible="toaster")
    board.bundle("older.raucb", version="0.9")
    board.bundle("far.raucb", version="9.0", minimum="8.0")
    (board.stick / "damaged.raucb").write_bytes(b"no bundle")
    (board.stick / "link.raucb").symlink_to("/etc/passwd")
    (board.stick / "folder.raucb").mkdir()
    found = {one["name"]: one for one in page.looked()["found"]}
    assert {name: one["trouble"]["code"] for name, one in found.items()} == {
        "foreign.raucb": "update.foreign", "other.raucb": "update.device", "older.raucb": "update.older",
        "far.raucb": "update.step", "damaged.raucb": "update.damaged",
    }  # fmt: skip
    now = page.installed(found["foreign.raucb"]["id"])  # whoever insists is refused by the updater
    assert (now["state"], now["trouble"]["code"]) == ("refused", "update.foreign")
    assert len(now["found"]) == 5


def test_what_is_refused_at_the_install_is_named(page: Page) -> None:
    board = page.board
    small, gone = board.bundle("small.raucb", slot="small"), board.bundle("gone.raucb")
    ids = {one["name"]: one["id"] for one in page.looked()["found"]}
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.room"
    gone.unlink()
    assert page.installed(ids[gone.name])["trouble"]["code"] == "update.stick"
    gone.write_bytes(small.read_bytes())  # another file under that name is not what was chosen
    assert page.installed(ids[gone.name])["trouble"]["code"] == "update.stick"
    with gate.alone(board.state):
        assert page.installed(ids[small.name])["trouble"]["code"] == "update.busy"
    (board.folder / "cmdline").write_text("rauc.slot=B\n")
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.uncommitted"
    (board.folder / "cmdline").write_text("console=tty1\n")
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.device"
    assert not board.is_off


def test_a_forged_wish_is_told_and_changes_nothing(page: Page) -> None:
    (page.board.wishes / WISH).write_text('{"do": "install", "id": "/media/STICK/two.raucb"}')
    page.board.updater("1.0").answer()
    assert page.told()["trouble"]["code"] == "update.request"
    leave(page.board.wishes, Wish(do="install", id="0123456789abcdef"))  # a name that nobody gave
    page.board.updater("1.0").answer()
    assert page.told()["trouble"]["code"] == "update.stick"
    for said in ({"id": "../../etc"}, {}, {"id": "0" * 16, "path": "/"}):
        assert page.ask("POST", "/install", json=said).status_code == 422


def test_one_wish_at_a_time_and_one_that_nobody_takes_is_taken_back(page: Page) -> None:
    assert page.ask("POST", "/check").status_code == 202
    again = page.ask("POST", "/restart")
    assert (again.status_code, again.json()["code"]) == (409, "update.busy")
    page.clock.sleep(PATIENCE_S)
    now = page.told()
    assert (now["state"], now["trouble"]["code"]) == ("none", "update.failed")
    assert list(page.board.wishes.iterdir()) == []
    assert page.looked()["trouble"] is None


def test_an_update_that_was_killed_is_told_as_interrupted(page: Page) -> None:
    page.board.updater("1.0")._journal.write(state="installing", version="2.0", share=0.4)
    assert page.told()["state"] == "installing"
    assert page.ask("POST", "/check").status_code == 409
    page.board.updater("1.0").tidy()  # as ExecStopPost calls it
    assert page.told()["state"] == "interrupted"
    page.board.updater("1.0")._journal.write(state="installing", version="2.0", share=0.4)
    after = UpdateDesk(page.board.state, page.board.wishes, page.clock, "1.0", boot="the next").told()
    assert after["state"] == "interrupted"  # and after a power cut nobody had time to say so


def test_what_is_installed_can_be_tried_later(page: Page) -> None:
    page.board.updater("1.0").install(page.board.bundle("two.raucb"), restart=False)
    assert page.told()["state"] == "installed"
    assert page.answered("POST", "/restart")["state"] == "restarting"
    assert page.board.boot() == "B"


def test_a_tablet_sends_an_update_and_it_is_found(page: Page) -> None:
    content = page.board.bundle("two.raucb").read_bytes()
    (page.board.stick / "two.raucb").unlink()
    assert page.ask("PUT", "/file", content=content).status_code == 201
    kept = page.board.state / TABLET / UPLOAD
    assert (kept.read_bytes(), kept.stat().st_mode & 0o777) == (content, 0o644)
    (found,) = page.looked()["found"]
    assert (found["where"], found["version"]) == ("tablet", "2.0")
    assert page.installed(found["id"])["state"] == "restarting"
    assert not kept.exists()


def test_a_tablets_file_arrives_whole_or_not_at_all(page: Page) -> None:
    folder = page.board.state / TABLET
    for length, code in ((0, "input"), (MOST_BYTES + 1, "input"), (10**15, "input")):
        answer = page.ask("PUT", "/file", content=b"", headers={"Content-Length": str(length)})
        assert (answer.status_code, answer.json()["code"]) == (422, code)

    async def halves() -> Any:
        yield b"half"

    answer = page.ask("PUT", "/file", content=halves(), headers={"Content-Length": "8"})
    assert (answer.status_code, answer.json()["message"]) == (422, "4 of 8 bytes arrived")
    assert page.ask("PUT", "/file", content=halves()).status_code == 422  # who does not say how much
    assert page.ask("POST", "/check", content=b"x" * 20_000).status_code == 422  # nothing else may be large
    assert list(folder.iterdir()) == []


def test_no_room_and_a_second_tablet_are_said(page: Page) -> None:
    roomless = page.ask("PUT", "/file", content=b"", headers={"Content-Length": str(MOST_BYTES)})
    if roomless.status_code != 422:  # a computer with a small disk
        assert roomless.json()["code"] == "update.room"

    async def story() -> list[int]:
        begun, go_on = asyncio.Event(), asyncio.Event()

        async def slowly() -> Any:
            begun.set()
            await go_on.wait()
            yield b"whole"

        transport = httpx.ASGITransport(app=page.rig.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://eye.local", headers=page.cookie) as client:
            headers = {"Content-Length": "5"}
            first = asyncio.create_task(client.put("/api/update/file", content=slowly(), headers=headers))
            await begun.wait()
            await asyncio.sleep(0.1)
            second = await client.put("/api/update/file", content=b"other")
            go_on.set()
            return [(await first).status_code, second.status_code]

    assert asyncio.run(story()) == [201, 409]
    assert (page.board.state / TABLET / UPLOAD).read_bytes() == b"whole"


def test_a_computer_without_an_updater_says_so(rig: Rig, page: Page, tmp_path: Path) -> None:
    for desk in (
        UpdateDesk(None, None, page.clock, "1.0"),
        UpdateDesk(tmp_path / "no", tmp_path / "where", page.clock, "1.0"),
    ):
        page.rig.app = create_app(rig.owner, rig.door, names=("eye.local",), rooms=(update_routes(desk, rig.door),))
        assert (page.told()["here"], page.told()["state"]) == (False, "none")
        answer = page.ask("POST", "/check")
        assert (answer.status_code, answer.json()["code"]) == (409, "update.device")
        assert page.ask("PUT", "/file", content=b"x").json()["code"] == "update.device"


def test_what_is_new_is_the_versions_own_list_without_marks(tmp_path: Path) -> None:
    file = tmp_path / "CHANGELOG.md"
    file.write_text("# Changes\n\n## 2.0\n\nWords.\n\n* **New:** `a`,\n  and b.\n* c\n\n## 1.0 (2026)\n\n* old\n")
    assert news("2.0", file) == ["New: a, and b.", "c"]
    assert news("1.0", file) == ["old"]
    assert news("3.0", file) == ["New: a, and b.", "c"]
    assert news("1.0", tmp_path / "none") == []


def test_an_open_visit_is_an_examination_which_an_update_does_not_end(rig: Rig, page: Page) -> None:
    """Asked over HTTP of the page's own answers, as the updater asks."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answer = rig.request("GET", self.path)
            self.send_response(answer.status_code)
            self.end_headers()
            self.wfile.write(answer.content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    visit = rig.request("POST", "/api/visits", json={"key": "00000000000000aa"}).json()
    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        begun = datetime.fromisoformat(visit["begun_at"])
        at = f"http://127.0.0.1:{server.server_port}"
        with pytest.raises(UpdateDuringExam, match=visit["number"]):
            gate.refuse_unless_at_rest(at, 0.0, begun + timedelta(minutes=29))
        gate.refuse_unless_at_rest(at, 0.0, begun + timedelta(minutes=31))
        server.shutdown()
