"""Colour picture for the tests of the viewer, with stronger colours than those of the simulated head."""

import io

import numpy as np
from PIL import Image
from playwright.sync_api import Page

ROWS, COLS, FIELD_PX = 540, 960, 260


def drawn_retina() -> Image.Image:
    """Draw a disc with a bright nerve head and dark vessels."""
    rows, cols = np.mgrid[:ROWS, :COLS].astype(np.float32)
    y, x = (rows - ROWS / 2) / (FIELD_PX / 2), (cols - COLS / 2) / (FIELD_PX / 2)
    lit = (np.hypot(x, y) < 1).astype(np.float32)
    brightness = 0.55 + 0.45 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.02) - 0.2 * np.exp(-((x + 0.25) ** 2 + y**2) / 0.03)
    for bend in (-0.9, -0.45, 0.45, 0.9):
        line = bend * np.sqrt(np.clip(0.55 - x, 0, None))
        brightness -= 0.22 * np.exp(-((y - line) ** 2) / 0.0004) * (x < 0.5)
    colour = np.stack([brightness * 205, brightness * 105, brightness * 50], -1) * lit[..., None]
    return Image.fromarray(colour.clip(0, 255).astype(np.uint8))


def show_colour_pictures(page: Page) -> None:
    """Replace every picture in colour that the page requests by the colour picture, and that in green by its green."""
    colour, green = io.BytesIO(), io.BytesIO()
    drawn_retina().save(colour, "png")
    drawn_retina().getchannel("G").save(green, "png")
    page.route("**/colour.png", lambda route: route.fulfill(body=colour.getvalue(), content_type="image/png"))
    page.route("**/picture.png", lambda route: route.fulfill(body=green.getvalue(), content_type="image/png"))
