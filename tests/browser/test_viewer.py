"""The picture viewer: two painters that make one picture, a graphics chip that lies or goes away, the loupe."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, Route, expect

from tests.browser.conftest import CHROMIUM, Complaints
from tests.browser.stub import COLS, FIELD_PX, Stubbed, drawn_retina
from tests.browser.walk import SHUTTER, Open, aiming, drawn, place_of, settled, taken, tap

pytestmark = pytest.mark.browser

BENCH = Path(__file__).with_name("viewer.js").read_text()
TOOLS = [
    {"redfree": redfree, "brightness": brightness, "contrast": contrast}
    for redfree, brightness, contrast in product((False, True), (-5, -1, 0, 2, 5), (-5, 0, 1, 5))
]
SAID = "Pictures are drawn without the graphics chip: "
PIXEL = """(pic, [dx, dy]) => {
    const c = pic.querySelector("canvas");
    const { data } = c.getContext("2d").getImageData(c.width / 2 + dx * c.height, c.height / 2 + dy * c.height, 1, 1);
    return [...data].slice(0, 3);
}"""


@pytest.fixture
def bench(open_page: Open, stub: Stubbed) -> Page:
    """The page with the stand-in's picture and the page's own painters at hand."""
    page = open_page(stub.url)
    page.wait_for_selector("#new")
    page.evaluate(BENCH)
    return page


@pytest.fixture
def no_gl(browser: Browser) -> Iterator[Browser]:
    """A browser whose computer has no graphics chip, not even a simulated one."""
    chipless = browser.browser_type.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--use-gl=disabled"])
    yield chipless
    chipless.close()


def pixel(pic: Locator, dx: float = 0.0, dy: float = 0.0) -> list[int]:
    """The RGB value on the glass, `dx`, `dy` picture heights from the middle."""
    value: list[int] = pic.evaluate(PIXEL, [dx, dy])
    return value


def textbook(tools: dict[str, int], pivot: float) -> np.ndarray:
    """The stand-in's picture under the tools, in floating point."""
    was = np.asarray(drawn_retina(1), np.float64)
    if tools["redfree"]:
        was = was[..., 1:2].repeat(3, axis=2)
    turned = np.clip(pivot + (was - pivot) * 1.25 ** tools["contrast"], 0, 255)
    bent: np.ndarray = 255 * (turned / 255) ** (1.2 ** -tools["brightness"])
    return bent


def test_both_painters_make_one_picture_with_every_tool_at_every_size(bench: Page) -> None:
    apart = bench.evaluate(
        """([tools, scales]) => {
        const { Studio, glass, apart } = window.bench;
        const [gl, plain] = [new Studio(), new Studio(() => null)];
        const loupes = [null, { u: 0.02, v: 0.01, held: false }, { u: 0.1, v: -0.1, held: true }];
        const worst = tools.map((one, i) => {
            const scale = scales[i % scales.length];
            const loupe = loupes[i % loupes.length];
            return apart(glass(gl, one, scale, loupe), glass(plain, one, scale, loupe));
        });
        return [gl.painter.name, plain.painter.name, Math.max(...worst)];
    }""",
        [TOOLS, [0.3, 0.6, 1, 1.7, 2.5, 4, 8]],
    )
    assert apart == ["gl", "2d", 0], "largest difference between the painters, of 255"


@pytest.mark.parametrize("painter", ["gl", "2d"])
def test_the_tools_do_what_their_formula_says(bench: Page, painter: str) -> None:
    chosen = TOOLS[3::7]
    name, pivot, drawn = bench.evaluate(
        """async ([painter, every]) => {
        const { Studio, picture, pixels } = window.bench;
        const { study } = await import(new URL("tone.js", document.querySelector("script[type=module]").src).href);
        const studio = painter === "gl" ? new Studio() : new Studio(() => null);
        const drawn = every.map((tools) => {
            const shown = pixels(studio.develop(picture, tools));
            const some = [];
            for (let i = 0; i < shown.length; i += 4 * 31) some.push(shown[i], shown[i + 1], shown[i + 2]);
            return some;
        });
        return [studio.painter.name, study(picture).pivot, drawn];
    }""",
        [painter, chosen],
    )
    assert name == painter
    for tools, got in zip(chosen, drawn, strict=True):
        wanted = textbook(tools, pivot).reshape(-1, 3)[::31].ravel()
        assert np.abs(np.array(got) - wanted).max() <= 0.51, tools  # rounded to the nearest whole value


