"""The update section on the real server with the real updater: installation, rollback, upload, errors."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from device.clock import boot_id
from services import errors
from services.errors import UpdateError
from services.update.ipc import FoundUpdate, StoredError, UpdateState, write_state
from tests.browser.conftest import Complaints, Server, copy_small_plans
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.test_calibration_wizard import CUT, HEAD, log_in
from tests.browser.test_technician_sections import open_section
from tests.updates import Board

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]  # a server is started four times

Open = Callable[..., Page]
UPDATE_ERRORS = sorted(
    {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, UpdateError)}, key=str
)
FOUND = FoundUpdate(
    id="0123456789abcdef", where="stick", stick="STICK", name="two.raucb", bytes=330_000_000, version="2.0"
)
LONG = "a_very_long_name_that_somebody_gave_to_an_update_without_a_single_blank_in_it_" + "x" * 22 + ".raucb"


@dataclass
class Device:
    """A server with software update, and its simulated board."""

    server: Server
    board: Board
    folder: Path
    version: str = ""

    def boot_version(self, version: str) -> None:
        """Restart the server with another version number."""
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
    server.more = ["--updates", str(board.state), "--update-requests", str(board.requests)]
    copy_small_plans(server.data)
    device = Device(server, board, folder)
    device.boot_version("1.0")
    yield device
    server.close()


def open_update(open_page: Open, device: Device) -> Page:
    page = open_page(f"{device.server.url}/technician", SIZES["portrait"])
    log_in(page)
    page.wait_for_timeout(700)
    open_section(page, "update")
    return page


def wait_for_state(page: Page, state: str) -> None:
    page.wait_for_selector(f".update[data-state='{state}']", timeout=120_000)
    page.wait_for_timeout(700)  # debounce of the page


def wait_for_restart(page: Page) -> None:
    """Wait until the page has an answer of the restarted instrument."""
    log_in(page)


def layout_faults(page: Page) -> list[str]:
    found = []
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(50)
        found += [f"{name}: {fault}" for fault in look_for_faults(page)]
    return found


def test_update_from_usb_drive(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("401", *CUT)
    board, page = device.board, open_update(open_page, device)
    wait_for_state(page, "none")
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
        wait_for_state(page, "installing")
        expect(page.locator(".update")).to_contain_text("Estimate: 1 to 4 minutes. No update was timed on this camera")
        expect(page.locator("progress")).to_have_js_property("value", 0.8)
        board.release()
        wait_for_state(page, "restarting")
    assert board.is_off
    assert board.boot() == "B"
    device.boot_version("2.0")
    wait_for_restart(page)
    wait_for_state(page, "trying")
    board.patience_s = 120  # a busy computer needs longer to become ready
    assert "is well, and committed" in board.run("settle", "2.0")
    wait_for_state(page, "committed")
    expect(page.locator(".update")).to_contain_text("Updated to 2.0.")
    expect(page.locator(".update")).to_contain_text("What is new")
    board.bundle("three.raucb", "3.0")
    with board.path_unit("2.0"):
        page.wait_for_timeout(700)
        page.locator("#look").tap()
        offered = page.locator("li", has_text="Version 3.0")
        expect(offered).to_contain_text(
            re.compile(r"The last update took \d+ minutes?\. The camera restarts automatically"), timeout=90_000
        )
    (board.stick / "three.raucb").unlink()


def test_unhealthy_version_is_rolled_back(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("401", *CUT)
    board, before, page = device.board, device.version, open_update(open_page, device)
    page.wait_for_timeout(700)
    board.bundle("old.raucb", "0.9")
    board.bundle("three.raucb", "3.0")
    with board.path_unit(before):
        page.locator("#look").tap()
        expect(page.locator("li[data-code='update.older']", has_text="0.9")).to_be_visible(timeout=90_000)
        page.wait_for_timeout(700)
        page.get_by_role("button", name="Install 3.0").tap()
        wait_for_state(page, "restarting")
    assert board.boot() != board.chooser.committed()
    device.server.stop()  # 3.0 never serves a page
    board.patience_s = 1
    assert "is not well" in board.run("settle", "3.0")
    assert board.boot() == board.chooser.committed()
    device.boot_version(before)
    wait_for_restart(page)
    wait_for_state(page, "went back")
    expect(page.locator(".update")).to_contain_text("The update did not work. The old version is running.")
    expect(page.locator(".update")).to_contain_text(f"Version {before} is running.")
    expect(page.locator(".update .alert")).to_contain_text("page: does not answer")


def test_update_is_uploaded_from_tablet(device: Device, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("422")
    board, page = device.board, open_update(open_page, device)
    write_state(board.state, UpdateState())
    wait_for_state(page, "none")
    content = board.bundle("nine.raucb", "9.0").read_bytes()
    (board.stick / "nine.raucb").unlink()
    with board.path_unit(device.version):
        page.set_input_files("input[type=file]", {"name": "x.raucb", "mimeType": "a/b", "buffer": content})
        expect(page.locator("li[data-id]", has_text="Sent from a tablet")).to_contain_text(
            "Version 9.0", timeout=90_000
        )
    page.set_input_files("input[type=file]", {"name": "x.raucb", "mimeType": "a/b", "buffer": b""})
    expect(page.locator(".alert")).to_have_attribute("data-code", "input")


def test_every_update_state_and_error_fits(device: Device, open_page: Open, complaints: Complaints) -> None:
    """The test writes the updater's journal; the page is the real one."""
    complaints.expect("422")
    page = open_update(open_page, device)
    page.route("**/api/upload-queue", lambda route: route.fulfill(json={"waiting": 3}))
    boot = boot_id()
    stages = {
        "looking": {},
        "fetching": {"share": 0.4},
        "installing": {"share": 0.8},
        "installed": {},
        "trying": {},
        "committed": {"version": device.version},
        "went back": {},
        "refused": {},
        "interrupted": {},
    }
    for state, more in stages.items():
        entry = {"state": state, "version": "3.0", "before": "2.0", "boot": boot} | more
        write_state(device.board.state, UpdateState.model_validate(entry))
        wait_for_state(page, "restarting" if state == "trying" else state)
        assert (state, look_for_faults(page)) == (state, [])
    write_state(device.board.state, UpdateState(state="trying", version="3.0", boot="of another start"))
    wait_for_state(page, "lost")
    expect(page.locator(".update")).to_contain_text("did not finish starting, or lost power")
    for kind in UPDATE_ERRORS:
        trouble = StoredError.of(kind("version 3.0 needs 2.5 or newer, and 2.0 runs"))
        found = (FOUND, FOUND.model_copy(update={"name": LONG, "trouble": trouble}))
        write_state(device.board.state, UpdateState(state="refused", looked=True, trouble=trouble, found=found))
        alert = page.locator(f".alert[data-code='{kind.code}']")
        expect(alert).to_contain_text(kind.default_remedy)
        assert kind is UpdateError or alert.locator("strong").inner_text() not in trouble.message
    expect(page.locator("#unsent")).to_contain_text("Pictures of 3 patients wait to be sent. They stay on this camera")
    assert layout_faults(page) == []
