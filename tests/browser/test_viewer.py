"""Picture viewer: equal output of both renderers, WebGL self-test and fallback, loupe, loading on demand."""

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Locator, Page, Route, expect

from device.head import Head
from tests.browser.conftest import CHROMIUM, Complaints, MakeReal
from tests.browser.pictures import drawn_retina, show_colour_pictures
from tests.browser.real import Real
from tests.browser.walk import (
    SHUTTER,
    Open,
    after_debounce,
    aiming,
    loupe_position,
    stay,
    take_picture,
    tap,
    visit_of,
    wait_for_preview,
    wait_until_drawn,
)
from tests.journey.asking import with_all_chips
from tests.red_light import FailsInRed

pytestmark = pytest.mark.browser

BENCH = Path(__file__).with_name("viewer.js").read_text()
TOOLS = [
    {"redfree": redfree, "brightness": brightness, "contrast": contrast}
    for redfree, brightness, contrast in product((False, True), (-5, -1, 0, 2, 5), (-5, 0, 1, 5))
]
FALLBACK_MESSAGE = "Pictures are drawn without the graphics chip: "
PIXEL = """(pic, [dx, dy]) => {
    const c = pic.querySelector("canvas");
    const { data } = c.getContext("2d").getImageData(c.width / 2 + dx * c.height, c.height / 2 + dy * c.height, 1, 1);
    return [...data].slice(0, 3);
}"""

GREYNESS = """(image) => {
    const c = document.createElement("canvas");
    [c.width, c.height] = [image.naturalWidth, image.naturalHeight];
    c.getContext("2d").drawImage(image, 0, 0);
    const { data } = c.getContext("2d").getImageData(c.width / 2, c.height / 2, 1, 1);
    return Math.max(...data.slice(0, 3)) - Math.min(...data.slice(0, 3));
}"""


@pytest.fixture
def bench(open_page: Open, real: Real) -> Page:
    """The page with a colour picture and the page's renderers in `window.bench`."""
    page = open_page(real.url)
    page.wait_for_selector("#new")
    show_colour_pictures(page)
    page.evaluate(BENCH)
    return page


@pytest.fixture
def no_gl(browser: Browser) -> Iterator[Browser]:
    """A browser without WebGL, not even in software."""
    chipless = browser.browser_type.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--use-gl=disabled"])
    yield chipless
    chipless.close()


def pixel(pic: Locator, dx: float = 0.0, dy: float = 0.0) -> list[int]:
    """Return the RGB value on the canvas, `dx`, `dy` picture heights from the centre."""
    value: list[int] = pic.evaluate(PIXEL, [dx, dy])
    return value


def textbook(tools: dict[str, int], pivot: float) -> np.ndarray:
    """Return the colour picture with the tools applied, in floating point."""
    was = np.asarray(drawn_retina(), np.float64)
    if tools["redfree"]:
        was = was[..., 1:2].repeat(3, axis=2)
    turned = np.clip(pivot + (was - pivot) * 1.25 ** tools["contrast"], 0, 255)
    bent: np.ndarray = 255 * (turned / 255) ** (1.2 ** -tools["brightness"])
    return bent


def test_both_renderers_draw_equal_pictures(bench: Page) -> None:
    apart = bench.evaluate(
        """([tools, scales]) => {
        const { PictureRenderer, drawn, maxDifference } = window.bench;
        const [gl, plain] = [new PictureRenderer(), new PictureRenderer(() => null)];
        const loupes = [null, { u: 0.02, v: 0.01, held: false }, { u: 0.1, v: -0.1, held: true }];
        const worst = tools.map((tool, i) => {
            const scale = scales[i % scales.length];
            const loupe = loupes[i % loupes.length];
            return maxDifference(drawn(gl, tool, scale, loupe), drawn(plain, tool, scale, loupe));
        });
        return [gl.renderer.name, plain.renderer.name, Math.max(...worst)];
    }""",
        [TOOLS, [0.3, 0.6, 1, 1.7, 2.5, 4, 8]],
    )
    assert apart == ["gl", "2d", 0], "largest difference between the painters, of 255"


