"""The exam page on the real server with the simulated head: whole exam, restart, lost connection."""

import gzip
import json
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, Response, expect

from tests.browser.conftest import Complaints, Server
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.readme_pictures import LABELS, labels
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    double_tap,
    finish_early,
    new_person,
    stay,
    tap,
    wait_for_preview,
    wait_for_release,
)

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"


def live_after(page: Page, number: int, limit_s: float = 5) -> None:
    """Wait until another frame than `number` is drawn; a polled script would need unsafe-eval."""
    expect(page.locator("eye-live")).not_to_have_attribute("data-frame", str(number), timeout=1000 * limit_s)


def a_new_person(page: Page, complaints: Complaints) -> Page:
    """Aim at the first slot of a new patient, on a server that may be starting or whose last page has just closed."""
    complaints.expect("404")
    page.wait_for_selector("#new")
    if page.evaluate("fetch('/api/programme').then((answer) => answer.status)") != 200:
        pytest.skip("this server keeps no visits")
    page.locator(".state[data-state=aim]").wait_for(state="attached", timeout=300_000)
    wait_for_release(page)
    new_person(page)
    return page


def press(page: Page, complaints: Complaints, how: Callable[[], None]) -> None:
    """Press the shutter; if the light guard requires a pause, wait and press again."""
    complaints.expect("423")
    for _ in range(5):
        after_debounce(page)
        how()
        stay(page)
        page.wait_for_selector("[data-phase=kept], [data-screen=aim]")
        if page.locator("[data-phase=kept]").count():
            return
        page.wait_for_timeout(1500)
        ok = page.locator("[data-do=ok]")
        if ok.count():
            ok.first.tap()
    raise AssertionError(f"no picture after five presses: {page.locator('.prompt').all_inner_texts()}")


@pytest.fixture
def page(page: Page, complaints: Complaints) -> Page:
    """A tablet page on the real server, aiming at the first slot of a new patient."""
    return a_new_person(page, complaints)


def test_readme_shows_the_labels_of_the_page(page: Page, complaints: Complaints) -> None:
    shown = json.loads(LABELS.read_text())
    assert labels(page) == shown["aim"], "make page-pictures"
    press(page, complaints, page.locator(SHUTTER).tap)
    page.wait_for_selector(".stage[data-mark=final]")
    # A busy computer may have no time for the colour.
    in_colour = ["Colour" if label == "Original" else label for label in labels(page)]
    assert in_colour == shown["result"], "make page-pictures"


def test_capture_and_viewer_by_touch(page: Page, complaints: Complaints) -> None:
    first = wait_for_preview(page)
    live_after(page, first)
    live_after(page, wait_for_preview(page))
    assert wait_for_preview(page) > first + 1
    expect(page.locator("header .chip")).to_have_text("SIMULATED")
    page.locator("[data-slot=L-centre]").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    # The page records the marks itself: a quick look may last less than one poll.
    page.evaluate("""() => {
        window.marks = [];
        new MutationObserver(() => window.marks.push(document.querySelector(".stage").dataset.mark))
            .observe(document.querySelector(".stage"), { attributes: true, attributeFilter: ["data-mark"] });
    }""")
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    marks = page.evaluate("window.marks")
    assert [mark for mark in marks if mark != "none"] == ["quick", "final"]
    expect(page.locator("#result-title")).to_have_text(re.compile("Good|Take again"))
    assert page.locator("#picture").evaluate(BRIGHT_SHARE) > 0.2, "the final picture is not black"

    box = page.locator("#picture").bounding_box()
    assert box is not None
    double_tap(page, box["x"] + box["width"] * 0.4, box["y"] + box["height"] * 0.4)
    expect(page.locator("#picture")).to_have_attribute("data-zoom", "3.00")
    page.get_by_role("button", name="Red-free").tap()
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Whole picture").tap()
    expect(page.locator("#picture")).to_have_attribute("data-zoom", "1.00")

    thumbnail = page.locator("[data-slot=L-centre] img")
    expect(thumbnail).to_have_attribute("src", re.compile("OS"))
    finish_early(page)
    expect(page.locator(".outcome .verdict")).to_contain_text(re.compile("Refer|Send"))
    tap(page, "#done")
    tap(page, "#history")
    page.wait_for_selector("[data-visit]")


BRIGHT_SHARE = """el => {
    const c = el.querySelector("canvas");
    const { data } = c.getContext("2d").getImageData(0, 0, c.width, c.height);
    let bright = 0;
    for (let i = 0; i < data.length; i += 4) bright += data[i] > 40;
    return bright / (data.length / 4);
}"""


def test_captures_survive_server_restart(page: Page, server: Server, complaints: Complaints) -> None:
    complaints.expect("ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_INCOMPLETE_CHUNKED", "ERR_EMPTY_RESPONSE")
    complaints.expect("ERR_CONTENT_LENGTH_MISMATCH")
    wait_for_preview(page)
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    tap(page, "#again")
    taken = page.locator("[data-slot=R-centre] img").get_attribute("src")
    server.stop()
    expect(page.get_by_role("alert")).to_be_visible(timeout=6000)
    server.start()
    server.wait_until_ready()
    expect(page.get_by_role("alert")).to_have_count(0, timeout=8000)  # without a tap
    frame = wait_for_preview(page)
    live_after(page, frame, limit_s=60)  # the server makes new FFT plans first
    page.reload()
    expect(page.locator("[data-slot=R-centre] img")).to_have_attribute("src", taken or "")
    tap(page, "[data-slot=R-centre]")
    page.wait_for_selector(".stage[data-mark=final]")


