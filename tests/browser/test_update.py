"""The update screen on the real server, with the real updater beside it: from stick to "Updated to 2.0", and not."""

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from device import errors
from device.errors import UpdateError
from services.records.update_notes import Entry, Found, Trouble, this_boot, write_entry
from tests.browser.conftest import Complaints, Server
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.test_rooms import enter
from tests.browser.test_wizard import CUT, HEAD, SMALL_PLANS, come_in
from tests.updates import Board

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]  # a server is started four times

Open = Callable[..., Page]
LEAVES = sorted(
    {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, UpdateError)}, key=str
)
FOUND = Found(id="0123456789abcdef", where="stick", stick="STICK", name="two.raucb", bytes=330_000_000, version="2.0")
LONG = "a_very_long_name_that_somebody_gave_to_an_update_without_a_single_blank_in_it_" + "x" * 22 + ".raucb"


@dataclass
class Device:
    """A server whose page updates, and the board under it."""

    server: Server
    board: Board
    folder: Path
    version: str = ""

    def runs(self, version: str) -> None:
        """Boot into another version: the same program under another number."""
        self.server.stop()
        self.version = version
        place = self.folder / version / f"diffuscope-{version}.dist-info"
        place.mkdir(parents=True, exist_ok=True)
        (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: diffuscope\nVersion: {version}\n")
        self.server.first_on_path = self.board.first_on_path = place.parent
        self.server.start()
        self.server.wait_until_ready()


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    folder = tmp_path_factory.mktemp("updated")
    (folder / "head.toml").write_text(HEAD.split("[calibration]")[0] + "[sim]\n")
    server = Server(folder / "data", str(folder / "head.toml"))
    board = Board.new(folder / "board", server.url)
    server.more = ["--updates", str(board.state), "--wishes", str(board.wishes)]
    if SMALL_PLANS.is_dir():
        shutil.copytree(SMALL_PLANS, server.data / "plans")
    device = Device(server, board, folder)
    device.runs("1.0")
    yield device
    server.close()


def entered(open_page: Open, device: Device) -> Page:
    page = open_page(f"{device.server.url}/technician", SIZES["portrait"])
    come_in(page)
    page.wait_for_timeout(700)
    enter(page, "update")
    return page


def at(page: Page, state: str) -> None:
    page.wait_for_selector(f".update[data-state='{state}']", timeout=120_000)
    page.wait_for_timeout(700)  # the page ignores a tap on what has only just appeared


def back_inside(page: Page) -> None:
    """The device has restarted, and its door is shut."""
    page.wait_for_selector("[data-view=door]", timeout=120_000)
    page.wait_for_timeout(700)
    come_in(page)


def faults(page: Page) -> list[str]:
    found = []
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(50)
        found += [f"{name}: {fault}" for fault in look_for_faults(page)]
    return found


def test_from_a_stick_to_the_next_version(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("401", *CUT)
    board, page = device.board, entered(open_page, device)
    at(page, "none")
    expect(page.locator(".update")).to_contain_text("Version 1.0 is running.")
    with board.path_unit("1.0"):
        page.locator("#look").tap()
        expect(page.locator(".update")).to_contain_text("No update was found.", timeout=90_000)
        board.bundle("two.raucb", "2.0")
        page.wait_for_timeout(700)
        page.locator("#look").tap()
        install = page.get_by_role("button", name="Install 2.0")
        expect(install).to_be_visible(timeout=90_000)
        board.hold()
        page.wait_for_timeout(700)
        install.tap()
        at(page, "installing")
        expect(page.locator(".update")).to_contain_text("Estimate: 1 to 4 minutes. No update was timed on this camera")
        expect(page.locator("progress")).to_have_js_property("value", 0.8)
        board.release()
        at(page, "restarting")
    assert board.is_off
    assert board.boot() == "B"
    device.runs("2.0")
    back_inside(page)
    at(page, "trying")
    board.patience_s = 120  # a busy computer takes its time to get ready
    assert "is well, and committed" in board.run("settle", "2.0")
    at(page, "committed")
    expect(page.locator(".update")).to_contain_text("Updated to 2.0.")
    expect(page.locator(".update")).to_contain_text("What is new")
    board.bundle("three.raucb", "3.0")
    with board.path_unit("2.0"):
        page.wait_for_timeout(700)
        page.locator("#look").tap()
        offered = page.locator("li", has_text="Version 3.0")
        expect(offered).to_contain_text(
            re.compile(r"The last update took \d+ minutes?\. The camera restarts by itself"), timeout=90_000
        )
    (board.stick / "three.raucb").unlink()


def test_a_version_that_is_not_well_is_taken_back(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("401", *CUT)
    board, before, page = device.board, device.version, entered(open_page, device)
    page.wait_for_timeout(700)
    board.bundle("old.raucb", "0.9")
    board.bundle("three.raucb", "3.0")
    with board.path_unit(before):
        page.locator("#look").tap()
        expect(page.locator("li[data-code='update.older']", has_text="0.9")).to_be_visible(timeout=90_000)
        page.wait_for_timeout(700)
        page.get_by_role("button", name="Install 3.0").tap()
        at(page, "restarting")
    assert board.boot() != board.chooser.committed()
    device.server.stop()  # 3.0 never serves a page
    board.patience_s = 1
    assert "is not well" in board.run("settle", "3.0")
    assert board.boot() == board.chooser.committed()
    device.runs(before)
    back_inside(page)
    at(page, "went back")
    expect(page.locator(".update")).to_contain_text("The update did not work. The old version is running.")
    expect(page.locator(".update")).to_contain_text(f"Version {before} is running.")
    expect(page.locator(".update .alert")).to_contain_text("page: does not answer")


def test_a_tablet_sends_the_update(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("422")
    board, page = device.board, entered(open_page, device)
    write_entry(board.state, Entry())
    at(page, "none")
    content = board.bundle("nine.raucb", "9.0").read_bytes()
    (board.stick / "nine.raucb").unlink()
    with board.path_unit(device.version):
        page.set_input_files("input[type=file]", {"name": "x.raucb", "mimeType": "a/b", "buffer": content})
        expect(page.locator("li[data-id]", has_text="Sent from a tablet")).to_contain_text(
            "Version 9.0", timeout=90_000
        )
    page.set_input_files("input[type=file]", {"name": "x.raucb", "mimeType": "a/b", "buffer": b""})
    expect(page.locator(".alert")).to_have_attribute("data-code", "input")


def test_every_stage_and_every_refusal_has_words_that_fit(
    device: Device, open_page: Open, complaints: Complaints
) -> None:
    """The journal as the updater writes it; the page is the real one."""
    complaints.expect("422")
    page = entered(open_page, device)
    page.route("**/api/outbox", lambda route: route.fulfill(json={"waiting": 3}))
    boot = this_boot()
    stages = {
        "looking": {}, "fetching": {"share": 0.4}, "installing": {"share": 0.8}, "installed": {}, "trying": {},
        "committed": {"version": device.version}, "went back": {}, "refused": {}, "interrupted": {},
    }  # fmt: skip
    for state, more in stages.items():
        said = {"state": state, "version": "3.0", "before": "2.0", "boot": boot} | more
        write_entry(device.board.state, Entry.model_validate(said))
        at(page, "restarting" if state == "trying" else state)
        assert (state, look_for_faults(page)) == (state, [])
    write_entry(device.board.state, Entry(state="trying", version="3.0", boot="of another start"))
    at(page, "lost")
    expect(page.locator(".update")).to_contain_text("did not finish starting, or lost power")
    for kind in LEAVES:
        trouble = Trouble.of(kind("version 3.0 needs 2.5 or newer, and 2.0 runs"))
        found = (FOUND, FOUND.model_copy(update={"name": LONG, "trouble": trouble}))
        write_entry(device.board.state, Entry(state="refused", looked=True, trouble=trouble, found=found))
        alert = page.locator(f".alert[data-code='{kind.code}']")
        expect(alert).to_contain_text(kind.default_remedy)
        assert kind is UpdateError or alert.locator("strong").inner_text() not in trouble.message
    expect(page.locator("#unsent")).to_contain_text("3 people wait to be sent. They stay on this camera")
    assert faults(page) == []