@pytest.mark.parametrize("renderer", ["gl", "2d"])
def test_tools_match_formula(bench: Page, renderer: str) -> None:
    chosen = TOOLS[3::7]
    name, pivot, drawn = bench.evaluate(
        """async ([name, every]) => {
        const { PictureRenderer, picture, pixels } = window.bench;
        const at = document.querySelector("script[type=module]").src;
        const { analyse } = await import(new URL("components/viewer/lookup_table.js", at).href);
        const renderer = name === "gl" ? new PictureRenderer() : new PictureRenderer(() => null);
        const drawn = every.map((tools) => {
            const shown = pixels(renderer.render(picture, tools));
            const some = [];
            for (let i = 0; i < shown.length; i += 4 * 31) some.push(shown[i], shown[i + 1], shown[i + 2]);
            return some;
        });
        return [renderer.renderer.name, analyse(picture).pivot, drawn];
    }""",
        [renderer, chosen],
    )
    assert name == renderer
    for tools, got in zip(chosen, drawn, strict=True):
        wanted = textbook(tools, pivot).reshape(-1, 3)[::31].ravel()
        assert np.abs(np.array(got) - wanted).max() <= 0.51, tools  # rounded to the nearest integer


FAULTS = {
    "none": ("() => null", "no WebGL2"),
    "black": ("() => brokenContext({ drawArrays: () => () => {} })", "instead of"),
    "grey": (
        "() => brokenContext({ drawArrays: (gl) => () => "
        "{ gl.clearColor(0.5, 0.5, 0.5, 1); gl.clear(gl.COLOR_BUFFER_BIT); } })",
        "instead of",
    ),
    "three too bright": (
        """() => brokenContext({ texImage2D: (gl) => (...words) => {
            if (words.length === 9) words[8] = words[8].map((value) => Math.min(255, value + 3));
            gl.texImage2D(...words);
        } })""",
        "instead of",
    ),
    "no shader": ("() => brokenContext({ getProgramParameter: () => () => false })", "no shader"),
    "wrong in large": (
        """() => brokenContext({ drawArrays: (gl) => (...words) => {
            if (gl.canvas.width > 64) gl.scissor(0, 0, 8, 8), gl.enable(gl.SCISSOR_TEST);
            gl.drawArrays(...words);
        } })""",
        "a whole picture",
    ),
    "out of memory": (
        "() => { let calls = 0; "
        "return brokenContext({ getError: (gl) => () => (++calls > 7 ? gl.OUT_OF_MEMORY : 0) }); }",
        "WebGL error 1285",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_webgl_fails_self_test(bench: Page, fault: str) -> None:
    how, reason = FAULTS[fault]
    messages: list[str] = []
    bench.on("console", lambda message: messages.append(message.text) if message.type == "info" else None)
    name, apart = bench.evaluate(
        f"""() => {{
        const {{ PictureRenderer, drawn, brokenContext, maxDifference }} = window.bench;
        const [faulty, plain] = [new PictureRenderer({how}), new PictureRenderer(() => null)];
        const tools = {{ redfree: true, contrast: 2 }};
        const worst = maxDifference(drawn(faulty, tools, 2.5), drawn(plain, tools, 2.5));
        return [faulty.renderer.name, worst];
    }}"""
    )
    assert (name, apart) == ("2d", 0)
    assert len(messages) == 2, "one line from each of the two studios, however often it draws"
    assert all(line.startswith(FALLBACK_MESSAGE) for line in messages)
    assert any(reason in line for line in messages)


def test_self_test_accepts_rounding_differences(bench: Page) -> None:
    """Differences up to 2 of 255 are rounding and must pass the self-test."""
    name = bench.evaluate(
        """() => {
        const { PictureRenderer, brokenContext } = window.bench;
        const brighter = (gl) => (...words) => {
            if (words.length === 9) words[8] = words[8].map((value) => Math.min(255, value + 2));
            gl.texImage2D(...words);
        };
        return new PictureRenderer(() => brokenContext({ texImage2D: brighter })).renderer.name;
    }"""
    )
    assert name == "gl"


def lose_the_context(page: Page) -> None:
    page.evaluate('customElements.get("eye-pic").renderer.gl.getExtension("WEBGL_lose_context").loseContext()')


def test_lost_context_falls_back_without_visible_change(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, reduced_motion="reduce")
    messages: list[str] = []
    page.on("console", lambda message: messages.append(message.text) if message.type == "info" else None)
    take_picture(page)
    pic = page.locator("#picture")
    expect(pic).to_have_attribute("data-painter", "gl")
    tap(page, "[aria-label='More contrast']")
    wait_until_drawn(page, "colour 0 1")
    before = page.locator("#picture").screenshot()
    lose_the_context(page)
    expect(pic).to_have_attribute("data-painter", "2d")
    assert page.locator("#picture").screenshot() == before
    assert messages == [f"{FALLBACK_MESSAGE}it went away."]
    page.get_by_role("button", name="Red-free").tap()
    wait_until_drawn(page, "red-free 0 1")
    red, green, blue = pixel(pic)
    assert red == green == blue > 40
    tap(page, "#again")
    take_picture(page)
    page.get_by_role("button", name="Red-free").tap()
    wait_until_drawn(page, "red-free 0 0")
    assert pixel(pic)[0] > 40
    assert len(messages) == 1


def test_context_lost_before_its_event_draws_correctly(bench: Page) -> None:
    name, apart = bench.evaluate(
        """() => {
        const { PictureRenderer, drawn, maxDifference } = window.bench;
        const [gl, plain] = [new PictureRenderer(), new PictureRenderer(() => null)];
        drawn(gl, { redfree: true }, 1);
        gl.renderer.gl.getExtension("WEBGL_lose_context").loseContext(); // the event comes after this task
        const worst = maxDifference(drawn(gl, { contrast: 3 }, 1), drawn(plain, { contrast: 3 }, 1));
        return [gl.renderer.name, worst];
    }"""
    )
    assert (name, apart) == ("2d", 0)


def test_viewer_without_webgl(no_gl: Browser, real: Real, complaints: Complaints) -> None:
    context = no_gl.new_context(viewport={"width": 1280, "height": 800}, has_touch=True, is_mobile=True)

    def opened(url: str, size: tuple[int, int], **options: object) -> Page:
        page = context.new_page()
        complaints.watch(page)
        page.goto(url)
        return page

    page = aiming(opened, real)
    take_picture(page)
    pic = page.locator("#picture")
    expect(pic).to_have_attribute("data-painter", "2d")
    page.get_by_role("button", name="Red-free").tap()
    wait_until_drawn(page, "red-free 0 0")
    red, green, blue = pixel(pic)
    assert red == green == blue > 40
    assert complaints.unexpected() == []


def test_viewers_share_one_context_and_release_it(open_page: Open, real: Real) -> None:
    page = open_comparison(open_page, real)
    wide = 'customElements.get("eye-pic").renderer.gl.canvas.width'
    for pic in page.locator(".two eye-pic").all():  # a picture without tools is drawn without the renderer
        pic.evaluate("pic => { pic.contrast = 1; }")
        expect(pic).to_have_attribute("data-drawn", "final colour 0 1")
        expect(pic).to_have_attribute("data-painter", "gl")
    assert page.evaluate(wide) > 1
    page.get_by_role("button", name="Red-free").tap()
    for i in (0, 1):
        wait_until_drawn(page, "red-free 0 1", f".two eye-pic >> nth={i}")
    for pic in page.locator(".two eye-pic").all():
        assert pixel(pic)[0] == pixel(pic)[2] > 40
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/pictures")
    page.wait_for_selector(".pictures img >> nth=1")
    assert page.evaluate(wide) == 1
    assert page.locator(".pictures canvas").count() == 0, "thumbnails are plain pictures"


def test_interpolation_depends_on_scale(bench: Page) -> None:
    """From scale 4 on, each picture pixel is a block of one value."""
    for scale, squares in ((2.5, False), (4, True), (8, True)):
        got = bench.evaluate(
            """async (scale) => {
            const at = document.querySelector("script[type=module]").src;
            const { drawPicture } = await import(new URL("components/viewer/canvas.js", at).href);
            const { pixels } = window.bench;
            const spot = Object.assign(document.createElement("canvas"), { width: 4, height: 4 });
            spot.getContext("2d", { alpha: false }).fillStyle = "#ffffff";
            spot.getContext("2d").fillRect(1, 1, 1, 1);
            const canvas = Object.assign(document.createElement("canvas"), { width: 4 * scale, height: 4 * scale });
            drawPicture(canvas.getContext("2d"), spot, { u: 0, v: 0, width: 4 * scale, height: 4 * scale });
            return [...pixels(canvas)].filter((_, i) => i % 4 === 0);
        }""",
            scale,
        )
        assert (set(got) == {0, 255}) == squares
        if squares:
            assert got.count(255) == scale**2


# ---- the loupe


def open_comparison(open_page: Open, real: Real) -> Page:
    """Open two pictures of one slot side by side."""
    page = aiming(open_page, real)
    take_picture(page)
    tap(page, "#again")
    take_picture(page)
    first, second = real.visit()["slots"]["R-centre"]["captures"]
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/compare/{first}/{second}")
    expect(page.locator(".two eye-pic").nth(0)).to_have_attribute("data-mark", "final")
    expect(page.locator(".two eye-pic").nth(1)).to_have_attribute("data-mark", "final")
    return after_debounce(page)


def test_long_press_shows_loupe_beside_finger(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    pic = page.locator("#picture")
    box = pic.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def finger(kind: str, *at: float) -> None:
        points = [{"x": at[0], "y": at[1], "id": 0}] if at else []
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    finger("touchStart", x, y)
    assert loupe_position(pic) == pytest.approx((0, 0), abs=0.002)
    finger("touchMove", x + 60, y)
    expect(pic).not_to_have_attribute("data-loupe", "0.000,0.000")
    assert loupe_position(pic)[0] > 0.01
    assert pic.get_attribute("data-zoom") == "1.00"
    finger("touchEnd")
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")


def test_loupe_without_long_press_or_drag(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    pic = page.locator("#picture")
    tap(page, "#loupe")
    assert loupe_position(pic) == (0, 0)
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "true")
    box = pic.bounding_box()
    assert box is not None
    page.touchscreen.tap(box["x"] + box["width"] / 2 + 80, box["y"] + box["height"] / 2 - 40)
    expect(pic).not_to_have_attribute("data-loupe", "0.000,0.000")
    u, v = loupe_position(pic)
    assert u > 0.01
    assert v < -0.005
    pic.focus()
    page.keyboard.press("ArrowRight")
    assert loupe_position(pic)[0] > u
    page.keyboard.press("l")
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")
    page.locator("#result-title").focus()
    page.keyboard.press("l")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("b")
    expect(page.get_by_text("Brightness +1")).to_be_visible()
    page.get_by_role("button", name="Whole picture").tap()
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.get_by_text("Brightness +1")).to_have_count(0)


def test_loupe_pans_picture_at_edge(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real)
    take_picture(page)
    pic = page.locator("#picture")
    pic.focus()
    for key in "+++++":
        page.keyboard.press(key)
    page.keyboard.press("l")
    cols, rows = Image.open(io.BytesIO(real.rig.store.read(real.rig.store.captures(1)[0].id, "picture.png"))).size
    seen = pic.evaluate("pic => pic.clientWidth / pic.clientHeight") * rows / cols / 2 / 1.5**5
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    assert loupe_position(pic)[0] > 1.3 * seen


def test_compared_pictures_share_loupe(open_page: Open, real: Real) -> None:
    page = open_comparison(open_page, real)
    left, right = page.locator(".two eye-pic").all()
    tap(page, "#loupe")
    left.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    assert loupe_position(right) == loupe_position(left) != (0, 0)
    page.keyboard.press("l")
    expect(right).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")


# ---- loaded on demand


def test_viewer_module_is_loaded_on_demand_and_retried(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("viewer.js")
    page = open_page("about:blank")
    asked: list[str] = []
    cut = True

    def gate(route: Route) -> None:
        asked.append(route.request.url)
        if cut:
            route.abort()
        else:
            route.continue_()

    page.route("**/viewer.js", gate)
    page.goto(real.url)
    page.wait_for_selector("#new")
    after_debounce(page)
    assert asked == []
    visit = real.begin_visit(consent="agreed")
    page.goto(f"{real.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector("eye-live[data-frame]")
    expect(page.locator("#picture")).not_to_have_attribute("role", "img")
    assert len(asked) == 1
    cut = False
    after_debounce(page)
    take_picture(page)  # properties that were set before the module was loaded take effect
    expect(page.locator("#picture")).to_have_attribute("data-painter", "gl")


def test_a_visit_with_one_picture_without_colour_is_shown_in_green_and_says_why(
    open_page: Open, make_real: MakeReal
) -> None:
    """Picture, thumbnails and list: the first picture is in colour until the second one has none."""
    cameras: list[FailsInRed] = []

    def failing(head: Head) -> Head:
        cameras.append(FailsInRed(head.camera))
        return replace(with_all_chips(head, datetime.now(UTC)), camera=cameras[-1])

    real, why = make_real(head=failing), "Shown in green: the colour of one picture failed."
    camera = cameras[-1]
    page = aiming(open_page, real, reduced_motion="reduce")
    take_picture(page)
    wait_until_drawn(page, "colour 0 0")
    expect(page.locator(".prompt")).to_contain_text("Final picture, saved")
    expect(page.locator(".prompt")).not_to_contain_text("green")
    first = page.locator("[data-slot=R-centre] img")
    expect(first).to_have_attribute("src", re.compile("/quick.jpg$"))
    camera.fails = True
    tap(page, "#next")
    wait_for_preview(page)
    take_picture(page)
    expect(page.locator(".prompt")).to_contain_text(f"Final picture, saved · {why}")
    for slot in ("R-centre", "R-nerve"):
        expect(page.locator(f"[data-slot={slot}] img")).to_have_attribute("src", re.compile("/green.jpg$"))
    expect(page.get_by_role("button", name="Colour")).to_have_count(0)
    expect(page.locator("#grey")).to_be_visible()
    expect(page.get_by_role("button", name="Red-free")).to_have_count(0)  # it would change nothing
    tap(page, "[data-slot=R-centre]")
    expect(page.locator(".prompt")).to_contain_text(why)
    wait_until_drawn(page, "colour 0 0")
    red, green, blue = pixel(page.locator("#picture"))
    assert red == green == blue, "the first picture follows its visit"
    page.goto(f"{real.url}/#/visit/{visit_of(page)}/pictures")
    expect(page.locator("#green")).to_have_text(why)
    thumbnail = page.locator(".pictures .thumb img").first
    expect(thumbnail).to_have_js_property("complete", True)
    assert thumbnail.evaluate(GREYNESS) < 2


def test_a_picture_is_in_colour_and_red_free_is_the_one_in_green(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, reduced_motion="reduce")
    take_picture(page)
    wait_until_drawn(page, "colour 0 0")
    pic, redfree = page.locator("#picture"), page.get_by_role("button", name="Red-free")
    expect(page.get_by_role("button", name="Colour")).to_have_attribute("aria-pressed", "true")
    red, green, blue = pixel(pic)
    assert red > 1.5 * max(green, blue)
    page.get_by_role("button", name="Zoom in").tap()
    redfree.tap()
    wait_until_drawn(page, "red-free 0 0")
    red, green, blue = pixel(pic)
    assert red == green == blue > 40
    expect(pic).to_have_attribute("data-zoom", "1.50")
    page.get_by_role("button", name="Details").tap()
    details = page.get_by_role("dialog")
    expect(details).to_contain_text("green, red, blue (predicted, not measured)")
    expect(details).not_to_contain_text("Black-and-white")
    for name, file in (("Picture in colour (PNG)", "colour.png"), ("Picture (PNG)", "picture.png")):
        href = details.get_by_role("link", name=name, exact=True).get_attribute("href") or ""
        assert href.endswith(f"/{file}")
    details.get_by_role("button", name="Close").tap()
    page.keyboard.press("g")
    wait_until_drawn(page, "colour 0 0")
    red, green, _ = pixel(pic)
    assert red > 1.5 * green


def test_details_state_that_the_psf_has_the_cylinder(open_page: Open, real: Real) -> None:
    """The answers of the real server have a `psf_cylinder` added: its simulated eye has no cylinder."""
    stated = '"psf_cylinder": {"j0_dpt": 1.0, "j45_dpt": 0.0, "gain_db": 0.42}, "psf_scale"'

    def astigmatic(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.text().replace('"psf_scale"', stated))

    page = aiming(open_page, real)
    take_picture(page)
    page.route(re.compile(r"/api/(captures|visits)/[\w-]+$"), astigmatic)
    page.reload()
    page.get_by_role("button", name="Details").tap()
    expect(page.get_by_role("dialog")).to_contain_text("Corrected for the cylinder, predicted gain 0.4 dB")


def test_picture_that_fails_to_load_once_is_fetched_again(open_page: Open, real: Real, complaints: Complaints) -> None:
    complaints.expect("ERR_FAILED")
    page = aiming(open_page, real)
    failed: set[str] = set()

    def fail_once(route: Route) -> None:
        url = route.request.url
        if url in failed:
            route.fallback()
        else:
            failed.add(url)
            route.abort()

    page.route("**/api/captures/*/*.png", fail_once)  # the final picture
    page.route("**/api/captures/*/quick.jpg", fail_once)  # the quick look and the thumbnail
    tap(page, SHUTTER)
    stay(page)
    page.wait_for_selector("[data-phase=kept]")
    expect(page.locator("#picture .age")).to_have_text("The picture did not load. Trying again…")
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.locator("#picture .age")).to_be_hidden()
    expect(page.get_by_role("button", name="Red-free")).to_be_visible()
    expect(page.locator("[data-slot='R-centre'] img")).not_to_have_js_property("naturalWidth", 0)
    assert any(url.endswith(".png") for url in failed)


def test_comparison_is_reloaded_and_refuses_another_visit(open_page: Open, real: Real) -> None:
    """A page error fails the test: nothing is found while the visit is loaded, nor in another visit."""
    other, visit = (real.begin_visit(consent="agreed")["id"] for _ in range(2))
    first, second = (real.press(other, slot)["id"] for slot in ("R-centre", "L-centre"))
    page = open_page("about:blank")
    held: list[Route] = []
    page.route(f"**/api/visits/{other}", lambda route: held.append(route))
    page.goto(f"{real.url}/#/visit/{other}/compare/{first}/{second}")
    expect(page.locator(".compare figcaption")).to_have_count(2)  # drawn before the visit is loaded
    for route in held:
        route.continue_()
    page.unroute(f"**/api/visits/{other}")
    page.reload()
    expect(page.locator(".compare figcaption").first).to_contain_text("Right eye · Macula")
    page.goto(f"{real.url}/#/visit/{visit}/compare/{first}/{second}")
    page.wait_for_selector("[data-screen=patient]")
    expect(page.locator(".state-bar")).to_contain_text("This picture is of another patient.")


def test_a_thumbnail_shows_the_whole_field(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, reduced_motion="reduce")
    take_picture(page)
    for at in ((390, 844), (800, 1280), (1280, 800)):
        page.set_viewport_size({"width": at[0], "height": at[1]})
        image = page.locator("[data-slot=R-centre] img")
        expect(image).to_have_js_property("complete", True)
        # What is visible of the image, relative to the diameter of its field: whole from edge to edge.
        visible = image.evaluate(
            """async (image) => {
            const { field_px: field, shape: [, cols] } = await (await fetch("/api/status")).json();
            const { width, height } = image.parentElement.getBoundingClientRect();
            const drawn = image.getBoundingClientRect(); // with its scale
            const diameter = (Math.max(drawn.width, drawn.height) * field) / cols;
            return [width / diameter, height / diameter];
        }"""
        )
        assert min(visible) >= 1, at


def test_an_enlarged_picture_has_an_overview(open_page: Open, real: Real) -> None:
    page = aiming(open_page, real, reduced_motion="reduce")
    take_picture(page)
    wait_until_drawn(page, "colour 0 0")
    picture = page.locator("#picture")
    corner = """(pic) => { // colour at the edge of the overview, in the lower right corner
        const c = pic.querySelector("canvas");
        const side = 0.22 * Math.min(c.width, c.height), margin = (12 * c.width) / c.clientWidth;
        const { data } = c.getContext("2d").getImageData(c.width - margin - side, c.height - margin - side / 2, 1, 1);
        return [...data].slice(0, 3);
    }"""
    assert picture.evaluate(corner) != [255, 255, 255]
    for _ in range(3):
        tap(page, "[aria-label='Zoom in']")
    expect(picture).to_have_attribute("data-zoom", "3.38")
    wait_until_drawn(page, "colour 0 0")
    assert picture.evaluate(corner) == [255, 255, 255]
