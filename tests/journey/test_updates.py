"""Updates from the technician's page: HTTP API and the real updater, connected by files."""

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest

from device.clock import VirtualClock
from services.errors import UpdateDuringExam
from services.http.app import create_app
from services.http.routes.updates import update_routes
from services.instrument.update_requests import MAX_BYTES, PICKUP_TIMEOUT_S, UpdateRequests, release_notes
from services.update import preconditions
from services.update.ipc import REQUEST_FILE, TABLET, UPLOAD, UpdateRequest, write_request
from services.update.updater import Updater
from tests.appliance.instrument import served
from tests.journey.conftest import Rig, until
from tests.updates import Board


@dataclass
class Page:
    """Client of the technician's page on a device that runs version 1.0."""

    rig: Rig
    board: Board
    clock: VirtualClock

    def ask(self, method: str, path: str = "", **options: Any) -> httpx.Response:
        return self.rig.request(method, f"/api/update{path}", **options)

    def status(self) -> dict[str, Any]:
        return dict(self.ask("GET").json())

    def answered(self, method: str, path: str, runs: str = "1.0", **options: Any) -> dict[str, Any]:
        """Send a request, run the updater, and return the status after it."""
        answer = self.ask(method, path, **options)
        assert (answer.status_code, answer.json()["state"]) == (202, "asked")
        self.board.updater(runs).answer()
        return self.status()

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
    desk = UpdateRequests(board.state, board.requests, clock, "1.0")
    routers = (update_routes(desk),)
    build = partial(
        create_app, rig.arbiter, rig.authenticator, host_names=("diffuscope.local",), technician_routers=routers
    )
    new = replace(rig, build_application=build)
    return Page(new, board, clock)


def test_update_from_a_usb_drive_to_the_commit(page: Page) -> None:
    page.board.bundle("two.raucb")
    assert page.status() | {"found": []} == page.status()
    (found,) = page.looked()["found"]
    assert (found["version"], found["where"], found["stick"], found["trouble"]) == ("2.0", "stick", "STICK", None)
    assert str(page.board.folder) not in json.dumps(page.status())  # the status holds no path
    now = page.installed(found["id"])
    assert (now["state"], now["version"], page.board.is_off, page.board.boot()) == ("restarting", "2.0", True, "B")
    page.board.chooser.set_good("B")
    page.board.updater("2.0")._journal.write(state="committed")
    after = UpdateRequests(page.board.state, page.board.requests, page.clock, "2.0").status()
    assert (after.state, after.runs, after.trouble) == ("committed", "2.0", None)
    assert after.news


def test_duration_of_an_update_is_measured_or_estimated(page: Page) -> None:
    """Measured from the copy to the restart, and from the boot until the version is found healthy."""
    board = page.board
    board.bundle("two.raucb")
    (found,) = page.looked()["found"]
    low_s, high_s = found["takes_s"]
    assert (0 < low_s < high_s, page.status()["took_s"]) == (True, None)
    page.installed(found["id"])
    board.boot()
    with served() as instrument:
        settings = board.settings(instrument=instrument.at, answer_s=2.0)
        Updater(settings, VirtualClock(elapsed_s=100.0), print, board.chooser, "2.0").settle()
    status = UpdateRequests(board.state, board.requests, page.clock, "2.0").status()
    assert status.state == "committed"
    assert status.took_s is not None
    assert 100 < status.took_s < 160  # the install takes one or two seconds
    board.bundle("three.raucb", "3.0")
    board.updater("2.0").search()
    assert UpdateRequests(board.state, board.requests, page.clock, "2.0").status().took_s == status.took_s


def test_unhealthy_version_is_rolled_back_with_the_reason(page: Page) -> None:
    page.board.bundle("two.raucb")
    page.installed(page.looked()["found"][0]["id"])
    assert page.board.boot() == "B"
    output = page.board.run("settle", "2.0")  # no server is running
    assert "UpdateFailed" in output
    assert page.board.boot() == "A"
    now = page.status()
    assert (now["state"], now["version"], now["trouble"]["code"]) == ("went back", "2.0", "update.failed")
    assert "page: does not answer" in now["trouble"]["message"]
    assert page.looked()["state"] == "none"  # a new search replaces the old outcome


