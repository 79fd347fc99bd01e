"""`make results`: the Markdown page of all experiments that is kept in the repository, with some of their pictures."""

from base64 import b64decode
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from services.research.reconstruct_file import write_or_raise
from tests.paper.outcome import Claim, Figure
from tests.paper.report import ExperimentRun, on_the_paper, printed_value

PAGE = "tests/paper/results.md"
PICTURED = ("S1", "S3", "S4", "S5", "S6")  # the paper's figures 3 to 5
RAW = "what the sensor sees"  # not kept: noise takes most of the bytes
PNG = "data:image/png;base64,"
HEAD = "| assertion | here | limit | result | the paper says | label |\n|---|---|---|---|---|---|"
OPENING = """# The paper's experiments, as they ran here

Made by `make results` from `diffuscope paper` at full size, 1080 x 1920; do not edit. **All pictures are simulated.**
Words of the paper: Li, McKay, Durr, Tian, "A diffuser-based computational imaging funduscope". *Not reproduced*: the
simulation misses the statement; *put in*: the simulation was given the number; *ours*: the paper does not say it."""


def write_page(page: Path, ran: Sequence[ExperimentRun]) -> None:
    """Write the page, and the pictures of the experiments PICTURED into a folder `results` beside it."""
    folder = page.with_name("results")
    write_or_raise(folder, lambda: folder.mkdir(parents=True, exist_ok=True))
    parts = [OPENING, on_the_paper([claim for run in ran for claim in run.outcome.claims])]
    for run in ran:
        experiment, claims = run.experiment, run.outcome.claims
        parts += [f"## {experiment.key}: {experiment.title}", experiment.sentence, f"Paper: {experiment.paper}"]
        parts += ["\n".join([HEAD, *map(row, claims)])] if claims else []
        shown = [figure for figure in run.outcome.shown if _is_kept(figure)] if experiment.key in PICTURED else []
        for k, figure in enumerate(shown, 1):
            file = folder / f"{experiment.key}-{k}.png"
            write_or_raise(file, partial(file.write_bytes, b64decode(figure.address.removeprefix(PNG))))
            parts.append(f"![{figure.caption}](results/{file.name}) {figure.caption}")
    write_or_raise(page, lambda: page.write_text("\n\n".join(parts) + "\n", encoding="utf-8"))


def _is_kept(figure: Figure) -> bool:
    return figure.address.startswith(PNG) and not figure.wide and RAW not in figure.caption


def row(claim: Claim) -> str:
    """Return the row of an assertion."""
    why = f" ({claim.why})" if claim.why else ""
    cells = (claim.what, printed_value(claim), claim.limit, claim.status, claim.paper, f"*{claim.label}*{why}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def kept_values(page: str, key: str) -> dict[str, str]:
    """Return the value of each assertion of an experiment as the page has it."""
    section = page.split(f"\n## {key}: ")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][1:]
    return {what: value for what, value, *_ in (line.removeprefix("| ").split(" | ") for line in lines)}
