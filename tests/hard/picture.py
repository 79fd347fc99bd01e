"""Heat map of the grid as SVG, and its Markdown tables: a row per hard case, a column per method."""

from collections.abc import Mapping, Sequence
from html import escape

from services.plot import document, rectangle, text
from tests.hard.cases import CASES, NAMED
from tests.hard.cells import Cell
from tests.hard.judgement import LOST, Violation, explanation, lost, ratio

LEFT, TOP, WIDE, TALL, GAP, SKIP = 250, 150, 104, 24, 2, 10
SHADES = (  # upper limit of the loss over the allowed one, colour, text colour
    (0.2, "#1a7f5a", "#ffffff"),
    (1, "#8fd0a8", "#10231a"),
    (3, "#f3dc8c", "#33290a"),
    (8, "#e89a5b", "#2e1706"),
    (float("inf"), "#b8403a", "#ffffff"),
)
REFUSED = "#8a8f98", "#ffffff"
LEGEND = (
    f"loss of PCC against the same method's clean frame, over the allowed loss of {LOST}: clean 0, limit 1",
    "m: a message is given   e: explained in hard-cases.md   red frame: must not be",
)


def draw_grid(
    cells: Sequence[Cell],
    broken: Sequence[Violation],
    eye: str,
    columns: Sequence[str],
    margins: Mapping[str, tuple[float, float]],
) -> str:
    """Return the SVG of one eye's grid; colour: loss over the allowed one, red frame: violation.

    Below it the `margins`, error and bound of each test with a bound, as error over bound.
    """
    mine = {(cell.case, cell.method): cell for cell in cells if cell.eye == eye}
    bad = {(violation.case, violation.method) for violation in broken if violation.eye == eye}
    inner, y, group = [], TOP, ""
    for case in CASES:
        if not any((case.key, column) in mine for column in columns):
            continue
        y, group = y + (SKIP if group and case.group != group else 0), case.group
        inner.append(text(LEFT - 10, y + TALL - 7, case.key, "small", "end"))
        row = mine[case.key, columns[0]]
        inner.append(text(LEFT + len(columns) * WIDE + 8, y + TALL - 7, _refraction(row), "small"))
        for k, column in enumerate(columns):
            cell = mine[case.key, column]
            inner += _cell(cell, LEFT + k * WIDE, y, (case.key, column) in bad)
        y += TALL
    below = y + 3 * SKIP
    return _document(eye, columns, [*inner, *_margins(margins, below)], below + (len(margins) + 1) * TALL)


def _margins(margins: Mapping[str, tuple[float, float]], y: int) -> list[str]:
    out = [text(20, y + TALL - 7, "error over its bound, where a bound is known: limit 1", "small")] if margins else []
    for k, (name, (error, bound)) in enumerate(margins.items(), 1):
        colour, ink = _shade(error / bound)
        out += [
            _box(20, y + k * TALL, 60, TALL - GAP, colour),
            _label(50, y + (k + 1) * TALL - 8, f"{error / bound:.2f}", ink),
            text(90, y + (k + 1) * TALL - 7, name.replace("_", " "), "small"),
        ]
    return out


def _shade(share: float) -> tuple[str, str]:
    """Return the colours of box and text of a loss over the allowed one; of NaN those of the largest loss."""
    return next(((colour, ink) for limit, colour, ink in SHADES if share < limit), SHADES[-1][1:])


def _document(eye: str, columns: Sequence[str], inner: Sequence[str], y: int) -> str:
    wide, tall = LEFT + len(columns) * WIDE + 150, y + 24
    heads = [text(LEFT + (k + 0.5) * WIDE, TOP - 10, name, "small", "middle") for k, name in enumerate(columns)]
    heads.append(text(LEFT + len(columns) * WIDE + 8, TOP - 10, "refraction error", "small"))
    legend = [text(20, 56 + 18 * k, line, "quiet small") for k, line in enumerate(LEGEND)]
    title = f"Hard cases: {eye}"
    elements = [text(20, 32, title, "title"), *legend, *_scale(), *heads, *inner]
    return document(wide, tall, title, " ".join(LEGEND), elements)


