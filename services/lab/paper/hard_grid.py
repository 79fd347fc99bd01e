"""S13: the grid of hard cases with the default schedule; `diffuscope hard` runs every method as well."""

from base64 import b64encode
from dataclasses import replace

from services.lab.hard_cases import grid
from services.lab.hard_cases.cells import DEFAULT_SCHEDULE
from services.lab.hard_cases.judgement import COVERED, covered, lost
from services.lab.hard_cases.picture import explanations
from services.lab.paper.bench import Bench
from services.lab.paper.outcome import Experiment, Figure, Outcome, Table, above, below

MERGED = 4  # n x n pixels combined: the grid has over a hundred pictures; `diffuscope hard` uses full resolution


def run_grid(bench: Bench) -> Outcome:
    """Run the grid for every eye by the default schedule, with merged pixels; return one claim per rule, and pictures.

    The other methods would take most of the report's time: each estimates the refraction of each frame.
    """
    eyes = tuple(replace(eye, merged=MERGED) for eye in grid.EYES)
    found = grid.run(eyes, columns=(DEFAULT_SCHEDULE,), progress=lambda line: bench.progress(f"S13: {line}"))
    (share, refractions), frames = covered(found.cells), len(found.cells)
    losses = sum(map(lost, found.cells))
    rules = {
        "crash": f"of {frames} frames, those with an exception that is no refusal",
        "hidden": f"of {losses} losses above .05, those without message or explanation",
        "refraction": f"of {refractions} refractions, those beyond 3 standard deviations",
        "message": f"of {frames} frames, those with a false message",
        "quality": f"of {losses} losses above .05, those with a better quality figure",
    }
    count = {rule: sum(one.rule == rule for one in found.violations) for rule in rules}
    claims = (
        *(below(words, count[rule], 1, digits=0).limit_from("none may occur") for rule, words in rules.items()),
        above(f"share of {refractions} refractions within 2 standard deviations", share, COVERED)
        .limit_from("95 % if the standard deviations are right, less 5 % for their number"),
    )  # fmt: skip
    shown = tuple(Figure(f"Hard cases: {eye}", _address(found.picture(eye)), wide=True) for eye in found.eyes)
    why = Table(("loss above .05 without a message", "explanation"), tuple(explanations(found.cells).items()))
    broken = Table(("rule", "eye", "case", "method", "what is seen"), tuple(
        (one.rule, one.eye, one.case, one.method, one.words) for one in found.violations
    ))  # fmt: skip
    note = (
        f"{MERGED} x {MERGED} pixels are merged here, and only the default schedule (`ladder` in table and pictures) "
        "runs; `diffuscope hard -o DIR` runs the whole sensor with every method. A loss is a PCC below that of the "
        "eye's clean frame; it needs a message with its picture, a refusal, or an explanation in the table. Each frame "
        "goes through the functions of `diffuscope reconstruct`, with raw, PSF and head file as a user gives them."
    )
    return Outcome(claims, shown, (why, broken) if found.violations else (why,), (note,))


def _address(svg: str) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}"


EXPERIMENTS = (
    Experiment(
        "S13", "The grid of hard cases", "Three eyes, each with every kind of bad frame, by the default schedule.",
        "Not in the paper.", run_grid,
    ),
)  # fmt: skip