LIES = {
    "none": ("() => null", "no WebGL2"),
    "black": ("() => liar({ drawArrays: () => () => {} })", "instead of"),
    "grey": (
        "() => liar({ drawArrays: (gl) => () => { gl.clearColor(0.5, 0.5, 0.5, 1); gl.clear(gl.COLOR_BUFFER_BIT); } })",
        "instead of",
    ),
    "three too bright": (
        """() => liar({ texImage2D: (gl) => (...words) => {
            if (words.length === 9) words[8] = words[8].map((value) => Math.min(255, value + 3));
            gl.texImage2D(...words);
        } })""",
        "instead of",
    ),
    "no shader": ("() => liar({ getProgramParameter: () => () => false })", "no shader"),
    "wrong in large": (
        """() => liar({ drawArrays: (gl) => (...words) => {
            if (gl.canvas.width > 64) gl.scissor(0, 0, 8, 8), gl.enable(gl.SCISSOR_TEST);
            gl.drawArrays(...words);
        } })""",
        "a whole picture",
    ),
    "out of memory": (
        """() => { let calls = 0; return liar({ getError: (gl) => () => (++calls > 7 ? gl.OUT_OF_MEMORY : 0) }); }""",
        "WebGL error 1285",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_chip_that_lies_is_found_out_and_the_picture_is_true(bench: Page, lie: str) -> None:
    how, reason = LIES[lie]
    said: list[str] = []
    bench.on("console", lambda message: said.append(message.text) if message.type == "info" else None)
    name, apart = bench.evaluate(
        f"""() => {{
        const {{ Studio, glass, liar, apart }} = window.bench;
        const [doubted, plain] = [new Studio({how}), new Studio(() => null)];
        const tools = {{ redfree: true, contrast: 2 }};
        const worst = apart(glass(doubted, tools, 2.5), glass(plain, tools, 2.5));
        return [doubted.painter.name, worst];
    }}"""
    )
    assert (name, apart) == ("2d", 0)
    assert len(said) == 2, "one line from each of the two studios, however often it draws"
    assert all(line.startswith(SAID) for line in said)
    assert any(reason in line for line in said)


def test_one_who_tells_small_lies_is_believed(bench: Page) -> None:
    """Within 2 of 255 a chip may round as it likes: the proof must not send true chips away."""
    name = bench.evaluate(
        """() => {
        const { Studio, liar } = window.bench;
        const brighter = (gl) => (...words) => {
            if (words.length === 9) words[8] = words[8].map((value) => Math.min(255, value + 2));
            gl.texImage2D(...words);
        };
        return new Studio(() => liar({ texImage2D: brighter })).painter.name;
    }"""
    )
    assert name == "gl"


def lose_the_context(page: Page) -> None:
    page.evaluate('customElements.get("eye-pic").painter.gl.getExtension("WEBGL_lose_context").loseContext()')


def test_a_context_that_is_lost_in_the_middle_is_not_noticed(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub, reduced_motion="reduce")
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text) if message.type == "info" else None)
    taken(page)
    pic = page.locator("#picture")
    expect(pic).to_have_attribute("data-painter", "gl")
    tap(page, "[aria-label='More contrast']")
    drawn(page, "colour 0 1")
    before = page.locator("#picture").screenshot()
    lose_the_context(page)
    expect(pic).to_have_attribute("data-painter", "2d")
    assert page.locator("#picture").screenshot() == before
    assert said == [f"{SAID}it went away."]
    page.get_by_role("button", name="Red-free").tap()
    drawn(page, "red-free 0 1")
    red, green, blue = pixel(pic)
    assert red == green == blue > 40
    tap(page, "#again")
    tap(page, SHUTTER)
    page.wait_for_selector("[data-phase=kept] .stage[data-mark=final]")
    page.get_by_role("button", name="Red-free").tap()
    drawn(page, "red-free 0 0")
    assert pixel(pic)[0] > 40
    assert len(said) == 1


