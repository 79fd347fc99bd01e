"""One run of the grid of hard cases: reconstructs all cells and writes `hard-cases.json`, tables and pictures."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from device.errors import SettingError
from services.research.peers import ENVIRONMENT, installed_peer
from services.research.reconstruct_file import write_or_raise
from tests.hard.cases import CASES, CLEAN, NAMED
from tests.hard.cells import COLUMNS, DEFAULT_SCHEDULE, PEER, PEER_ROUNDS, CaseRunner, Cell
from tests.hard.figures import margins_table, recorded, worst_margins
from tests.hard.frames import Eye
from tests.hard.judgement import LOST, Violation, covered, judged, ratio, violations
from tests.hard.picture import draw_grid, explanations, table

EYES = (
    Eye("relaxed eye, paper's sensor", "sim", {"sim.seed": 1}),
    Eye("short-sighted eye, paper's sensor", "sim", {"sim.seed": 7, "sim.eye.m_dpt": 2.5}),
    Eye("long-sighted eye, IMX296", "imx296", {"sim.seed": 5, "sim.eye.m_dpt": -1.5, "sim.peak_e": 8000.0}),
)
LENS_EYES = (
    Eye("relaxed eye, lenslets", "imx296_lenslets", {"sim.seed": 5, "sim.peak_e": 8000.0}),
    Eye("long-sighted eye, lenslets", "imx296_lenslets", {"sim.seed": 7, "sim.eye.m_dpt": -1.5, "sim.peak_e": 8000.0}),
)
DRAWN_DPT = 4.0  # drawn eyes have a mean sphere between minus and plus that
QUICK_MERGED, QUICK_COLUMNS = (
    4,
    (DEFAULT_SCHEDULE, "tikhonov", PEER),
)  # of one eye: within a minute on a laptop
QUICK = (
    "1.0% saturated",
    "glare, 0.3 % clipped",
    "dead columns, declared",
    "dead columns, 0 DN",
    "dead blob, declared",
    "dead blob, 0 DN",
    "warm, 0.10% + 1500 DN",
    "100 e- peak",
    "eye off by +2 dpt",
    "PSF of another head",
    "half a lid",
    "1 % NaN",
    "all zeros",
    "constant",
    "black level off by 20 DN",
)
ProgressCallback = Callable[[str], None]


def drawn_eyes(count: int) -> tuple[Eye, ...]:
    """Return eyes with other vessels, diffusers and refractions than `EYES`, by turns before the paper's and IMX296."""
    spheres = np.random.default_rng(44).uniform(-DRAWN_DPT, DRAWN_DPT, count)
    heads = {"sim": {}, "imx296": {"sim.peak_e": 8000.0}}
    return tuple(
        Eye(f"eye {k + 1}, {m_dpt:+.1f} dpt, {head}", head, {"sim.seed": 101 + k, "sim.eye.m_dpt": float(m_dpt)} | more)
        for k, (m_dpt, (head, more)) in enumerate(zip(spheres, cycle(heads.items())))
    )


@dataclass(frozen=True)
class HardCases:
    """Cells of a run, and the violations found in them."""

    columns: tuple[str, ...]
    cells: tuple[Cell, ...]
    violations: tuple[Violation, ...]

    @property
    def eyes(self) -> tuple[str, ...]:
        """Return the names of the eyes, in order."""
        return tuple(dict.fromkeys(cell.eye for cell in self.cells))

    def picture(self, eye: str) -> str:
        """Return the SVG of one eye's grid."""
        return draw_grid(self.cells, self.violations, eye, self.columns, worst_margins(recorded()))


def run(
    eyes: Sequence[Eye] = EYES,
    keys: Sequence[str] = (),
    columns: tuple[str, ...] = COLUMNS,
    progress: ProgressCallback = lambda line: None,
) -> HardCases:
    """Run the cases `keys` (default: all) and the clean one of each eye through `columns`; return cells and violations.

    `progress` is called with one line per eye and case. The column PEER is left out where LenslessPiCam is not
    installed. SettingError for an unknown case or column.
    """
    for known, asked, what in ((NAMED, keys, "hard case"), ((*COLUMNS, PEER), columns, "column")):
        for name in asked:
            if name not in known:
                raise SettingError(f"no {what} is called {name!r}", f"Choose from: {'; '.join(known)}.")
    cells: list[Cell] = []
    with installed_peer(ENVIRONMENT if PEER in columns else None, (PEER_ROUNDS,), progress) as peer:
        columns = tuple(name for name in columns if name != PEER or peer is not None)
        for eye in eyes:
            progress(f"{eye.name}: planning")
            with TemporaryDirectory() as folder:
                grid = CaseRunner(eye, Path(folder), columns, peer)
                for case in CASES:
                    if not keys or case.key in keys or case is CLEAN:
                        cells += grid.cells(case)
                        progress(f"{eye.name}: {case.key}: {_brief(cells[-len(columns)])}")
    return HardCases(columns, tuple(cells), tuple(violations(cells)))


def _brief(cell: Cell) -> str:
    if cell.pcc is None:
        return f"refused: {cell.refused}"
    eye = "no refraction" if cell.sphere_dpt is None else f"{cell.sphere_dpt:+.2f} +- {cell.sd_dpt:.2f} dpt"
    return f"{cell.method} PCC {cell.pcc:.3f} ({-(cell.lost or 0):+.3f}), {eye}" + "".join(
        f"; {words}" for words in cell.warnings
    )


def write(folder: Path, found: HardCases) -> None:
    """Write `hard-cases.json`, `hard-cases.md` and a picture of each eye; StoreError if a file cannot be written."""
    write_or_raise(folder, lambda: folder.mkdir(parents=True, exist_ok=True))
    whole = {
        "cells": [asdict(cell) | {"off_sd": cell.off_sd, "ratio": ratio(cell)} for cell in found.cells],
        "violations": [asdict(violation) for violation in found.violations],
    }
    pages = {"hard-cases.json": json.dumps(whole, indent=1) + "\n", "hard-cases.md": markdown(found)}
    pages |= {f"hard-cases-{k}.svg": found.picture(eye) for k, eye in enumerate(found.eyes, 1)}
    for name, content in pages.items():
        write_or_raise(folder / name, partial((folder / name).write_text, content, encoding="utf-8"))


def markdown(found: HardCases) -> str:
    """Return the Markdown report: table, explained losses, violations."""
    share, count = covered(found.cells)
    lines = [
        "# Hard cases",
        "",
        f"Loss of PCC inside the lit field against the same method's clean frame, over the allowed loss of {LOST}:",
        "0 is the clean frame, 1 the limit; hard-cases.json has the PCC itself.",
        table(found.cells, found.columns),
        "",
        "## Errors over their bounds",
        "",
        "Where a bound is known (`python -m tests.hard.figures`): the worst case of each test, limit 1.",
        "",
        margins_table(recorded()),
        "",
        "## Explained losses",
        "",
        *(f"* {where}: {why}" for where, why in explanations(found.cells).items()),
        "",
        "## Violations",
        "",
        f"{share:.0%} of {count} refractions lie within two standard deviations.",
        "",
        summary(found),
        "",
    ]
    return "\n".join(lines)


def summary(found: HardCases) -> str:
    """Return one line per violation, and a line with the numbers of violations and cells."""
    lines = [
        f"* {violation.rule}: {violation.eye}; {violation.case}; {violation.method}: {violation.words}"
        for violation in found.violations
    ]
    return "\n".join([*lines, f"{len(found.violations)} violations of {len(judged(found.cells))} cells"])