def test_each_unsuitable_bundle_is_listed_with_its_error(page: Page) -> None:
    board = page.board
    board.bundle("foreign.raucb", signer="a stranger")
    board.bundle("other.raucb", compatible="toaster")
    board.bundle("older.raucb", version="0.9")
    board.bundle("far.raucb", version="9.0", minimum="8.0")
    (board.stick / "damaged.raucb").write_bytes(b"no bundle")
    (board.stick / "link.raucb").symlink_to("/etc/passwd")
    (board.stick / "folder.raucb").mkdir()
    found = {bundle["name"]: bundle for bundle in page.looked()["found"]}
    assert {name: bundle["trouble"]["code"] for name, bundle in found.items()} == {
        "foreign.raucb": "update.foreign",
        "other.raucb": "update.device",
        "older.raucb": "update.older",
        "far.raucb": "update.step",
        "damaged.raucb": "update.damaged",
    }
    now = page.installed(found["foreign.raucb"]["id"])  # the updater itself refuses it too
    assert (now["state"], now["trouble"]["code"]) == ("refused", "update.foreign")
    assert len(now["found"]) == 5


def test_each_refused_install_has_its_code(page: Page) -> None:
    board = page.board
    small, gone = board.bundle("small.raucb", slot="small"), board.bundle("gone.raucb")
    ids = {bundle["name"]: bundle["id"] for bundle in page.looked()["found"]}
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.room"
    gone.unlink()
    assert page.installed(ids[gone.name])["trouble"]["code"] == "update.stick"
    gone.write_bytes(small.read_bytes())  # another file of that name is not the chosen one
    assert page.installed(ids[gone.name])["trouble"]["code"] == "update.stick"
    with preconditions.update_lock(board.state):
        assert page.installed(ids[small.name])["trouble"]["code"] == "update.busy"
    (board.folder / "cmdline").write_text("rauc.slot=B\n")
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.uncommitted"
    (board.folder / "cmdline").write_text("console=tty1\n")
    assert page.installed(ids[small.name])["trouble"]["code"] == "update.device"
    assert not board.is_off


def test_forged_request_is_reported_and_has_no_effect(page: Page) -> None:
    (page.board.requests / REQUEST_FILE).write_text('{"do": "install", "id": "/media/STICK/two.raucb"}')
    page.board.updater("1.0").answer()
    assert page.status()["trouble"]["code"] == "update.request"
    write_request(page.board.requests, UpdateRequest(do="install", id="0123456789abcdef"))  # an unknown id
    page.board.updater("1.0").answer()
    assert page.status()["trouble"]["code"] == "update.stick"
    for body in ({"id": "../../etc"}, {}, {"id": "0" * 16, "path": "/"}):
        assert page.ask("POST", "/install", json=body).status_code == 422


def test_one_request_at_a_time_and_an_unanswered_one_expires(page: Page) -> None:
    assert page.ask("POST", "/check").status_code == 202
    again = page.ask("POST", "/restart")
    assert (again.status_code, again.json()["code"]) == (409, "update.busy")
    page.clock.sleep(PICKUP_TIMEOUT_S)
    now = page.status()
    assert (now["state"], now["trouble"]["code"]) == ("none", "update.failed")
    assert list(page.board.requests.iterdir()) == []
    assert page.looked()["trouble"] is None


def test_killed_update_is_shown_as_interrupted(page: Page) -> None:
    page.board.updater("1.0")._journal.write(state="installing", version="2.0", share=0.4)
    assert page.status()["state"] == "installing"
    assert page.ask("POST", "/check").status_code == 409
    page.board.updater("1.0").tidy()  # called by ExecStopPost=
    assert page.status()["state"] == "interrupted"
    page.board.updater("1.0")._journal.write(state="installing", version="2.0", share=0.4)
    after = UpdateRequests(page.board.state, page.board.requests, page.clock, "1.0", boot="the next").status()
    assert after.state == "interrupted"  # after a power cut, without `tidy`


def test_installed_version_can_be_tried_later(page: Page) -> None:
    page.board.updater("1.0").install(page.board.bundle("two.raucb"), restart=False)
    assert page.status()["state"] == "installed"
    assert page.answered("POST", "/restart")["state"] == "restarting"
    assert page.board.boot() == "B"


def test_uploaded_update_is_found_and_installed(page: Page) -> None:
    content = page.board.bundle("two.raucb").read_bytes()
    (page.board.stick / "two.raucb").unlink()
    assert page.ask("PUT", "/file", content=content).status_code == 201
    uploaded = page.board.state / TABLET / UPLOAD
    assert (uploaded.read_bytes(), uploaded.stat().st_mode & 0o777) == (content, 0o644)
    (found,) = page.looked()["found"]
    assert (found["where"], found["version"]) == ("tablet", "2.0")
    assert page.installed(found["id"])["state"] == "restarting"
    assert not uploaded.exists()