def test_a_context_that_is_lost_before_anybody_says_so_draws_nothing_false(bench: Page) -> None:
    name, apart = bench.evaluate(
        """() => {
        const { Studio, glass, apart } = window.bench;
        const [gl, plain] = [new Studio(), new Studio(() => null)];
        glass(gl, { redfree: true }, 1);
        gl.painter.gl.getExtension("WEBGL_lose_context").loseContext(); // the event comes after this task
        const worst = apart(glass(gl, { contrast: 3 }, 1), glass(plain, { contrast: 3 }, 1));
        return [gl.painter.name, worst];
    }"""
    )
    assert (name, apart) == ("2d", 0)


def test_a_computer_without_any_chip_draws_as_well(no_gl: Browser, stub: Stubbed, complaints: Complaints) -> None:
    context = no_gl.new_context(viewport={"width": 1280, "height": 800}, has_touch=True, is_mobile=True)

    def opened(url: str, size: tuple[int, int], **options: object) -> Page:
        page = context.new_page()
        complaints.watch(page)
        page.goto(url)
        return page

    page = aiming(opened, stub)
    taken(page)
    pic = page.locator("#picture")
    expect(pic).to_have_attribute("data-painter", "2d")
    page.get_by_role("button", name="Red-free").tap()
    drawn(page, "red-free 0 0")
    red, green, blue = pixel(pic)
    assert red == green == blue > 40
    assert complaints.unexpected() == []


def test_one_context_serves_all_and_rests_when_nobody_looks(open_page: Open, stub: Stubbed) -> None:
    page = compared(open_page, stub)
    page.get_by_role("button", name="Red-free").tap()
    for i in (0, 1):
        drawn(page, "red-free 0 0", f".two eye-pic >> nth={i}")
    for pic in page.locator(".two eye-pic").all():
        expect(pic).to_have_attribute("data-painter", "gl")
        assert pixel(pic)[0] == pixel(pic)[2] > 40
    wide = 'customElements.get("eye-pic").painter.gl.canvas.width'
    assert page.evaluate(wide) > 1
    page.goto(f"{stub.url}/#/visit/v142/film")
    page.wait_for_selector(".film img >> nth=1")
    assert page.evaluate(wide) == 1
    assert page.locator(".film canvas").count() == 0, "thumbnails are plain pictures"


def test_large_pixels_stand_as_squares_and_small_ones_are_smooth(bench: Page) -> None:
    """From four screen pixels on every pixel of the picture is one block of its own value."""
    for scale, squares in ((2.5, False), (4, True), (8, True)):
        got = bench.evaluate(
            """async (scale) => {
            const { place } = await import(new URL("glass.js", document.querySelector("script[type=module]").src).href);
            const { pixels } = window.bench;
            const spot = Object.assign(document.createElement("canvas"), { width: 4, height: 4 });
            spot.getContext("2d", { alpha: false }).fillStyle = "#ffffff";
            spot.getContext("2d").fillRect(1, 1, 1, 1);
            const glass = Object.assign(document.createElement("canvas"), { width: 4 * scale, height: 4 * scale });
            place(glass.getContext("2d"), spot, { u: 0, v: 0, width: 4 * scale, height: 4 * scale });
            return [...pixels(glass)].filter((_, i) => i % 4 === 0);
        }""",
            scale,
        )
        assert (set(got) == {0, 255}) == squares
        if squares:
            assert got.count(255) == scale**2


# ---- the loupe


