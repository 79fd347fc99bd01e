"""Waiting and failing requests, viewer tools, and settings of the exam page."""

import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from playwright.sync_api import Page, expect

from device.head import open_head, recording_spec
from device.light_safety.dose_ledger import MemoryLedger
from tests.browser.conftest import Complaints, MakeReal
from tests.browser.pictures import show_colour_pictures
from tests.browser.real import MovableClock, Real
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    aiming,
    double_tap,
    new_person,
    take_picture,
    tap,
    wait_for_preview,
    wait_until_drawn,
)
from tests.journey.test_replay import blurred, psf_counts

pytestmark = pytest.mark.browser


def zoom(page: Page) -> float:
    return float(page.locator("#picture").get_attribute("data-zoom") or 0)


def middle_pixel(page: Page, dx: float = 0.0) -> list[int]:
    """Return the RGB value in the viewer, `dx` picture heights right of the centre."""
    script = """dx => {
        const c = document.querySelector("#picture canvas");
        const { data } = c.getContext("2d").getImageData(c.width / 2 + dx * c.height, c.height / 2, 1, 1);
        return [...data].slice(0, 3);
    }"""
    value: list[int] = page.evaluate(script, dx)
    return value


def test_final_picture_replaces_quick_look_and_keeps_view(open_page: Open, real: Real) -> None:
    real.hold = "quick"
    page = aiming(open_page, real)
    page.locator(SHUTTER).tap()
    page.wait_for_selector(".stage[data-mark=quick]")
    expect(page.get_by_role("status")).to_contain_text("Preview")
    bar = page.locator("progress").evaluate("bar => bar.value")
    page.get_by_role("button", name="Red-free").tap()
    page.get_by_role("button", name="Zoom in").tap()
    page.get_by_role("button", name="Zoom in").tap()
    assert zoom(page) == 2.25
    assert page.locator(".stage").get_attribute("data-mark") == "quick"
    real.hold = "stored"
    expect(page.locator("progress")).not_to_have_js_property("value", bar)
    assert page.locator("progress").evaluate("bar => bar.value") > bar
    real.hold = None
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.get_by_role("status")).to_contain_text("Final picture, saved")
    assert zoom(page) == 2.25
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "true")