def test_incomplete_or_oversized_upload_is_refused_and_leaves_no_file(page: Page) -> None:
    folder = page.board.state / TABLET
    for length, code in ((0, "input"), (MAX_BYTES + 1, "input"), (10**15, "input")):
        answer = page.ask("PUT", "/file", content=b"", headers={"Content-Length": str(length)})
        assert (answer.status_code, answer.json()["code"]) == (422, code)

    async def halves() -> Any:
        yield b"half"

    answer = page.ask("PUT", "/file", content=halves(), headers={"Content-Length": "8"})
    assert (answer.status_code, answer.json()["message"]) == (422, "4 of 8 bytes arrived")
    assert page.ask("PUT", "/file", content=halves()).status_code == 422  # without Content-Length
    assert page.ask("POST", "/check", content=b"x" * 20_000).status_code == 422  # other endpoints have a small limit
    assert list(folder.iterdir()) == []


def test_full_disk_and_a_concurrent_upload_are_refused(page: Page) -> None:
    too_large = page.ask("PUT", "/file", content=b"", headers={"Content-Length": str(MAX_BYTES)})
    if too_large.status_code != 422:  # on a computer with a small disk
        assert too_large.json()["code"] == "update.room"

    async def scenario() -> list[int]:
        begun, go_on = asyncio.Event(), asyncio.Event()

        async def slowly() -> Any:
            begun.set()
            await go_on.wait()
            yield b"whole"

        transport = httpx.ASGITransport(app=page.rig.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://diffuscope.local") as client:
            headers = {"Content-Length": "5"}
            first = asyncio.create_task(client.put("/api/update/file", content=slowly(), headers=headers))
            await begun.wait()
            await asyncio.sleep(0.1)
            second = await client.put("/api/update/file", content=b"other")
            go_on.set()
            return [(await first).status_code, second.status_code]

    assert asyncio.run(scenario()) == [201, 409]
    assert (page.board.state / TABLET / UPLOAD).read_bytes() == b"whole"


def test_computer_without_updater_refuses_updates(rig: Rig, page: Page, tmp_path: Path) -> None:
    for desk in (
        UpdateRequests(None, None, page.clock, "1.0"),
        UpdateRequests(tmp_path / "no", tmp_path / "where", page.clock, "1.0"),
    ):
        page.rig.application = create_app(
            rig.arbiter,
            rig.authenticator,
            host_names=("diffuscope.local",),
            technician_routers=(update_routes(desk),),
        )
        assert (page.status()["here"], page.status()["state"]) == (False, "none")
        answer = page.ask("POST", "/check")
        assert (answer.status_code, answer.json()["code"]) == (409, "update.device")
        assert page.ask("PUT", "/file", content=b"x").json()["code"] == "update.device"


def test_news_is_the_changelog_list_of_the_version_as_plain_text(tmp_path: Path) -> None:
    file = tmp_path / "CHANGELOG.md"
    file.write_text("# Changes\n\n## 2.0\n\nWords.\n\n* **New:** `a`,\n  and b.\n* c\n\n## 1.0 (2026)\n\n* old\n")
    assert release_notes("2.0", file) == ["New: a, and b.", "c"]
    assert release_notes("1.0", file) == ["old"]
    assert release_notes("3.0", file) == ["New: a, and b.", "c"]
    assert release_notes("1.0", tmp_path / "none") == []


def test_a_picture_delays_an_update_and_an_open_visit_does_not(rig: Rig, page: Page) -> None:
    """The precondition asks the page over HTTP, as the updater does."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answer = rig.request("GET", self.path)
            self.send_response(answer.status_code)
            self.end_headers()
            self.wfile.write(answer.content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    rig.request("POST", "/api/visits", json={"key": "00000000000000aa"})
    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        at = f"http://127.0.0.1:{server.server_port}"
        preconditions.refuse_while_in_use(at, 0.0, rig.clock.wall())
        until(rig.exam.ready.is_set)
        taken_at = datetime.fromisoformat(rig.request("POST", "/api/captures", json={"eye": "OD"}).json()["taken_at"])
        with pytest.raises(UpdateDuringExam, match="9 minutes ago"):
            preconditions.refuse_while_in_use(at, 0.0, taken_at + timedelta(minutes=9))
        preconditions.refuse_while_in_use(at, 0.0, taken_at + timedelta(minutes=11))
        server.shutdown()