def compared(open_page: Open, stub: Stubbed) -> Page:
    """Two pictures of one slot, side by side."""
    page = aiming(open_page, stub)
    taken(page)
    tap(page, "#again")
    taken(page)
    first, second = (capture["id"] for capture in stub.stub.captures[:2])
    page.goto(f"{stub.url}/#/visit/v142/compare/{first}/{second}")
    expect(page.locator(".two eye-pic").nth(0)).to_have_attribute("data-mark", "final")
    expect(page.locator(".two eye-pic").nth(1)).to_have_attribute("data-mark", "final")
    return settled(page)


def test_a_long_press_holds_the_loupe_beside_the_finger(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    pic = page.locator("#picture")
    box = pic.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def finger(kind: str, *at: float) -> None:
        points = [{"x": at[0], "y": at[1], "id": 0}] if at else []
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    finger("touchStart", x, y)
    assert place_of(pic) == pytest.approx((0, 0), abs=0.002)
    finger("touchMove", x + 60, y)
    expect(pic).not_to_have_attribute("data-loupe", "0.000,0.000")
    assert place_of(pic)[0] > 0.01
    assert pic.get_attribute("data-zoom") == "1.00"
    finger("touchEnd")
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")


def test_the_loupe_needs_no_long_press_and_no_drag(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    pic = page.locator("#picture")
    tap(page, "#loupe")
    assert place_of(pic) == (0, 0)
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "true")
    box = pic.bounding_box()
    assert box is not None
    page.touchscreen.tap(box["x"] + box["width"] / 2 + 80, box["y"] + box["height"] / 2 - 40)
    expect(pic).not_to_have_attribute("data-loupe", "0.000,0.000")
    u, v = place_of(pic)
    assert u > 0.01
    assert v < -0.005
    pic.focus()
    page.keyboard.press("ArrowRight")
    assert place_of(pic)[0] > u
    page.keyboard.press("l")
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")
    page.locator("#result-title").focus()
    page.keyboard.press("l")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("b")
    expect(page.get_by_text("Brightness +1")).to_be_visible()
    page.get_by_role("button", name="Show all").tap()
    expect(pic).to_have_attribute("data-loupe", "")
    expect(page.get_by_text("Brightness +1")).to_have_count(0)


def test_the_loupe_pushes_the_picture_on_at_the_edge(open_page: Open, stub: Stubbed) -> None:
    page = aiming(open_page, stub)
    taken(page)
    pic = page.locator("#picture")
    pic.focus()
    for key in "+++++":
        page.keyboard.press(key)
    page.keyboard.press("l")
    seen = pic.evaluate("pic => pic.clientWidth / pic.clientHeight") * 1.06 * FIELD_PX / COLS / 2 / 1.5**5
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    assert place_of(pic)[0] > 1.3 * seen


def test_two_pictures_are_seen_with_one_loupe(open_page: Open, stub: Stubbed) -> None:
    page = compared(open_page, stub)
    one, other = page.locator(".two eye-pic").all()
    tap(page, "#loupe")
    one.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    assert place_of(other) == place_of(one) != (0, 0)
    page.keyboard.press("l")
    expect(other).to_have_attribute("data-loupe", "")
    expect(page.locator("#loupe")).to_have_attribute("aria-pressed", "false")


# ---- loaded when it is needed


def test_home_needs_no_viewer_and_a_link_that_was_lost_meanwhile_is_made_good(
    open_page: Open, stub: Stubbed, complaints: Complaints
) -> None:
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
    page.goto(stub.url)
    page.wait_for_selector("#new")
    settled(page)
    assert asked == []
    visit = stub.stub.visits.begin(consent="agreed")
    page.goto(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector("eye-live[data-frame]")
    expect(page.locator("#picture")).not_to_have_attribute("role", "img")
    assert len(asked) == 1
    cut = False
    settled(page)
    taken(page)  # what the page told the viewer before it was there, it knows
    expect(page.locator("#picture")).to_have_attribute("data-painter", "gl")