def test_press_during_other_captures_shows_busy_alert(page: Page, complaints: Complaints) -> None:
    complaints.expect("409", "423")
    wait_for_preview(page)
    # A client that requests a capture every 50 ms keeps both places in the queue taken for seconds.
    page.evaluate("""() => {
        const controller = sessionStorage.getItem("diffuscope.controller"); // the page holds the control lease
        const headers = { "Content-Type": "application/json", "X-Controller": controller };
        let left = 40;
        const again = setInterval(() => {
            const key = (left + 256).toString(16).padStart(16, "0");
            fetch("/api/captures", { method: "POST", headers, body: JSON.stringify({ eye: "OS", key }) });
            if (!--left) clearInterval(again);
        }, 50);
    }""")
    page.wait_for_timeout(800)
    expect(page.get_by_role("status")).to_contain_text("A picture is being taken")
    page.locator(SHUTTER).tap(force=True)
    expect(page.locator("[data-code=busy]")).to_contain_text("Wait until it is done")
    expect(page.locator(".state")).to_have_text("Ready")


def test_frozen_server_alert_begins_within_5_s_and_ends_within_3_s(
    page: Page, server: Server, complaints: Complaints
) -> None:
    wait_for_preview(page)
    expect(page.locator(".state")).not_to_have_text("Connecting")
    server.signal(signal.SIGSTOP)
    try:
        began = time.monotonic()
        expect(page.get_by_role("alert")).to_be_visible(timeout=7000)
        assert time.monotonic() - began < 5
        assert page.locator("eye-live canvas").evaluate("c => getComputedStyle(c).opacity") == "0.3"
        expect(page.locator("eye-live .age")).to_be_visible()
        page.wait_for_timeout(1500)
    finally:
        server.signal(signal.SIGCONT)
    began = time.monotonic()
    expect(page.get_by_role("alert")).to_have_count(0, timeout=6000)
    assert time.monotonic() - began < 3
    frame = wait_for_preview(page)
    # If the lamp was lit during SIGSTOP, the light guard requires an equal pause.
    live_after(page, frame, limit_s=20)


def test_every_result_control_is_reachable_by_keyboard(page: Page, complaints: Complaints) -> None:
    wait_for_preview(page)
    page.wait_for_selector(".state[data-state=aim]")
    press(page, complaints, lambda: page.locator(SHUTTER).press("Enter"))
    page.wait_for_selector(".stage[data-mark=final]")
    reached = []
    for _ in range(40):
        page.keyboard.press("Tab")
        what = page.evaluate("""() => {
            const el = document.activeElement;
            const line = getComputedStyle(el);
            const name = el.ariaLabel ?? el.textContent.trim().replace(/\\s+/g, " ");
            return [name, line.outlineStyle, parseFloat(line.outlineWidth)];
        }""")
        reached.append(what[0])
        assert what[0] == "" or (what[1] == "solid" and what[2] >= 4), f"no visible focus on {what}"
        if what[0].startswith("Finish with"):
            break
    names = " | ".join(reached)
    for name in (
        "Details",
        "Red-free",
        "More contrast",
        "Zoom in",
        "Whole picture",
        "Take again",
        "L · Optic disc, Left eye",
    ):
        assert name in names


def test_first_load_size_and_content_security_policy(open_page: Open, server: Server) -> None:
    page = open_page("about:blank")
    answers: list[Response] = []
    page.on("response", lambda answer: answers.append(answer))
    page.goto(server.url)
    page.wait_for_selector("#new")
    static = [answer for answer in answers if "/api/" not in answer.url]
    names = [answer.url.removeprefix(server.url) for answer in static]
    assert len(names) == len(set(names)) <= 4, "the page, its sheet, its module, an icon: each is asked for once"
    assert len(answers) <= 12, "and then what the instrument says: more would keep the live picture waiting"
    assert {answer.headers["content-encoding"] for answer in static} == {"gzip"}
    on_demand = gzip.compress((WEB / "vendor" / "lean-qr-nano.mjs").read_bytes())
    assert sum(int(answer.headers["content-length"]) for answer in static) + len(on_demand) <= 56 * 1024
    assert all(answer.url.startswith(server.url) for answer in answers)
    rules = static[0].headers["content-security-policy"]
    for rule in ("default-src 'none'", "script-src 'self'", "style-src 'self'", "require-trusted-types-for 'script'"):
        assert rule in rules
    assert "unsafe" not in rules


@pytest.mark.parametrize("size", [SIZES["phone"], SIZES["small"]], ids=["phone", "small"])
def test_result_fits_small_screens(
    open_page: Open, server: Server, complaints: Complaints, size: tuple[int, int]
) -> None:
    page = a_new_person(open_page(server.url, size), complaints)
    assert look_for_faults(page, SHUTTER) == []
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    assert look_for_faults(page, "#again") == []


def test_reload_uses_cached_static_files(open_page: Open, server: Server) -> None:
    page = open_page(server.url)
    page.wait_for_selector("#new")
    page.reload()
    page.wait_for_selector("#new")
    kept = page.evaluate(
        "performance.getEntriesByType('resource').filter(({ name }) => name.includes('/web/'))"
        ".map(({ transferSize }) => transferSize)"
    )
    assert len(kept) >= 2
    assert set(kept) == {0}, "the browser has them, and their address says that they are the same"
