"""The sheet of one picture: from mm to pixels, names with leads to their parts, and distances."""

from collections.abc import Callable, Iterable, Iterator

from hardware.parts.view import Drawn
from services.plot import document, line, text

STYLE_HERE = """
  path { stroke: #1d2330; stroke-linejoin: round; fill-rule: evenodd; vector-effect: non-scaling-stroke; }
  .fine { fill: none; }
  .printed { fill: #d9dde4; } .bright { fill: #f6dfae; } .glass { fill: #bfdcf2; } .board { fill: #b9dcc0; }
  .metal { fill: #c9b7a4; } .light { fill: #f2c230; opacity: .55; stroke: none; }
  .name { paint-order: stroke; stroke: #ffffff; stroke-width: 4px; stroke-linejoin: round; }
  .lead { stroke: #8a8f98; stroke-width: 1; } .measure { stroke: #a8327f; stroke-width: 1.2; fill: none; }
  @media (prefers-color-scheme: dark) {
    path { stroke: #0b0e13; } .printed { fill: #8d96a5; } .bright { fill: #c9a24f; } .glass { fill: #6aa5d3; }
    .board { fill: #6fae7d; } .metal { fill: #a08a72; } .measure { stroke: #f18fcb; }
    .name { stroke: #12161d; }
  }
"""
CALLED = {"LED film": "polariser film", "eye lens": "lens", "lever": "M2 screw"}  # what labels say
MARGIN = 48
ROW_PX = 18
LETTER_PX = 6.8
ROWS = 20
MEASURE = "small label s3"


class Sheet:
    """From mm to the pixels of one document."""

    def __init__(self, title: str, drawn: Iterable[Drawn], px_per_mm: float, top: int = 90, beside: int = 0) -> None:
        every = list(drawn)
        self.title, self.scale, self.top = title, px_per_mm, top
        self.left = min(one.left for one in every)
        self.high = max(one.high for one in every)
        self.wide = round((max(one.right for one in every) - self.left) * px_per_mm) + 2 * MARGIN + beside
        self.tall = round((self.high - min(one.low for one in every)) * px_per_mm) + 2 * MARGIN + top

    def at(self, place: tuple[float, float]) -> tuple[float, float]:
        """The pixel of a place in mm."""
        return MARGIN + (place[0] - self.left) * self.scale, MARGIN + self.top + (self.high - place[1]) * self.scale

    def document(self, body: list[str], over: list[str]) -> str:
        """Shapes in mm below, words in pixels above them."""
        x, y = self.at((0, 0))
        group = f'<g transform="translate({x:.1f} {y:.1f}) scale({self.scale:g})">'
        elements = [group, *body, "</g>", text(24, 32, self.title, "title"), *over]
        return document(self.wide, self.tall, self.title, "", elements, STYLE_HERE)

    def measure(self, begin: tuple[float, float], end: tuple[float, float]) -> str:
        """A line between two places along one axis, with a tick at each end."""
        (x1, y1) = self.at(begin)
        (x2, y2) = self.at(end)
        tick = (0, 6) if y1 == y2 else (6, 0)
        strokes = [(x1, y1, x2, y2)]
        strokes += [(x - tick[0], y - tick[1], x + tick[0], y + tick[1]) for x, y in ((x1, y1), (x2, y2))]
        return "".join(line(*stroke, "measure") for stroke in strokes)


def labels(sheet: Sheet, drawn: dict[str, Drawn], beside: frozenset[str] = frozenset()) -> list[str]:
    """Names in rows at the top and at the bottom, or to the right of a part, each with a lead to it."""
    leads: list[str] = []
    words: list[str] = []
    ends = {True: [0.0] * ROWS, False: [0.0] * ROWS}
    for name in (name for name in drawn if name in beside):
        x, y = sheet.at((drawn[name].right, drawn[name].middle[1]))
        leads.append(line(x - 12, y, x + 20, y, "lead"))
        words.append(text(x + 24, y + 4, CALLED.get(name, name), "small name"))
    for name, one in sorted(drawn.items(), key=lambda item: item[1].middle):
        if name in beside:
            continue
        said = CALLED.get(name, name)
        half = len(said) * LETTER_PX / 2
        above, row, x, y = min(_places(sheet, one, ends, half), key=_cost(sheet))
        ends[above][row] = x + half + 8
        at = 60 + row * ROW_PX if above else sheet.tall - 14 - row * ROW_PX
        leads.append(line(x, at + (4 if above else -12), x, y, "lead"))
        words.append(text(x, at, said, "small name", "middle"))
    return leads + words


Candidate = tuple[bool, int, float, float]


def _places(sheet: Sheet, one: Drawn, ends: dict[bool, list[float]], half_px: float) -> Iterator[Candidate]:
    """(above, row, x, y): where a name of that width could stand, and where its lead would end."""
    for x, y in map(sheet.at, one.marks or (one.middle,)):
        for above, taken in ends.items():
            yield above, next(row for row, end in enumerate(taken) if end < x - half_px), x, y


def _cost(sheet: Sheet) -> Callable[[Candidate], float]:
    """A short lead is good, and a low row is worth some of its length."""
    return lambda place: (place[3] if place[0] else sheet.tall - place[3]) + 3 * ROW_PX * place[1]
