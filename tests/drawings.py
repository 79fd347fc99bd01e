"""Bounding boxes of the text in an SVG drawing, to test that no label covers another."""

from typing import NamedTuple
from xml.etree import ElementTree

SVG = "{http://www.w3.org/2000/svg}"
SIZES = {"title": 20, "small": 12}  # px, by class; all others are 14
EM = 0.55  # mean advance width of a letter in the plots' fonts, relative to the font size


class TextBox(NamedTuple):
    """Line of text and its bounding box, px."""

    left: float
    top: float
    right: float
    bottom: float
    words: str


def boxes(root: ElementTree.Element) -> list[TextBox]:
    """Return the bounding box of every upright line of text, by its place, anchor and size."""
    found = []
    for element in root.iter(f"{SVG}text"):
        words, kinds = element.text or "", (element.get("class") or "").split()
        size = next((SIZES[kind] for kind in kinds if kind in SIZES), 14)
        wide, x, y = EM * size * len(words), float(element.get("x", "nan")), float(element.get("y", "nan"))
        left = x - {"start": 0.0, "middle": wide / 2, "end": wide}[element.get("text-anchor") or "start"]
        found.append(TextBox(left, y - 0.8 * size, left + wide, y + 0.2 * size, words))
    return found


def overlapping(found: list[TextBox]) -> list[tuple[str, str]]:
    """Return the pairs of lines that overlap."""
    return [
        (a.words, b.words)
        for k, a in enumerate(found)
        for b in found[:k]
        if a.left < b.right and b.left < a.right and a.top < b.bottom and b.top < a.bottom
    ]
