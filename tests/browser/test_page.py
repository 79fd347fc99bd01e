"""A health worker with a tablet, on the real server with the simulated head: the whole way, and the link cut."""

import gzip
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, Response, expect

from tests.browser.conftest import Complaints, Server
from tests.browser.looks import SIZES, look_for_faults

pytestmark = pytest.mark.browser

SHUTTER = "#shutter"
WEB = Path(__file__).parents[2] / "web"
Open = Callable[..., Page]


def live(page: Page) -> int:
    """Wait for a live picture; its number."""
    page.wait_for_selector("eye-live[data-frame]")
    return int(page.locator("eye-live").get_attribute("data-frame") or 0)


def live_after(page: Page, number: int, limit_s: float = 5) -> None:
    """Wait until another live picture than `number` is drawn; a string polled in the page would need unsafe-eval."""
    expect(page.locator("eye-live")).not_to_have_attribute("data-frame", str(number), timeout=1000 * limit_s)


def press(page: Page, complaints: Complaints, how: Callable[[], None]) -> None:
    """Press, and if the guard wants darkness first, do as its words say: wait, and press again."""
    complaints.expect("423")
    for _ in range(5):
        how()
        page.wait_for_selector("[data-screen=making]")
        page.wait_for_selector("[data-screen=result], [data-screen=aim]", timeout=30_000)
        if page.locator("[data-screen=result]").count():
            return
        page.wait_for_timeout(1500)
    raise AssertionError(f"no picture after five presses: {page.locator('.alert').all_inner_texts()}")


def kept(page: Page) -> list[str]:
    """The names of the captures in the list, newest first."""
    names: list[str] = page.locator(".strip button").evaluate_all("all => all.map((one) => one.dataset.id)")
    return names


def test_from_aiming_to_the_list_by_touch(page: Page, server: Server, complaints: Complaints) -> None:
    first = live(page)
    live_after(page, first)
    live_after(page, live(page))
    assert live(page) > first + 1
    expect(page.locator("header .chip")).to_have_text("SIMULATED")
    page.get_by_role("button", name="Left eye (OS)").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Left eye (OS)")
    before = len(kept(page))
    # The order of the marks is written down by the page itself: a quick look may be there for less than a poll.
    page.evaluate("""() => {
        window.marks = [];
        new MutationObserver(() => window.marks.push(document.querySelector(".stage").dataset.mark))
            .observe(document.querySelector(".stage"), { attributes: true, attributeFilter: ["data-mark"] });
    }""")
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    marks = page.evaluate("window.marks")
    assert [mark for mark in marks if mark != "none"] == ["quick", "final"]
    expect(page.locator("#result-title")).to_have_text("Left eye (OS)")
    assert page.locator("eye-pic").evaluate(BRIGHT_SHARE) > 0.2, "the final picture is not black"

    box = page.locator("eye-pic").bounding_box()
    assert box is not None
    for _ in range(2):
        page.touchscreen.tap(box["x"] + box["width"] * 0.4, box["y"] + box["height"] * 0.4)
    expect(page.locator("eye-pic")).to_have_attribute("data-zoom", "3.00")
    page.get_by_role("button", name="Red-free").tap()
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Show all").tap()
    expect(page.locator("eye-pic")).to_have_attribute("data-zoom", "1.00")

    names = kept(page)
    assert len(names) == before + 1
    assert "OS" in names[0]
    page.locator("#next").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Right eye (OD)")
    page.wait_for_timeout(700)
    page.locator(".strip button").first.tap()
    page.wait_for_selector(".stage[data-mark=final]")
    page.get_by_role("button", name="Back to the live picture").tap()
    live(page)


BRIGHT_SHARE = """el => {
    const c = el.querySelector("canvas");
    const { data } = c.getContext("2d").getImageData(0, 0, c.width, c.height);
    let bright = 0;
    for (let i = 0; i < data.length; i += 4) bright += data[i] > 40;
    return bright / (data.length / 4);
}"""


def test_what_was_taken_is_still_there_after_a_restart(page: Page, server: Server, complaints: Complaints) -> None:
    complaints.expect("ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_INCOMPLETE_CHUNKED", "ERR_EMPTY_RESPONSE")
    live(page)
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    page.locator("#again").tap()
    before = kept(page)
    server.stop()
    expect(page.locator(".banner")).to_be_visible(timeout=6000)
    server.start()
    server.wait_until_ready()
    expect(page.locator(".banner")).to_have_count(0, timeout=8000)  # by itself; nothing to tap
    assert kept(page) == before
    frame = live(page)
    live_after(page, frame)
    page.reload()
    page.wait_for_selector(".strip button")
    assert kept(page) == before
    page.locator(".strip button").first.tap()
    page.wait_for_selector(".stage[data-mark=final]")


