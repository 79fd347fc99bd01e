"""SVG documents: plots of series over two linear or logarithmic axes, and the elements of other drawings.

An SVG has no external fonts, scripts or files, suits light and dark backgrounds, and has a title and a description for
screen readers. The marks of each series have their shape and colour; a mark can have a tooltip with its numbers.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from math import ceil, cos, floor, log10, pi, sin

STYLE = """
  .ground { fill: #ffffff; } .frame { fill: none; stroke: #8a8f98; } .grid { stroke: #e3e5e9; }
  text { fill: #1d2330; font: 14px system-ui, -apple-system, "Segoe UI", "Noto Sans", Arial, sans-serif; }
  .title { font-size: 20px; font-weight: 600; } .small { font-size: 12px; } .quiet { fill: #59606d; }
  .s0 { --ink: #8a5a00; } .s1 { --ink: #0067a3; } .s2 { --ink: #00795c; } .s3 { --ink: #a8327f; }
  .s4 { --ink: #555b66; } .s5 { --ink: #5b3fc4; } .s6 { --ink: #b3471e; } .s7 { --ink: #3f6d12; }
  .mark { fill: var(--ink); stroke: #ffffff; stroke-width: 1.2; }
  .trail { fill: none; stroke: var(--ink); opacity: .55; } .line { opacity: .9; stroke-width: 1.5; }
  .label { fill: var(--ink); paint-order: stroke; stroke: #ffffff; stroke-width: 4px; stroke-linejoin: round; }
  .edge { fill: none; stroke: #1d2330; stroke-width: 1.6; }
  .limit { stroke: #b3261e; stroke-width: 1.5; stroke-dasharray: 6 4; } .limit-word { fill: #b3261e; }
  .ring { fill: none; stroke: #1d2330; stroke-width: 2.4; }
  @media (prefers-color-scheme: dark) {
    .ground { fill: #12161d; } .frame { stroke: #7a818d; } .grid { stroke: #272d37; }
    text { fill: #eceff4; } .quiet { fill: #a9b1bf; } .mark, .label { stroke: #12161d; }
    .s0 { --ink: #f0b14a; } .s1 { --ink: #6cbcf5; } .s2 { --ink: #4fd1a5; } .s3 { --ink: #f18fcb; }
    .s4 { --ink: #b6bdc9; } .s5 { --ink: #b3a2ff; } .s6 { --ink: #ff9d76; } .s7 { --ink: #a6d86b; }
    .edge, .ring { stroke: #eceff4; } .limit { stroke: #ff8a80; } .limit-word { fill: #ff8a80; }
  }
"""
KINDS = 8  # of marks and colours
LETTER_PX, LINE_PX = 6.6, 13.0  # width of a letter and height of a line of a 12 px label
GAP_PX = 4  # between labels; a wide font has digits of 7.5 px
FULL_WEIGHT = 0.9  # a lighter mark has its label beside it or not at all
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Mark:
    """One point with label and tooltip; `weight` scales the mark, and 0 draws only the line through the point."""

    x: float
    y: float
    label: str = ""
    tooltip: str = ""
    weight: float = 1.0


@dataclass(frozen=True)
class Series:
    """Marks of one shape and colour; a thin line joins the marks of each trail.

    `kind`: number of the shape and colour, 0 to KINDS - 1; None: the place among the series of the plot. `hollow`: its
    marks are outlines. `named`: the series has its name in the legend.
    """

    name: str
    trails: tuple[tuple[Mark, ...], ...]
    kind: int | None = None
    hollow: bool = False
    named: bool = True


@dataclass(frozen=True)
class Axis:
    """Linear or logarithmic axis of a plot: maps data to 0 (`low`) to 1 (`high`); with its ticks and their labels.

    `below`: labels of ticks in another unit, in a second line.
    """

    low: float
    high: float
    title: str
    ticks: tuple[tuple[float, str], ...]
    log: bool = False
    below: tuple[tuple[float, str], ...] = ()

    def at(self, value: float) -> float:
        """Return the position of a value: 0 at the low end, 1 at the high end."""
        if self.log:
            return (log10(value) - log10(self.low)) / (log10(self.high) - log10(self.low))
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Plot:
    """Content of one plot; `edge`: points (x, y) of the Pareto front; `limits`: x and label of vertical lines.

    `rings`: x, y and label of circles; the legend has the label of the first one. `right`: y values and labels of ticks
    at the right. Width and height are in px.
    """

    title: str
    subtitle: str
    description: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    edge: tuple[tuple[float, float], ...] = ()
    limits: tuple[tuple[float, str], ...] = ()
    rings: tuple[tuple[float, float, str], ...] = ()
    right: tuple[tuple[float, str], ...] = ()
    right_title: str = ""
    width: int = field(default=960, kw_only=True)
    height: int = field(default=600, kw_only=True)


@dataclass(frozen=True)
class Panel:
    """Ready SVG elements in their own coordinates, below a plot. Width and height are in px."""

    elements: tuple[str, ...]
    description: str
    height: int
    width: int = 960


LEFT, RIGHT, TOP, BOTTOM = 74, 78, 96, 62


def time_axis(seconds: Iterable[float], title: str, fft_pair_s: float | None = None) -> Axis:
    """Return a log axis of times in s; a tick below 0.1 s is labelled in milliseconds, others in seconds.

    With the duration of an FFT pair in s, each tick has the time in such pairs below.
    """
    axis = log_axis(seconds, title, _time)
    if fft_pair_s is None:
        return axis
    pairs = tuple((tick, f"{float(f'{tick / fft_pair_s:.2g}'):g}") for tick, _ in axis.ticks)
    return replace(axis, below=((pairs[0][0], f"{pairs[0][1]} FFT pairs"), *pairs[1:]))


def log_axis(values: Iterable[float], title: str, label: Callable[[float], str]) -> Axis:
    """Return a log axis for positive values with ticks at 1, 2 and 5 of each decade; `label` formats a tick."""
    every = list(values)
    low = min(every) / 1.25
    high = max(every) * 1.45
    ticks = [m * 10.0**k for k in range(floor(log10(low)), ceil(log10(high)) + 1) for m in (1, 2, 5)]
    return Axis(low, high, title, tuple((tick, label(tick)) for tick in ticks if low <= tick <= high), log=True)


def _time(duration_s: float) -> str:
    return f"{duration_s:.3g} s" if duration_s >= 0.0999 else f"{duration_s * 1e3:.3g} ms"


def value_axis(values: Iterable[float], title: str, room: float = 0.06) -> Axis:
    """Return a linear axis, wider than its values by the share `room` at each end, with at most nine round ticks."""
    every = list(values)
    span = max(max(every) - min(every), 1e-6)
    low = min(every) - room * span
    high = max(every) + room * span
    step = next(s for k in range(-9, 9) for s in (10.0**k, 2 * 10.0**k, 5 * 10.0**k) if (high - low) / s <= 8)
    first = ceil(low / step)
    ticks = [(k * step, f"{k * step:.6g}") for k in range(first, floor(high / step) + 1)]
    return Axis(low, high, title, tuple(ticks))


def svg(plot: Plot) -> str:
    """Return the plot as a complete SVG document."""
    return stacked_svg([plot])


def stacked_svg(plots: Sequence[Plot], between: Sequence[Panel] = ()) -> str:
    """Return plots one below the other as one SVG document, with the title of the first one.

    Panels stand `between` the first plot and the others.
    """
    every: list[Plot | Panel] = [plots[0], *between, *plots[1:]]
    wide = max(part.width for part in every)
    tall = sum(part.height for part in every)
    panels = []
    down = 0
    for part in every:
        elements = _elements(part) if isinstance(part, Plot) else part.elements
        panels += [f'<g transform="translate(0 {down})">', *elements, "</g>"]
        down += part.height
    return document(wide, tall, plots[0].title, " ".join(part.description for part in every), panels)


def document(
    width_px: float, height_px: float, title: str, description: str, elements: Iterable[str], style: str = ""
) -> str:
    """Return a complete SVG document of `elements` on a plain ground.

    `title` and `description` are read by screen readers and not drawn; `style` is CSS beside that of plots.
    """
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width_px:g} {height_px:g}" width="{width_px:g}" '
            f'height="{height_px:g}" role="img" aria-labelledby="plot-title plot-desc">',
            f'<title id="plot-title">{escape(title)}</title><desc id="plot-desc">{escape(description)}</desc>',
            f"<style>{STYLE}{style}</style>",
            f'<rect class="ground" width="{width_px:g}" height="{height_px:g}"/>',
            *elements,
            "</svg>\n",
        ]
    )


def _elements(plot: Plot) -> list[str]:
    inner = [*_frame(plot), *_edge(plot), *_limits(plot), *_series(plot), *_rings(plot), *_legend(plot)]
    heads = [text(LEFT, 32, plot.title, "title"), text(LEFT, 54, plot.subtitle, "quiet small")]
    return [*heads, *inner, *_labels(plot)]


def _x(plot: Plot, value: float) -> float:
    return LEFT + plot.x.at(value) * (plot.width - LEFT - RIGHT)


def _y(plot: Plot, value: float) -> float:
    return plot.height - BOTTOM - plot.y.at(value) * (plot.height - TOP - BOTTOM)


def text(x: float, y: float, words: str, kind: str = "", anchor: str = "start") -> str:
    """Return an SVG text element; `anchor` (start, middle or end) is the part of the text at (x, y)."""
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}" text-anchor="{anchor}">{escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    """Return an SVG line from (x1, y1) to (x2, y2) in px; `kind` is its CSS class."""
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="{kind}"/>'


def polyline(places: Iterable[tuple[float, float]], kind: str) -> str:
    """Return an SVG polyline through `places`, pairs (x, y) in px; `kind` is its CSS class."""
    return f'<polyline class="{kind}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in places)}"/>'


def rectangle(x: float, y: float, width_px: float, height_px: float, kind: str = "", style: str = "") -> str:
    """Return an SVG rectangle with the corner (x, y) in px; `kind` is its CSS class, `style` its own CSS."""
    own = f' style="{style}"' if style else ""
    return f'<rect class="{kind}"{own} x="{x:g}" y="{y:g}" width="{width_px:g}" height="{height_px:g}"/>'


def _upright(x: float, y: float, words: str) -> str:
    return f'<text transform="translate({x:.1f} {y:.1f}) rotate(-90)" text-anchor="middle">{escape(words)}</text>'


def _frame(plot: Plot) -> list[str]:
    low = plot.height - BOTTOM
    high = plot.width - RIGHT
    out = []
    for value, words in plot.x.ticks:
        at = _x(plot, value)
        out += [line(at, TOP, at, low, "grid"), text(at, low + 17, words, "small", "middle")]
    out += [text(_x(plot, value), low + 31, words, "quiet small", "middle") for value, words in plot.x.below]
    for value, words in plot.y.ticks:
        at = _y(plot, value)
        out += [line(LEFT, at, high, at, "grid"), text(LEFT - 8, at + 4, words, "small", "end")]
    for value, words in plot.right:
        at = _y(plot, value)
        if TOP <= at <= low:
            out += [line(high, at, high + 5, at, "frame"), text(high + 8, at + 4, words, "small")]
    middle = (TOP + low) / 2
    out.append(rectangle(LEFT, TOP, high - LEFT, low - TOP, "frame"))
    out.append(text((LEFT + high) / 2, plot.height - 14, plot.x.title, "", "middle"))
    out.append(_upright(24, middle, plot.y.title))
    if plot.right_title:
        out.append(_upright(plot.width - 14, middle, plot.right_title))
    return out


def _edge(plot: Plot) -> list[str]:
    """Return the Pareto front as a step line: constant up to the next point, then up, then constant to the end."""
    if not plot.edge:
        return []
    path = [f"M {_x(plot, plot.edge[0][0]):.1f} {_y(plot, plot.edge[0][1]):.1f}"]
    path += [f"H {_x(plot, x):.1f} V {_y(plot, y):.1f}" for x, y in plot.edge[1:]]
    path.append(f"H {plot.width - RIGHT}")
    return [f'<path class="edge" d="{" ".join(path)}"><title>Pareto edge: the best within each time</title></path>']


def _limits(plot: Plot) -> list[str]:
    out = []
    for value, words in plot.limits:
        if plot.x.low < value < plot.x.high:
            out.append(line(_x(plot, value), TOP, _x(plot, value), plot.height - BOTTOM, "limit"))
            out.append(text(_limit_label_px(plot, value, words), plot.height - BOTTOM - 8, words, "small limit-word"))
    return out


def _limit_label_px(plot: Plot, value: float, words: str) -> float:
    """Return where the label of a limit begins: right of its line, left of it where the frame ends."""
    at = _x(plot, value)
    wide = LETTER_PX * len(words)
    return at + 6 if at + 6 + wide < plot.width - RIGHT else at - 6 - wide


def _by_kind(plot: Plot) -> list[tuple[int, Series]]:
    """Return the series with the number of their shape and colour."""
    return [(place if series.kind is None else series.kind, series) for place, series in enumerate(plot.series)]


def _series(plot: Plot) -> list[str]:
    out = []
    for k, series in _by_kind(plot):
        out.append(f'<g class="s{k % KINDS}">')
        for trail in series.trails:
            places = [(_x(plot, mark.x), _y(plot, mark.y)) for mark in trail]
            if len(places) > 1:
                kind = "trail" if any(mark.weight for mark in trail) else "trail line"
                out.append(polyline(places, kind))
            for mark, (x, y) in zip(trail, places, strict=True):
                if not mark.weight:
                    continue
                shape = _shape(k, x, y, 6.5 * mark.weight, series.hollow)
                out.append(
                    f"{shape}<title>{escape(mark.tooltip)}</title></path>" if mark.tooltip else f"{shape}</path>"
                )
        out.append("</g>")
    return out


HOLLOW = "fill: none; stroke: var(--ink); stroke-width: 1.8"
# Corners, direction of the first one and size of the marks after the circle.
OUTLINES = (
    (4, pi / 4, 1.25),
    (3, -pi / 2, 1.3),
    (4, 0, 1.3),
    (3, pi / 2, 1.3),
    (5, -pi / 2, 1.2),
    (6, 0, 1.15),
    (3, 0, 1.3),
)


def _shape(k: int, x: float, y: float, r: float, hollow: bool = False) -> str:
    """Return the start tag of a mark of series `k`: circle, square, triangle, diamond or another polygon."""
    style = f' style="{HOLLOW}"' if hollow else ""
    if k % KINDS == 0:
        d = f"M {x - r:.1f} {y:.1f} a {r:.1f} {r:.1f} 0 1 0 {2 * r:.1f} 0 a {r:.1f} {r:.1f} 0 1 0 {-2 * r:.1f} 0 Z"
        return f'<path class="mark"{style} d="{d}">'
    corners, turn, grow = OUTLINES[k % KINDS - 1]
    around = [turn + 2 * pi * c / corners for c in range(corners)]
    places = " L ".join(f"{x + grow * r * cos(a):.1f} {y + grow * r * sin(a):.1f}" for a in around)
    return f'<path class="mark"{style} d="M {places} Z">'


def _rings(plot: Plot) -> list[str]:
    return [
        f'<circle class="ring" cx="{_x(plot, x):.1f}" cy="{_y(plot, y):.1f}" r="13">'
        f"<title>{escape(words)}</title></circle>"
        for x, y, words in plot.rings
    ]


def _legend(plot: Plot) -> list[str]:
    """Return one row above the frame: shape and name of each series, then the Pareto edge and the ring."""
    out = []
    at = float(LEFT + 6)
    for k, series in _by_kind(plot):
        if not series.named:
            continue
        out += [
            f'<g class="s{k % KINDS}">{_shape(k, at, TOP - 20, 6.0, series.hollow)}</path></g>',
            text(at + 11, TOP - 16, series.name, "small"),
        ]
        at += 11 + LETTER_PX * len(series.name) + 11
    if plot.edge:
        out += [line(at, TOP - 20, at + 24, TOP - 20, "edge"), text(at + 30, TOP - 16, "Pareto edge", "small")]
        at += 30 + LETTER_PX * 11 + 12
    if plot.rings:
        out += [
            f'<circle class="ring" cx="{at + 8:.1f}" cy="{TOP - 20}" r="8"/>',
            text(at + 22, TOP - 16, plot.rings[0][2], "small"),
        ]
    return out


def _labels(plot: Plot) -> list[str]:
    """Return every label beside its mark where it overlaps no other text or mark; one without space is left out.

    Labels of marks with more weight have the first choice; that of a light mark stands close to it.
    """
    taken: list[Box] = [
        (_x(plot, m.x) - 6, _y(plot, m.y) - 6, _x(plot, m.x) + 6, _y(plot, m.y) + 6) for m in _marks(plot)
    ]
    for value, level, _ in plot.rings:
        x = _x(plot, value)
        y = _y(plot, level)
        taken.append((x - 13, y - 13, x + 13, y + 13))
    for value, words in plot.limits:
        left = _limit_label_px(plot, value, words)
        x = _x(plot, value)
        y = plot.height - BOTTOM - 8
        ends = min(x, left) - GAP_PX, max(x, left + LETTER_PX * len(words)) + GAP_PX
        taken.append((ends[0], y - LINE_PX, ends[1], y + GAP_PX))
    labelled = [(k, mark) for k, series in _by_kind(plot) for trail in series.trails for mark in trail if mark.label]
    out = []
    for k, mark in sorted(labelled, key=lambda entry: -entry[1].weight):
        reach = (0, 6, 12, 20) if mark.weight >= FULL_WEIGHT else (0,)
        wide = len(mark.label) * LETTER_PX
        place = _free_position(_x(plot, mark.x), _y(plot, mark.y), wide, reach, taken, plot)
        if place is not None:
            taken.append((place[0] - GAP_PX, place[1], place[2] + GAP_PX, place[3]))
            out.append(f'<g class="s{k % KINDS}">{text(place[0], place[3] - 3, mark.label, "label small")}</g>')
    return out


def _marks(plot: Plot) -> list[Mark]:
    return [mark for series in plot.series for trail in series.trails for mark in trail]


def _free_position(
    x: float, y: float, wide: float, reach: Sequence[int], taken: Sequence[Box], plot: Plot
) -> Box | None:
    for near in reach:
        right = x + 10 + near
        left = x - 10 - near - wide
        middle = x - wide / 2
        over = y - 7 - near - LINE_PX
        under = y + 8 + near
        level = y - LINE_PX / 2
        for a, b in (
            (middle, over),
            (middle, under),
            (right, under),
            (left, over),
            (right, over),
            (left, under),
            (right, level),
            (left, level),
        ):
            box = (a, b, a + wide, b + LINE_PX)
            fits = (
                a > LEFT + 2 and a + wide < plot.width - RIGHT - 2 and b > TOP + 2 and box[3] < plot.height - BOTTOM - 2
            )
            if fits and not any(box[0] < t[2] and t[0] < box[2] and box[1] < t[3] and t[1] < box[3] for t in taken):
                return box
    return None
