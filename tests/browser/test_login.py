"""Set-up, sign-in, lock, users, erasure: by keyboard, without accessibility faults, over the kept state."""

import json
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from device.clock import SystemClock
from services.identity.setup_code import SetupCode
from services.identity.users import FOLDER, UserTable
from tests.browser.axe import axe_faults
from tests.browser.conftest import Complaints, Server
from tests.browser.looks import look_for_faults
from tests.simulated import small_head_toml

Open = Callable[..., Page]
PIN = "274913"
PRESS_MS = 700  # a press within this time after another one, or after the page has changed by itself, does not count
SIZES = ((1280, 800), (360, 740), (800, 1280))


@pytest.fixture
def own_server(tmp_path: Path) -> Iterator[Server]:
    """A server of its own, since its users are those of one test; with a small head it starts sooner."""
    (tmp_path / "head.toml").write_text(small_head_toml("Small head", summed=2))
    server = Server(tmp_path / "data", str(tmp_path / "head.toml"))
    server.start()
    server.wait_until_ready()
    yield server
    server.close()


def faults(page: Page) -> list[str]:
    found = []
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(100)
        found += [f"{width}: {fault}" for fault in look_for_faults(page)]
    return found + axe_faults(page)


def sign_in(page: Page, name: str, pin: str = PIN) -> None:
    """Sign in by keyboard only."""
    expect(page.locator("dialog.login")).to_be_visible(timeout=20_000)
    page.locator("dialog.login [name=name]").fill(name)
    page.locator("dialog.login [name=secret]").focus()
    page.keyboard.type(pin)
    page.keyboard.press("Enter")


def test_users_sign_in_lock_and_are_managed(own_server: Server, open_page: Open, complaints: Complaints) -> None:
    complaints.expect("401", "403", "422")
    page = open_page(own_server.url)
    page.wait_for_selector("#new")
    expect(page.locator("dialog.login")).to_have_count(0)  # the demonstration
    page.locator("#new").tap()
    page.wait_for_selector("[data-screen=patient]")
    before = page.url
    UserTable(own_server.data / FOLDER).add("Asha", PIN, ["administrator", "screener", "technician"])
    page.keyboard.press("Tab")
    expect(page.locator("dialog.login")).to_be_visible(timeout=20_000)
    page.keyboard.press("Escape")
    expect(page.locator("dialog.login")).to_be_visible()
    assert faults(page) == []
    sign_in(page, "Asha", "000000")
    expect(page.locator("dialog.login [role=alert]")).to_contain_text("do not belong together")
    page.wait_for_timeout(1100)
    sign_in(page, "asha")
    expect(page.locator("dialog.login")).to_be_hidden()
    assert page.url == before

    page.wait_for_timeout(PRESS_MS)
    page.locator("#open-menu").tap()
    page.locator("#own-secret").tap()
    for name, pin in (("secret", PIN), ("new", "918274"), ("again", "918275")):
        page.locator(f"dialog.login [name={name}]").fill(pin)
    assert faults(page) == []
    page.keyboard.press("Enter")
    expect(page.locator("dialog.login [role=alert]")).to_contain_text("differ")
    page.wait_for_timeout(PRESS_MS)
    page.locator("dialog.login [name=again]").fill("918274")
    page.keyboard.press("Enter")
    expect(page.locator("dialog.login")).to_be_hidden()
    assert UserTable(own_server.data / FOLDER).verify("Asha", "918274") is not None

    page.goto(f"{own_server.url}/technician")
    page.locator("[data-section=users]").tap()
    users = page.locator("instrument-users")
    expect(users).to_contain_text("Asha")
    users.locator("[name=name]").fill("Ravi")
    users.locator("[name=role][value=reader]").check()
    users.locator("[name=secret]").fill(PIN)
    users.locator("[name=again]").fill("918274")
    users.locator("[type=submit]").tap()
    expect(users.locator("[role=alert]")).to_contain_text("differ")
    users.locator("[name=again]").fill(PIN)
    users.locator("[type=submit]").tap()
    expect(users.locator("[role=status]")).to_contain_text("Ravi was added")
    assert faults(page) == []
    page.locator("[data-section=audit]").tap()
    audit = page.locator("instrument-audit")
    expect(audit).to_contain_text("add-user")
    expect(audit.locator("[role=status]")).to_contain_text("as they were written")
    audit.locator("[name=action]").fill("sign-in")
    audit.locator("[type=submit]").tap()
    expect(audit.locator("li")).to_have_count(2)
    assert faults(page) == []
    page.locator("#lock").tap()
    expect(page.locator("dialog.login")).to_be_visible()