def test_a_press_while_somebody_else_takes_a_picture_is_refused_in_words(page: Page, complaints: Complaints) -> None:
    complaints.expect("409", "423")
    live(page)
    page.evaluate("""() => {
        const body = JSON.stringify({ eye: "OD", key: "00000000000000aa" });
        fetch("/api/captures", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    }""")
    expect(page.get_by_role("status")).to_contain_text("A picture is being taken")
    page.locator(SHUTTER).tap()
    expect(page.locator(".alert[data-code=busy]")).to_contain_text("Wait until it is done")
    expect(page.locator(".state")).to_have_text("Ready")


def test_a_frozen_server_is_told_within_five_seconds_and_forgotten_within_three(
    page: Page, server: Server, complaints: Complaints
) -> None:
    live(page)
    expect(page.locator(".state")).not_to_have_text("Connecting")
    server.signal(signal.SIGSTOP)
    try:
        began = time.monotonic()
        expect(page.locator(".banner")).to_be_visible(timeout=7000)
        assert time.monotonic() - began < 5
        assert page.locator("eye-live canvas").evaluate("c => getComputedStyle(c).opacity") == "0.3"
        expect(page.locator("eye-live .age")).to_be_visible()
        page.wait_for_timeout(1500)
    finally:
        server.signal(signal.SIGCONT)
    began = time.monotonic()
    expect(page.locator(".banner")).to_have_count(0, timeout=6000)
    assert time.monotonic() - began < 3
    frame = live(page)
    # If the lamp was lit when time stood still, the guard wants as much darkness first.
    live_after(page, frame, limit_s=20)


def test_the_whole_way_by_keyboard(page: Page, complaints: Complaints) -> None:
    live(page)
    page.wait_for_selector(".state[data-state=aim]")
    press(page, complaints, lambda: page.keyboard.press("Space"))
    page.wait_for_selector(".stage[data-mark=final]")
    page.keyboard.press("g")
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("+")
    expect(page.get_by_text("Contrast +1")).to_be_visible()
    page.keyboard.press("0")
    expect(page.get_by_text("Contrast", exact=True)).to_be_visible()
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
        if what[0].startswith("Next"):
            break
    names = " | ".join(reached)
    for name in ("Details", "Red-free", "More contrast", "Zoom in", "Show all", "Take again"):
        assert name in names
    page.keyboard.press("Enter")
    expect(page.locator(SHUTTER)).to_contain_text("Left eye (OS)")
    expect(page.locator(SHUTTER)).to_be_focused()


def test_the_first_load_is_small_and_strict(open_page: Open, server: Server) -> None:
    page = open_page("about:blank")
    answers: list[Response] = []
    page.on("response", lambda answer: answers.append(answer))
    page.goto(server.url)
    live(page)
    static = [answer for answer in answers if "/api/" not in answer.url]
    assert len(static) <= 12
    assert sum(len(gzip.compress(answer.body())) for answer in static) <= 60_000
    assert all(answer.url.startswith(server.url) for answer in answers)
    rules = static[0].headers["content-security-policy"]
    for rule in ("default-src 'none'", "script-src 'self'", "style-src 'self'", "require-trusted-types-for 'script'"):
        assert rule in rules
    assert "unsafe" not in rules


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES.keys())
def test_aiming_fits_every_screen(open_page: Open, server: Server, size: tuple[int, int]) -> None:
    page = open_page(server.url, size)
    live(page)
    assert look_for_faults(page, SHUTTER) == []


def test_the_result_fits_a_telephone(open_page: Open, server: Server, complaints: Complaints) -> None:
    page = open_page(server.url, SIZES["phone"])
    live(page)
    press(page, complaints, lambda: page.locator(SHUTTER).tap())
    page.wait_for_selector(".stage[data-mark=final]")
    assert look_for_faults(page, "#next", "#again") == []


def test_no_file_speaks_outside_the_words() -> None:
    """Texts for people live in words.js: a template has no letters of its own between its tags."""
    views = (WEB / "views.js").read_text()
    spoken = re.findall(r">\s*([A-Z][a-z]+(?: [a-z]+)+)\s*[<$]", views)
    assert spoken == []