def test_red_free_and_contrast_change_what_is_drawn(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    show_colour_pictures(page)
    take_picture(page)
    wait_until_drawn(page, "colour 0 0")
    red, green, blue = middle_pixel(page)
    assert red > green > blue
    page.keyboard.press("g")
    wait_until_drawn(page, "red-free 0 0")
    assert middle_pixel(page) == [green] * 3
    bright = middle_pixel(page, 0.235)[0]
    page.keyboard.press("+")
    wait_until_drawn(page, "red-free 0 1")
    assert middle_pixel(page, 0.235)[0] > bright, "more contrast makes the bright nerve head brighter"
    expect(page.get_by_text("Contrast +1")).to_be_visible()
    page.keyboard.press("0")
    wait_until_drawn(page, "red-free 0 0")
    assert middle_pixel(page) == [green] * 3


def test_pinch_wheel_and_keys_zoom_from_1_to_8(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    box = page.locator("#picture").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *xs: float) -> None:
        points: list[dict[str, Any]] = [{"x": at, "y": y, "id": i} for i, at in enumerate(xs)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", x - 50, x + 50)
    for spread in (70, 90, 110, 150):
        fingers("touchMove", x - spread, x + spread)
    fingers("touchEnd")
    assert zoom(page) == pytest.approx(3, rel=0.05)
    double_tap(page, x + 40, y)
    assert zoom(page) == 1
    double_tap(page, x + 40, y)
    assert zoom(page) == 3
    page.mouse.move(x, y)
    for _ in range(20):
        page.mouse.wheel(0, -200)
    expect(page.locator("#picture")).to_have_attribute("data-zoom", "8.00")
    page.locator("#picture").focus()
    page.keyboard.press("ArrowLeft")
    for _ in range(12):
        page.keyboard.press("-")
    assert zoom(page) == 1
    page.keyboard.press("+")
    assert zoom(page) == 1.5
    page.keyboard.press("0")
    assert zoom(page) == 1


def test_refused_request_shows_server_message(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("409")
    page = aiming(open_page, real)
    real.hold = "expose"
    with ThreadPoolExecutor(1) as other:
        made = other.submit(real.request, "POST", "/api/captures", eye="OD")
        expect(page.locator(".state")).to_have_attribute("data-state", "busy")
        page.locator(SHUTTER).tap(force=True)
        bar = page.get_by_role("status")
        expect(bar).to_contain_text("A picture is being taken")
        expect(bar).to_contain_text("Wait until it is done, then press again.")
        real.hold = None
        made.result(30)
    expect(page.locator(SHUTTER)).to_have_attribute("aria-disabled", "false")
    take_picture(page)
    expect(page.locator(".state-bar")).to_have_count(0)


def test_second_press_during_capture_is_ignored(open_page: Open, real: Real) -> None:
    real.hold = "expose"  # from the quick look on the shutter is replaced
    page = aiming(open_page, real)
    page.locator(SHUTTER).dblclick()
    after_debounce(page).locator(SHUTTER).tap(force=True)
    expect(page.get_by_role("status")).to_contain_text("still being processed")
    real.hold = None
    page.wait_for_selector(".stage[data-mark=final]")
    assert real.presses == 1


def test_a_double_tap_on_next_takes_no_picture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    box = after_debounce(page).locator("#next").bounding_box()
    assert box is not None
    for _ in range(2):
        page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator(SHUTTER)).to_contain_text("Optic disc")
    page.wait_for_timeout(300)
    assert real.presses == 1


def test_first_tap_of_a_page_counts(open_page: Open, real: Real) -> None:
    """The button is tapped as soon as it is drawn; a second tap at its place within 0.4 s does not count."""
    page = open_page("about:blank")
    page.add_init_script("""
        const tap = (button) => {
          const { x, y } = button.getBoundingClientRect();
          const at = { bubbles: true, cancelable: true, detail: 1, clientX: x + 5, clientY: y + 5 };
          button.dispatchEvent(new MouseEvent("click", at));
        };
        addEventListener("DOMContentLoaded", () => new MutationObserver((_, observer) => {
          const button = document.querySelector("#new");
          if (!button) return;
          observer.disconnect();
          tap(button);
          tap(button);
        }).observe(document.querySelector("#app"), { childList: true, subtree: true }));
    """)
    page.goto(real.url)
    page.wait_for_selector(".patient")
    page.wait_for_timeout(300)
    assert len(real.visits()) == 1


def test_double_tap_on_new_patient_begins_one_visit(open_page: Open, real: Real) -> None:
    page = after_debounce(open_page(real.url))
    page.locator("#new").dblclick()
    page.wait_for_selector(".patient")
    page.wait_for_timeout(300)
    assert len(real.visits()) == 1


def test_error_without_message_shows_default_text(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("500")
    page = aiming(open_page, real)
    page.route("**/api/captures", lambda route: route.fulfill(status=500, json={}))
    page.locator(SHUTTER).tap()
    expect(page.get_by_role("status")).to_contain_text("try again")


def test_a_recording_is_marked_on_every_screen(open_page: Open, make_real: MakeReal, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "raw.tiff", np.rint(blurred()).astype(np.uint16))
    tifffile.imwrite(tmp_path / "psf.tiff", psf_counts())
    clock = MovableClock()
    recording = open_head(recording_spec(tmp_path), clock, MemoryLedger(clock))
    real = make_real(head=lambda head: recording)
    page = open_page(real.url)
    expect(page.locator("header .chip")).to_have_text("RECORDING")
    new_person(page)
    expect(page.locator("header .chip")).to_have_text("RECORDING")


def test_old_live_frame_shows_its_age(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    real.rig.block_exposures()
    expect(page.locator("eye-live .age")).to_have_text(re.compile(r"^[2-9]\.\d seconds late$"))
    real.clock.gate.set()
    expect(page.locator("eye-live .age")).to_be_hidden()
    page.route("**/api/preview?*", lambda route: None)
    expect(page.locator("[data-code='link.slow']")).to_contain_text(re.compile(r"\d s late"))
    page.unroute("**/api/preview?*")
    expect(page.locator("[data-code='link.slow']")).to_have_count(0)


def test_no_old_frame_and_no_lateness_where_there_is_no_live_picture(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    real.rig.block_exposures()  # the camera gives no frame; the server answers in time
    expect(page.locator("eye-live .age")).to_have_text(re.compile(r"^[4-9]\.\d seconds late$"))
    expect(page.locator("[data-code='link.slow']")).to_have_count(0)
    tap(page, "#not-possible")
    expect(page.locator(".prompt .title")).to_have_text("Right eye · Macula")
    expect(page.locator("eye-live")).to_have_css("visibility", "hidden")
    with page.expect_response("**/api/preview?*"):  # the server's last frame, which is old
        page.locator("#not-asked").tap()
    page.wait_for_timeout(300)  # to decode it
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)
    real.clock.gate.set()
    wait_for_preview(page)
    page.route("**/api/preview?*eye=OS*", lambda route: None)
    page.locator("[data-slot='L-centre']").tap()
    expect(page.locator(SHUTTER)).to_contain_text("Left eye")
    expect(page.locator("eye-live[data-frame]")).to_have_count(0)  # the frame of the right eye is gone


def test_the_button_on_the_handle_takes_the_picture_of_the_page_that_aims(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    real.event_bus.publish("button")
    expect(page.locator("[data-phase=kept] #result-title")).to_be_visible(timeout=30_000)
    real.event_bus.publish("button")
    page.goto(f"{real.url}/#/")
    expect(page.locator("#continue, #start").first).to_be_visible()
    real.event_bus.publish("button")
    page.wait_for_timeout(500)  # for a press that must not come
    assert len(real.request("GET", "/api/captures")) == 1


def test_warnings_about_a_picture_are_shown_with_it(open_page: Open, real: Real) -> None:
    real.show("saturated")
    page = aiming(open_page, real, (800, 1280))
    take_picture(page)
    details = page.get_by_role("button", name="Details: with a warning")
    heights = "title => [title.offsetHeight, parseFloat(getComputedStyle(title).fontSize)]"
    height, letter = page.locator("#result-title").evaluate(heights)
    assert height < 2 * letter, "the verdict has one line beside the button"
    details.tap()
    expect(page.locator("#details")).to_contain_text("of the frame cannot be used (saturated")
    plan = real.rig.world.plan
    simulated = [decision.name for decision in plan if decision.simulated]
    effects = page.locator("#details dt:has-text('Simulated effects') + dd")
    expect(effects).to_have_text(f"{len(simulated)} of {len(plan)}: {', '.join(simulated)}")


def test_heartbeat_timeout_disables_shutter(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    expect(page.locator(".state")).to_have_text("Ready")
    with real.frozen():
        began = time.monotonic()
        expect(page.get_by_role("alert")).to_contain_text("Trying again", timeout=6000)
        assert 2 < time.monotonic() - began < 5
        expect(page.locator(SHUTTER)).to_contain_text("No link")
        page.locator(SHUTTER).tap(force=True)
        page.wait_for_timeout(200)
    expect(page.get_by_role("alert")).to_have_count(0, timeout=3000)
    assert real.presses == 0, "a press into a dead link must not fire later"


def test_theme_is_stored(open_page: Open, real: Real) -> None:
    page = open_page(real.url)
    expect(page.locator("html")).to_have_attribute("data-theme", "dim")
    page.get_by_role("button", name="Menu").tap()
    page.get_by_role("button", name="Light").tap()
    page.get_by_role("button", name="Close").tap()
    page.reload()
    expect(page.locator("html")).to_have_attribute("data-theme", "daylight")


def test_letter_keys_can_be_disabled(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    page.get_by_role("button", name="Menu").tap()
    page.get_by_text("Keys", exact=True).tap()
    page.locator("#letters").uncheck()
    page.get_by_role("button", name="Close").tap()
    take_picture(page)
    page.keyboard.press("g")
    expect(page.get_by_role("button", name="Red-free")).to_have_attribute("aria-pressed", "false")


def test_failed_module_import_is_retried(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("ERR_FAILED")
    page = open_page(real.url)
    page.wait_for_selector("#new")
    page.route("**/screens/history.js", lambda route: route.abort())
    with page.expect_event("requestfailed"):
        after_debounce(page).locator("#history").tap()
    page.unroute("**/screens/history.js")
    after_debounce(page).locator("#back").tap()
    after_debounce(page).locator("#history").tap()
    page.wait_for_selector(".history")


def test_reduced_motion_disables_transitions(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, reduced_motion="reduce")
    assert page.locator(SHUTTER).evaluate("b => getComputedStyle(b).transitionDuration") == "0s"
    take_picture(page)
