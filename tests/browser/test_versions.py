"""Versions of a picture on its screen: the one as taken first, another by touch and by keyboard, named for readers."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from services.imaging.picture_files import to_png
from services.records.capture_versions import NewVersion
from tests.browser.looks import look_for_faults
from tests.browser.real import Real
from tests.browser.test_accessibility import strike
from tests.browser.walk import Open, wait_until_drawn

pytestmark = pytest.mark.browser


def adopt_version(real: Real, id: str) -> None:
    """Adopt an even grey picture of the same size as a version of a capture."""
    store = real.rig.store
    kept = store.get(id)
    size = Image.open(BytesIO(store.read(id, "picture.png"))).size
    grey = to_png(np.linspace(0.5, 1, size[0] * size[1], dtype=np.float32).reshape(size[1], size[0]), True)
    frames = {name: digest for name, digest in kept.files.items() if name.endswith(".tiff")}
    new = NewVersion(id, "a" * 32, frames, "", "variation", "1.2", grey, b"{}")
    store.versions.adopt(new, real.clock.wall())


def test_the_picture_as_taken_is_shown_until_a_version_is_chosen(open_page: Open, real: Real) -> None:
    visit = real.begin_visit(consent="agreed")["id"]
    first, second = (real.press(visit)["id"] for _ in range(2))
    adopt_version(real, first)
    page = open_page(f"{real.url}/#/visit/{visit}/picture/R-centre/{second}")
    wait_until_drawn(page, "colour 0 0")
    group = page.get_by_role("group", name="Which picture")
    expect(group).to_have_count(0)
    page.goto(f"{real.url}/#/visit/{visit}/picture/R-centre/{first}")
    expect(group).to_have_count(1)
    wait_until_drawn(page, "colour 0 0")
    taken, version = group.get_by_role("button", name="Original picture"), group.get_by_role("button", name="Version 1")
    expect(taken).to_have_attribute("aria-pressed", "true")
    with page.expect_response("**/picture-1.png") as answer:
        version.tap()
    assert answer.value.ok
    expect(version).to_have_attribute("aria-pressed", "true")
    expect(page.locator(".prompt")).to_contain_text("The original picture stays in use.")
    assert "Version 1" in (page.locator("#picture").get_attribute("aria-label") or "")
    expect(page.get_by_role("button", name="Colour")).to_have_count(0)  # this version is in one colour
    assert look_for_faults(page) == []
    strike(page, "[data-field=version] [data-value='0']", back=True)
    expect(taken).to_have_attribute("aria-pressed", "true")
    wait_until_drawn(page, "colour 0 0")
    assert "Version 1" not in (page.locator("#picture").get_attribute("aria-label") or "")
    page.get_by_role("button", name="Details").tap()
    link = page.get_by_role("dialog").get_by_role("link", name="Version 1")
    assert (link.get_attribute("href") or "").endswith("/picture-1.png")
