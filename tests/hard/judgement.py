"""Rules for every cell: a loss is reported or explained, and every message is true.

crash       an exception other than a refusal
hidden      a picture more than LOST below clean, without message, refusal or explanation
refraction  an error above SIGMAS standard deviations, even with a message; or a value, without a message, for a frame
            whose refraction is undefined
message     a message that is not true of the frame
quality     a PCC more than LOST below clean, and a quality figure better than the clean frame's by more than SLACK
coverage    over the grid: fewer than COVERED of the refractions within two standard deviations
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from device.recon.methods import METHODS
from tests.hard.cases import CLEAN, NAMED, Case
from tests.hard.cells import DEFAULT_SCHEDULE, PEER, Cell

LOST = 0.05
SIGMAS = 3.0
COVERED, COVERED_SIGMAS = 0.9, 2.0
SLACK = 0.02  # relative change of a quality figure from one noise realisation to another
BETTER: Mapping[str, int] = {  # 1: larger is better, -1: smaller
    "structure_nats": 1,
    "structure_sure": 1,
    "through": 1,
    "coverage": 1,
    "cutoff_per_px": 1,
    "resolution_um": -1,
}
KINDS: tuple[tuple[str, tuple[str, ...]], ...] = (  # the first match applies
    ("pupil", ("pupil hides",)),
    ("ghost", ("second image",)),
    ("far", ("is beyond 10 dpt",)),
    ("refraction", ("refraction",)),
    ("signal", ("no signal",)),
    ("dim", ("too little light",)),
    ("eye", ("no eye", "from everywhere")),
    ("swapped", ("swapped",)),
    ("psf", ("psf",)),
    ("misfit", ("does not explain",)),
    ("spots", ("dark spots", "spots on")),
    ("falloff", ("falls off",)),
    ("step", ("gain of the sensor changes",)),
    ("leak", ("leak of light",)),
    ("bright", ("too bright",)),
    ("lit", ("is lit", "of the field")),
    ("counts", ("black level", "gain", "bits", "counts", "jpeg")),
    ("pixels", ("pixel",)),
)
ALWAYS = frozenset({"refraction"})  # an uncertain refraction is no statement about the picture


@dataclass(frozen=True)
class Violation:
    """One violation: rule, eye, case, method, and a description with the figures."""

    rule: str
    eye: str
    case: str
    method: str
    words: str


def judged(cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells to which the rules apply: all but those of PEER."""
    return [cell for cell in cells if cell.method != PEER]


def kind(message: str) -> str:
    """Return the kind of a message: the first name in KINDS with a word in the message; "other" without a match."""
    lowered = message.lower()
    return next((name for name, words in KINDS if any(word in lowered for word in words)), "other")


def violations(cells: Sequence[Cell], cases: Mapping[str, Case] = NAMED) -> list[Violation]:
    """Return the violations of all cells but those of PEER, in cell order; the one of the coverage rule is last."""
    clean = {(cell.eye, cell.method): cell for cell in cells if cell.case == CLEAN.key}
    found = []
    for cell in judged(cells):
        case = cases[cell.case]
        words = {
            "crash": cell.refused if cell.crashed else "",
            "hidden": _hidden(cell, case),
            "refraction": _refraction(cell),
            "message": _message(cell, case),
            "quality": _quality(cell, clean[cell.eye, cell.method]),
        }
        found += [Violation(rule, cell.eye, cell.case, cell.method, detail) for rule, detail in words.items() if detail]
    share, count = covered(cells)
    if count and share < COVERED:
        found.append(
            Violation("coverage", "all", "all", DEFAULT_SCHEDULE, f"{share:.0%} of {count} refractions within 2 sd")
        )
    return found


def covered(cells: Sequence[Cell]) -> tuple[float, int]:
    """Return the share of default-schedule refractions within two standard deviations (0 if none), and their number."""
    off = [abs(cell.off_sd) for cell in cells if cell.method == DEFAULT_SCHEDULE and cell.off_sd is not None]
    return sum(sigmas <= COVERED_SIGMAS for sigmas in off) / max(len(off), 1), len(off)


def ratio(cell: Cell) -> float | None:
    """Return the loss of PCC over the allowed loss: 0 for the clean frame, 1 at the limit; None without a picture."""
    return None if cell.lost is None else cell.lost / LOST


def lost(cell: Cell) -> bool:
    """Return whether the loss of PCC is above the allowed one or NaN; False without a picture."""
    share = ratio(cell)
    return share is not None and not share <= 1


def explanation(cell: Cell, case: Case) -> str:
    """Return the case's reason for a worse picture without a message by this method; "" if there is none."""
    return case.explained.get(cell.method) or case.explained.get("all", "")


def _hidden(cell: Cell, case: Case) -> str:
    if not lost(cell) or cell.refused or cell.warnings or explanation(cell, case):
        return ""
    return f"PCC {cell.pcc:.3f}, {cell.lost:.3f} below clean, and nothing is said"


def _refraction(cell: Cell) -> str:
    """Return the text of a violation of the refraction rule, "" without one.

    Only the default schedule is judged; all columns share its refraction.
    """
    if cell.method != DEFAULT_SCHEDULE or cell.sphere_dpt is None or cell.sd_dpt is None:
        return ""
    given = f"{cell.sphere_dpt:+.2f} +- {cell.sd_dpt:.2f} dpt"
    if cell.off_sd is None:
        return "" if cell.warnings else f"{given} of a frame that holds no refraction"
    return "" if abs(cell.off_sd) <= SIGMAS else f"{given}, in truth {cell.true_dpt:+.2f}: {cell.off_sd:+.1f} sd"


def _message(cell: Cell, case: Case) -> str:
    """Return the false messages of a cell; that a closed form does not explain a frame is true where it loses it."""
    method = METHODS.get(cell.method)
    unexplained = {"misfit"} if method is not None and method.rounds == 0 and lost(cell) else set()
    false = [words for words in cell.warnings if kind(words) not in case.true | ALWAYS | unexplained]
    return " / ".join(f"false: {words}" for words in false)


def _quality(cell: Cell, clean: Cell) -> str:
    if not lost(cell):
        return ""
    better = []
    for name, sign in BETTER.items():
        here, there = cell.quality.get(name), clean.quality.get(name)
        if here is not None and there is not None and sign * (here - there) > SLACK * abs(there):
            better.append(f"{name} {here:.3g} (clean {there:.3g})")
    return f"{cell.lost:.3f} below clean, and better: {', '.join(better)}" if better else ""