def test_a_new_device_is_set_up_with_its_code(own_server: Server, open_page: Open, complaints: Complaints) -> None:
    """The request comes through a proxy, so that the page is that of no demonstration."""
    complaints.expect("401", "403", "429")
    page = open_page(own_server.url, extra_http_headers={"X-Forwarded-For": "10.42.0.7"})
    dialog = page.locator("dialog.login")
    expect(dialog).to_contain_text("Set up this device", timeout=20_000)
    assert faults(page) == []
    dialog.locator("[name=code]").fill(SetupCode(own_server.data / "tls", SystemClock()).create())
    dialog.locator("[name=name]").fill("Asha")
    for name in ("secret", "again"):
        dialog.locator(f"[name={name}]").fill(PIN)
    page.keyboard.press("Enter")
    expect(dialog).to_be_hidden(timeout=20_000)
    page.locator("#open-menu").tap()
    expect(page.locator("#menu")).to_contain_text("Signed in: Asha")


def test_a_forgotten_pin_is_replaced_with_the_code(own_server: Server, open_page: Open, complaints: Complaints) -> None:
    """This head has no button: the code and the screen of the device suffice."""
    complaints.expect("401", "403", "429")
    users = UserTable(own_server.data / FOLDER)
    users.add("Asha", PIN, ["administrator"])
    page = open_page(own_server.url)
    dialog = page.locator("dialog.login")
    expect(dialog.locator("#forgotten")).to_be_visible(timeout=20_000)
    assert faults(page) == []
    dialog.locator("[name=secret]").fill("000000")
    dialog.locator("#forgotten").tap()
    expect(dialog).to_contain_text("hold the camera's button")
    expect(dialog.locator("[name=secret]")).to_have_value("")
    assert faults(page) == []
    page.keyboard.press("Escape")
    expect(dialog.locator("#forgotten")).to_be_visible()
    page.wait_for_timeout(PRESS_MS)
    dialog.locator("#forgotten").tap()
    dialog.locator("[name=code]").fill(SetupCode(own_server.data / "tls", SystemClock()).create())
    dialog.locator("[name=name]").fill("asha")
    for name in ("secret", "again"):
        dialog.locator(f"[name={name}]").fill("918274")
    page.keyboard.press("Enter")
    expect(dialog).to_be_hidden(timeout=20_000)
    assert users.verify("Asha", "918274") is not None


def test_an_administrator_erases_a_patient_and_stores_the_receipt(
    own_server: Server, open_page: Open, complaints: Complaints
) -> None:
    complaints.expect("401", "403", "404")
    body = json.dumps({"key": "1" * 16, "number": "ZQ-77120"}).encode()
    begin = urllib.request.Request(f"{own_server.url}/api/visits", body, {"Content-Type": "application/json"})
    assert urllib.request.urlopen(begin, timeout=30).status == 201
    UserTable(own_server.data / FOLDER).add("Asha", PIN, ["administrator", "technician"])
    page = open_page(f"{own_server.url}/technician")
    sign_in(page, "Asha")
    page.locator("[data-section=erase]").tap()
    erasure = page.locator("patient-erasure")
    for number in ("ZQ-1", "zq-77120"):
        erasure.locator("[name=number]").fill(number)
        answered = erasure.get_by_text("No patient has this number" if number == "ZQ-1" else "Visits: 1.")
        while not answered.count():  # a press is not counted while the page, just signed in, still changes by itself
            page.wait_for_timeout(PRESS_MS)
            page.keyboard.press("Enter")
            page.wait_for_timeout(PRESS_MS)
    expect(erasure.locator("[role=alert]")).to_have_count(0)
    erasure.locator("[name=again]").fill("ZQ-77121")
    erasure.locator("[value=withdrawn]").check()
    page.wait_for_timeout(PRESS_MS)
    page.keyboard.press("Enter")
    expect(erasure.locator("[role=alert]")).to_contain_text("differ")
    assert faults(page) == []
    erasure.locator("[name=again]").fill("zq-77120")
    page.wait_for_timeout(PRESS_MS)
    page.keyboard.press("Enter")
    expect(erasure.locator("[role=status]")).to_contain_text("was erased")
    assert faults(page) == []
    with page.expect_download() as stored:
        page.wait_for_timeout(PRESS_MS)
        erasure.locator("#receipt").tap()
    receipt = json.loads(stored.value.path().read_bytes())
    assert (receipt["reason"], receipt["visits"]) == ("withdrawn", 1)