def _scale() -> list[str]:
    out, x, before = [text(20, 106, "loss:", "small")], 90, 0.0
    for limit, colour, ink in SHADES:
        words = f"< {limit:g}" if limit != float("inf") else f"> {before:g}"
        out += [_box(x, 92, 60, 20, colour), _label(x + 30, 106, words, ink)]
        x, before = x + 62, limit
    return [*out, _box(x, 92, 60, 20, REFUSED[0]), _label(x + 30, 106, "refused", REFUSED[1])]


def _cell(cell: Cell, x: int, y: int, broken: bool) -> list[str]:
    colour, ink = REFUSED
    words, says = "crashed" if cell.crashed else "refused", cell.refused
    share = ratio(cell)
    if share is not None:
        colour, ink = _shade(share)
        explained = lost(cell) and explanation(cell, NAMED[cell.case])
        marks = ("m" if cell.warnings else "") + ("e" if explained else "")
        words = f"{share:.2f} {marks}".rstrip()
        says = " / ".join(cell.warnings)
    out = [
        f"<g><title>{escape(f'{cell.case}, {cell.method}: {says}')}</title>",
        _box(x, y, WIDE - GAP, TALL - GAP, colour),
        _label(x + WIDE / 2 - 1, y + TALL - 8, words, ink),
    ]
    if broken:
        style = "fill: none; stroke: #e00000; stroke-width: 3"
        out.append(rectangle(x + 1, y + 1, WIDE - GAP - 2, TALL - GAP - 2, style=style))
    return [*out, "</g>"]


def _refraction(cell: Cell) -> str:
    if cell.sphere_dpt is None:
        return "none"
    if cell.off_sd is None:
        return f"{cell.sphere_dpt:+.2f} of none"
    return f"{cell.off_sd:+.1f} sd"


def _box(x: float, y: float, wide: float, tall: float, colour: str) -> str:
    return rectangle(x, y, wide, tall, style=f"fill: {colour}")


def _label(x: float, y: float, words: str, ink: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" class="small" text-anchor="middle" style="fill:{ink}">{escape(words)}</text>'


def table(cells: Sequence[Cell], columns: Sequence[str]) -> str:
    """Return one Markdown table per eye: cases by columns, loss over the allowed one; messages."""
    lines: list[str] = []
    for eye in dict.fromkeys(cell.eye for cell in cells):
        mine = {(cell.case, cell.method): cell for cell in cells if cell.eye == eye}
        lines += [
            "",
            f"## {eye}",
            "",
            f"| case | {' | '.join(columns)} | refraction | messages |",
            "|---|" + "---|" * (len(columns) + 2),
        ]
        above = [sum(lost(cell) for (_, method), cell in mine.items() if method == name) for name in columns]
        lines.append(
            f"| **above 1** | {' | '.join(f'{count} of {len(mine) // len(columns)}' for count in above)} | | |"
        )
        for case in dict.fromkeys(cell.case for cell in cells if cell.eye == eye):
            row = mine[case, columns[0]]
            lines.append(
                f"| {case} | {' | '.join(_figures(mine[case, name]) for name in columns)} | "
                f"{_refraction(row)} | {' '.join(row.warnings) or row.refused} |"
            )
    return "\n".join(lines)


def _figures(cell: Cell) -> str:
    if cell.crashed:
        return "crashed"
    share = ratio(cell)
    return "refused" if share is None else f"{share:.2f}"


def explanations(cells: Sequence[Cell]) -> Mapping[str, str]:
    """Return the reasons for worse pictures without a message that have one, by the key "CASE, METHOD"."""
    return {
        f"{cell.case}, {cell.method}": explanation(cell, NAMED[cell.case])
        for cell in cells
        if lost(cell) and not cell.warnings and explanation(cell, NAMED[cell.case])
    }
