"""S13: the grid of hard cases, through every method and the ladder as shipped (`diffuscope hard`)."""

from base64 import b64encode
from dataclasses import replace

from services.instrument.hard_cases import grid
from services.instrument.hard_cases.judgement import COVERED, covered
from services.instrument.hard_cases.picture import explanations
from services.instrument.paper.bench import Bench
from services.instrument.paper.outcome import Experiment, Outcome, Sheet, Shown, above, below

MERGED = 4  # pixels to one: the grid has hundreds of pictures; `diffuscope hard` takes the whole sensor


def run_grid(bench: Bench) -> Outcome:
    """Every eye, row and column; a claim for each rule that a cell can break."""
    eyes = tuple(replace(eye, merged=MERGED) for eye in grid.EYES)
    found = grid.run(eyes, say=lambda line: bench.say(f"S13: {line}"))
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
    shown = tuple(Shown(f"Hard cases: {eye}", _address(found.picture(eye)), wide=True) for eye in found.eyes)
    why = Sheet(("worse without a message", "because"), tuple(explanations(found.cells).items()))
    broken = Sheet(("rule", "eye", "case", "method", "what is seen"), tuple(
        (one.rule, one.eye, one.case, one.method, one.words) for one in found.violations
    ))  # fmt: skip
    note = (
        f"{MERGED} x {MERGED} pixels are merged here; `diffuscope hard -o DIR` runs the whole sensor. Each cell goes "
        "through the functions of `diffuscope reconstruct`, with raw, PSF and head file as a user gives them."
    )
    return Outcome(claims, shown, (why, broken) if found.violations else (why,), (note,))


def _address(svg: str) -> str:
    return f"data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}"


EXPERIMENTS = (
    Experiment(
        "S13", "The grid of hard cases", "Every kind of bad frame through every method and the ladder as shipped.",
        "Not in the paper.", run_grid,
    ),
)  # fmt: skip
