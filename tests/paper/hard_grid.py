"""S13: the grid of hard cases with the default schedule; `diffuscope hard` runs every method as well."""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import replace

from tests.hard import grid
from tests.hard.cases import CLEAN, NAMED
from tests.hard.cells import DEFAULT_SCHEDULE, Cell
from tests.hard.judgement import COVERED, covered, explanation, lost
from tests.paper.bench import Bench
from tests.paper.outcome import Experiment, Figure, Outcome, Table, above, below

EXPLAINED = (
    "the default schedule does not recover the detail of those explained only: we wrote the explanation; the "
    "instrument gives only the resolution figure of the table, none where no detail is above the noise"
)
MERGED = 4  # n x n pixels combined: the grid has over a hundred pictures; `diffuscope hard` uses full resolution


def run_grid(bench: Bench) -> Outcome:
    """Run the grid for every eye by the default schedule, with merged pixels; return one claim per rule, and pictures.

    The other methods would take most of the report's time: each estimates the refraction of each frame.
    """
    eyes = tuple(replace(eye, merged=MERGED) for eye in grid.EYES)
    found = grid.run(eyes, columns=(DEFAULT_SCHEDULE,), progress=lambda line: bench.progress(f"S13: {line}"))
    (share, refractions), frames = covered(found.cells), len(found.cells)
    losing = [cell for cell in found.cells if lost(cell)]
    losses, warned = len(losing), sum(bool(cell.warnings) for cell in losing)
    unsaid = [cell for cell in losing if not cell.warnings and explanation(cell, NAMED[cell.case])]
    rules = {
        "crash": f"of {frames} frames, those at which the program failed",
        "hidden": f"{losses} losses above .05 less {warned} with a message, {len(unsaid)} explained only",
        "refraction": f"of {refractions} refractions, those beyond 3 standard deviations",
        "message": f"of {frames} frames, those with a false message",
        "quality": f"of {losses} losses above .05, those with a better quality figure",
    }
    count = {rule: sum(violation.rule == rule for violation in found.violations) for rule in rules}
    claims = (
        *(
            below(words, count[rule], 1, digits=0)
            .ours(EXPLAINED if rule == "hidden" else "")
            .limit_from("none may occur")
            for rule, words in rules.items()
        ),
        above(f"share of {refractions} refractions within 2 standard deviations", share, COVERED).limit_from(
            "95 % if the standard deviations are right, less 5 % for their number"
        ),
    )
    shown = tuple(Figure(f"Hard cases: {eye}", _address(found.picture(eye)), wide=True) for eye in found.eyes)
    why = _unsaid(unsaid, found.cells)
    broken = Table(
        ("rule", "eye", "case", "method", "what is seen"),
        tuple(
            (violation.rule, violation.eye, violation.case, violation.method, violation.words)
            for violation in found.violations
        ),
    )
    note = (
        f"{MERGED} x {MERGED} pixels are merged here, and only the default schedule (`ladder` in table and pictures) "
        "runs; `diffuscope hard -o DIR` runs the whole sensor with every method. A loss is a PCC below that of the "
        "eye's clean frame; it needs a message with its picture or an explanation of ours in the table. A frame that "
        "the instrument refuses, with a reason, has no picture and no loss; that is no failure of the program. Each "
        "frame goes through the functions of `diffuscope reconstruct`, with raw, PSF and head file as a user gives "
        "them."
    )
    return Outcome(claims, shown, (why, broken) if found.violations else (why,), (note,))


def _unsaid(cells: Sequence[Cell], every: Sequence[Cell]) -> Table:
    """Return the losses without a message, with the resolution figure beside the clean frame's and our explanation."""
    clean = {cell.eye: cell for cell in every if cell.case == CLEAN.key}
    rows = tuple(
        (
            f"{cell.case}, {cell.eye}",
            f"{cell.lost:.3f}",
            _resolution(cell),
            _resolution(clean[cell.eye]),
            explanation(cell, NAMED[cell.case]),
        )
        for cell in cells
    )
    head = ("loss above .05 without a message", "PCC lost", "resolution, um", "clean frame's, um", "our explanation")
    return Table(head, rows)


def _resolution(cell: Cell) -> str:
    """Return the resolution figure in um on the sensor that a picture has beside it."""
    value = cell.quality.get("resolution_um")
    return "none" if value is None else f"{value:.0f}"


def _address(svg: str) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}"


EXPERIMENTS = (
    Experiment(
        "S13",
        "The grid of hard cases",
        "Three eyes, each with every kind of bad frame, by the default schedule.",
        "Not in the paper.",
        run_grid,
    ),
)
