"""S13: the grid of hard cases with the default schedule; `diffuscope hard` runs every method as well."""

from base64 import b64encode
from dataclasses import replace

from services.lab.hard_cases import grid
from services.lab.hard_cases.cells import DEFAULT_SCHEDULE
from services.lab.hard_cases.judgement import COVERED, covered
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
    share, _ = covered(found.cells)
    rules = {
        "crash": "cells with an exception that is no refusal", "hidden": "losses above .05 without a word",
        "refraction": "refractions beyond 3 standard deviations", "message": "false messages",
        "quality": "better quality figures of clearly worse pictures",
    }  # fmt: skip
    count = {rule: sum(one.rule == rule for one in found.violations) for rule in rules}
    claims = (
        *(below(words, count[rule], 1, digits=0) for rule, words in rules.items()),
        above("refractions within 2 standard deviations, share", share, COVERED),
    )
    shown = tuple(Figure(f"Hard cases: {eye}", _address(found.picture(eye)), wide=True) for eye in found.eyes)
    why = Table(("worse without a message", "because"), tuple(explanations(found.cells).items()))
    broken = Table(("rule", "eye", "case", "method", "what is seen"), tuple(
        (one.rule, one.eye, one.case, one.method, one.words) for one in found.violations
    ))  # fmt: skip
    note = (
        f"{MERGED} x {MERGED} pixels are merged here, and only the default schedule runs; `diffuscope hard -o DIR` "
        "runs the whole sensor with every method. Each cell goes through the functions of `diffuscope reconstruct`, "
        "with raw, PSF and head file as a user gives them."
    )
    return Outcome(claims, shown, (why, broken) if found.violations else (why,), (note,))


def _address(svg: str) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}"


EXPERIMENTS = (
    Experiment(
        "S13", "The grid of hard cases", "Every kind of bad frame through the ladder as shipped.",
        "Not in the paper.", run_grid,
    ),
)  # fmt: skip
