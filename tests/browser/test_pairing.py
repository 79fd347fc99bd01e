"""A tablet is paired: label, pairing page, authority in the browser's own store, set-up, sign-in, a picture by TLS."""

import hashlib
import json
import os
import re
import shutil
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Error, Page, Playwright, expect, sync_playwright

from tests.browser.axe import axe_faults
from tests.browser.conftest import CHROMIUM, PATIENCE_MS, ROOT, Server, free_port
from tests.browser.looks import look_for_faults
from tests.browser.walk import new_person, take_picture
from tests.simulated import small_head_toml

PIN = "274913"
SIZES = ((1280, 800), (360, 740), (800, 1280))
APPLICATION_ONLY = "header", "[role=status]"  # landmarks that this page of text does not need
Launch = Callable[[Path], Browser]


class Device(Server):
    """`diffuscope run` open to the network, with the identity and certificate that `diffuscope label` made."""

    def __init__(self, data: Path, head: Path) -> None:
        super().__init__(data, str(head))
        self.pairing_port, self.ready_path = free_port(), "/"
        self.more = ["--host", "0.0.0.0", "--pairing-port", str(self.pairing_port)]
        self.https = f"https://127.0.0.1:{self.port}"
        self.url = f"http://127.0.0.1:{self.pairing_port}"

    def label(self) -> str:
        """Run `diffuscope label`, and return what it prints."""
        words = ["label", "--data", str(self.data), "--pairing-port", str(self.pairing_port)]
        command = [str(Path(sys.executable).parent / "diffuscope"), *words]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    folder = tmp_path / "device"
    folder.mkdir()
    (folder / "head.toml").write_text(small_head_toml("Small head", summed=2))
    device = Device(folder / "data", folder / "head.toml")
    device.label()
    device.start()
    device.wait_until_ready()
    yield device
    device.close()


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture
def launch(playwright: Playwright, undo: ExitStack) -> Launch:
    """A factory of browsers, each with the certificate store of a home folder."""

    def launched(home: Path) -> Browser:
        home.mkdir(exist_ok=True)
        place: dict[str, str | float | bool] = dict(os.environ) | {"HOME": str(home)}
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], env=place)
        undo.callback(browser.close)
        return browser

    return launched


def tablet(browser: Browser, size: tuple[int, int] = (800, 1280), language: str = "en-GB") -> Page:
    viewport = {"width": size[0], "height": size[1]}
    context: BrowserContext = browser.new_context(viewport=viewport, has_touch=True, locale=language)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    return page


def install(authority: Path, home: Path) -> None:
    """Put an authority into the store of a browser, as a user does in the settings of a tablet."""
    store = home / ".pki/nssdb"
    store.mkdir(parents=True)
    subprocess.run(["certutil", "-d", f"sql:{store}", "-N", "--empty-password"], check=True)
    words = ["-A", "-t", "C,,", "-n", "camera", "-i", str(authority)]
    subprocess.run(["certutil", "-d", f"sql:{store}", *words], check=True)


def asked(page: Page, path: str, body: str | None = None) -> dict[str, Any]:
    """Return the JSON answer to a request of the page, which uses the certificate store of its browser."""
    options = {} if body is None else {"method": "POST", "headers": {"Content-Type": "application/json"}, "body": body}
    return dict(page.evaluate("async ([path, options]) => (await fetch(path, options)).json()", [path, options]))


def press_until_focused(page: Page, selector: str) -> None:
    """Move the focus by Tab to an element; fail after 30 steps."""
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement?.matches(selector)", selector):
            return
    raise AssertionError(f"no focus on {selector}")


def test_the_pairing_page_explains_each_system_without_a_fault(device: Device, launch: Launch, tmp_path: Path) -> None:
    browser, faults = launch(tmp_path / "home"), []
    for language in ("en-GB", "hi-IN", "ta-IN", "te-IN"):
        page = tablet(browser, language=language)
        page.goto(device.url)
        expect(page.locator("main")).to_be_visible()
        assert page.locator("html").get_attribute("lang") == language[:2]
        assert page.locator("details").count() == 3
        for summary in page.locator("summary").all():
            summary.click()
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(100)
            found = [fault for fault in look_for_faults(page) if not fault.endswith(APPLICATION_ONLY)]
            faults += [f"{language} {width}: {fault}" for fault in found + axe_faults(page)]
    assert faults == []


@pytest.mark.skipif(shutil.which("certutil") is None, reason="certutil is not installed")
def test_a_tablet_is_refused_then_paired_set_up_and_takes_a_picture(
    device: Device, launch: Launch, tmp_path: Path
) -> None:
    """By keyboard only until the picture. Without the authority Chromium refuses, and the pairing page says why."""
    label = device.label()
    code = re.search(r"tries: (\w{4}-\w{4})$", label, re.M)
    assert code is not None
    assert "█" in label or "qrencode" in label
    pairing = f"{device.url}/#code={code[1]}"

    unpaired = launch(tmp_path / "unpaired")
    refused = tablet(unpaired)
    refused.goto(pairing)
    press_until_focused(refused, "#open")
    refused.keyboard.press("Enter")
    with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
        refused.wait_for_url(f"{device.https}/**")
    strange = tablet(unpaired)
    strange.goto(pairing)
    expect(strange.locator("main")).to_contain_text("Does the browser warn?")
    press_until_focused(strange, "[download]")
    with strange.expect_download() as saved:
        strange.keyboard.press("Enter")
    saved.value.save_as(tmp_path / "authority.crt")
    shown = strange.locator("#fingerprint").inner_text()
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert((tmp_path / "authority.crt").read_text())).hexdigest()
    assert shown.split() == re.findall("..", digest.upper())
    assert shown.replace(" ", "") in re.sub(r"\s", "", label)

    install(tmp_path / "authority.crt", tmp_path / "paired")
    page = tablet(launch(tmp_path / "paired"), (1280, 800))
    page.goto(pairing)
    press_until_focused(page, "#open")
    page.keyboard.press("Enter")
    dialog = page.locator("dialog.login")
    expect(dialog).to_contain_text("Set up this device")
    assert page.evaluate("isSecureContext")
    assert dialog.locator("[name=code]").input_value() == code[1], "from the fragment of the label"
    press_until_focused(page, "[name=name]")
    page.keyboard.type("Asha")
    for _ in range(2):
        page.keyboard.press("Tab")
        page.keyboard.type(PIN)
    page.keyboard.press("Enter")
    expect(dialog).to_be_hidden()
    [cookie] = page.context.cookies()
    assert (cookie["name"], cookie["secure"], cookie["httpOnly"]) == ("__Host-login", True, True)

    again = tablet(page.context.browser or launch(tmp_path / "paired"))
    again.goto(f"{device.https}/#code={code[1]}")
    expect(again.locator("dialog.login")).to_contain_text("Sign in")
    body = json.dumps({"name": "Eve", "secret": PIN, "code": code[1]})
    assert asked(again, "/api/setup", body)["code"] == "access.wrong", "the code was used"
    again.wait_for_timeout(1100)  # the wait after a wrong code
    assert "Forgotten PIN" in device.label()
    again.locator("[name=name]").fill("Asha")
    again.locator("[name=secret]").focus()
    again.keyboard.type(PIN)
    again.keyboard.press("Enter")
    expect(again.locator("dialog.login")).to_be_hidden()
    again.close()

    page.goto(device.https)
    new_person(page)
    take_picture(page)
    [capture] = asked(page, "/api/captures")["captures"]
    assert capture["simulated"]
