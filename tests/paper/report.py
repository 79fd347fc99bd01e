"""`diffuscope paper`: runs all experiments, several at a time, and writes the HTML report in their order."""

import os
from base64 import b64decode
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from html import escape
from multiprocessing import get_context
from pathlib import Path
from typing import get_args

from device.clock import Clock, SystemClock
from device.errors import SettingError
from services.report_style import STYLE
from services.research.reconstruct_file import write_or_raise
from tests.paper import (
    caustics,
    first_order,
    hard,
    hard_grid,
    lenslets,
    light,
    printed,
    rules,
    screen,
    sensors,
    traced,
    trainer,
)
from tests.paper.bench import Bench
from tests.paper.outcome import Claim, Experiment, Figure, Label, Outcome, Status, Table
from tests.paper.texts import CLAIMED, GLOSSARY

ORDER = (
    "N",
    "T",
    "S0",
    "S1",
    "S2",
    "S2b",
    "S3",
    "S4",
    "S5",
    "S6",
    "S7",
    "S8",
    "S9",
    "S10",
    "S11",
    "S12",
    "S13",
    "M",
    "L",
    "D",
)
LONGEST = ("S13", "D", "L")  # begun first, so that no process is left alone with one of them
WORKERS = 2  # processes of the whole report: most experiments use one core
MARKS: dict[Status, str] = {"holds": "", "does not hold": "NO", "not reproduced": "NR"}
CLASSES: dict[Status, str] = {"holds": "yes", "does not hold": "no", "not reproduced": "open"}
_ALL = (first_order, traced, caustics, screen, printed, trainer, sensors, hard, hard_grid, rules, light, lenslets)
EXPERIMENTS: dict[str, Experiment] = {
    key: experiment for key in ORDER for part in _ALL for experiment in part.EXPERIMENTS if experiment.key == key
}


@dataclass(frozen=True)
class ExperimentRun:
    """An experiment, its outcome and its run time."""

    experiment: Experiment
    outcome: Outcome
    seconds: float


def run_experiments(
    folder: Path, clock: Clock, progress: Callable[[str], None], keys: Sequence[str] = (), merged: int = 1
) -> list[ExperimentRun]:
    """Run the experiments `keys` (default: all), write `report.html` and PNG files into a folder; return the outcomes.

    `merged` n combines n x n pixels, as stated in the report. One experiment runs in this process, several in WORKERS
    processes, which measure with the system's clock. `progress` is called with one line per experiment, and for a
    single one with a line per step. SettingError for an unknown key; StoreError for an unwritable folder.
    """
    for key in keys:
        if key not in EXPERIMENTS:
            raise SettingError(f"no experiment is called {key!r}", f"Choose from {', '.join(EXPERIMENTS)}.")
    write_or_raise(folder, lambda: folder.mkdir(parents=True, exist_ok=True))
    chosen = [key for key in EXPERIMENTS if not keys or key in keys]
    found: dict[str, ExperimentRun] = {}
    several = _run_in_processes(chosen, merged) if len(chosen) > 1 else map(_run, chosen, [merged], [clock], [progress])
    for ran in several:
        found[ran.experiment.key] = ran
        _write_pictures(folder, ran.outcome)
        progress(f"{ran.experiment.key}: {summary(ran.outcome.claims)}")
    ordered, page = [found[key] for key in chosen], folder / "report.html"
    write_or_raise(page, lambda: page.write_text(html(ordered, merged), encoding="utf-8"))
    return ordered


def _run(key: str, merged: int, clock: Clock, progress: Callable[[str], None]) -> ExperimentRun:
    begin_s = clock.now_s()
    outcome = EXPERIMENTS[key].labelled(EXPERIMENTS[key].run(Bench(merged, progress)))
    return ExperimentRun(EXPERIMENTS[key], outcome, clock.now_s() - begin_s)


def _run_in_processes(keys: Sequence[str], merged: int) -> Iterator[ExperimentRun]:
    """Yield the runs of experiments as they end; an error of one ends all."""
    first = sorted(keys, key=lambda key: key not in LONGEST)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # each core has a process of its own
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:  # a fork would copy the threads of the kernels
        waiting = [pool.submit(_run_alone, key, merged) for key in first]
        try:
            for done in as_completed(waiting):
                outcome, seconds, key = done.result()
                yield ExperimentRun(EXPERIMENTS[key], outcome, seconds)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _run_alone(key: str, merged: int) -> tuple[Outcome, float, str]:
    """Run one experiment in a process of the pool; return its outcome, seconds and key."""
    ran = _run(key, merged, SystemClock(), lambda line: None)
    return ran.outcome, ran.seconds, key


def _write_pictures(folder: Path, outcome: Outcome) -> None:
    for shown in outcome.shown:
        if shown.file:
            path, content = folder / shown.file, b64decode(shown.address.split(",", 1)[1])
            write_or_raise(path, partial(path.write_bytes, content))


def all_hold(ran: Sequence[ExperimentRun]) -> bool:
    """Return whether every assertion of every experiment holds; what is not reproduced is no assertion."""
    return all(claim.status != "does not hold" for run in ran for claim in run.outcome.claims)


def summary(claims: Sequence[Claim]) -> str:
    """Return how many assertions hold, of how many, and how many statements of the paper are not reproduced."""
    states = [claim.status for claim in claims]
    if not states:
        return "shown, nothing is asserted"
    missed = states.count("not reproduced")
    words = f"{states.count('holds')} of {len(states) - missed} assertions hold"
    return words + (f"; statements of the paper that are not reproduced: {missed}" if missed else "")


def on_the_paper(claims: Sequence[Claim]) -> str:
    """Return in words how many rows on the paper's own statements hold, and how many rows are on none of these."""
    found = Counter(claim.label for claim in claims)
    held = Counter(claim.label for claim in claims if claim.holds)
    tested = found["as written"] + found["adapted"] + found["not reproduced"]
    return (
        f"{held['as written'] + held['adapted']} of {tested} rows on the paper's own statements hold "
        f"({held['as written']} as written, {held['adapted']} adapted), {found['not reproduced']} are not reproduced. "
        f"The other {len(claims) - tested} rows do not test the paper ({found['put in']} put in, {found['ours']} ours)."
    )


def table(ran: Sequence[ExperimentRun]) -> str:
    """Return a text table of every claim: experiment, mark, claim, value, limit, value in the paper."""
    lines = [f"{'':5}{'':4}{'assertion':<62}{'value':>10}  {'limit':<18}paper"]
    for run in ran:
        for claim in run.outcome.claims:
            mark = MARKS[claim.status]
            lines.append(
                f"{run.experiment.key:<5}{mark:<4}{claim.what:<62}{printed_value(claim):>10}  {claim.limit:<18}"
                f"{claim.paper}".rstrip()
            )
    return "\n".join(lines)


def html(ran: Sequence[ExperimentRun], merged: int) -> str:
    """Return the self-contained HTML report."""
    every, total_s = [claim for run in ran for claim in run.outcome.claims], sum(run.seconds for run in ran)
    size = "Full size, 1080 x 1920" if merged == 1 else f"{merged} x {merged} pixels of the sensor merged to one"
    verdict = summary(every) + ("." if all(claim.holds for claim in every) else ". These are marked.")
    toc = "".join(
        f'<li><a href="#{run.experiment.key}">{run.experiment.key}</a> {escape(run.experiment.title)}'
        f"{_flags(run.outcome.claims)}</li>"
        for run in ran
    )
    return "\n".join(
        [
            '<!doctype html><html lang="en"><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width"><title>The paper, rerun</title>',
            f"<style>{STYLE}</style><main><h1>The paper, rerun</h1>",
            '<p class="lead">Li, McKay, Durr, Tian: "A diffuser-based computational imaging funduscope", every '
            "experiment "
            "repeated in the simulator. <b>All pictures on this page are simulated.</b></p>",
            f'<p class="verdict">{on_the_paper(every)}</p>' if every else "",
            f"<p>All rows together: {verdict} {size}; {total_s:.0f} s of computing.</p>",
            f"<p>Labels of the {len(every)} rows: {_labels(every)}.</p>" if every else "",
            CLAIMED,
            GLOSSARY,
            f"<h2>Contents</h2><ul class=toc>{toc}</ul>",
            *(_section(run) for run in ran),
            "</main></html>\n",
        ]
    )


def _section(run: ExperimentRun) -> str:
    experiment, outcome = run.experiment, run.outcome
    pictures = "".join(_figure(shown) for shown in outcome.shown if not shown.wide)
    plots = "".join(_figure(shown) for shown in outcome.shown if shown.wide)
    return "\n".join(
        [
            f'<section id="{experiment.key}"><h2><span>{experiment.key}</span> {escape(experiment.title)}</h2>',
            f"<p>{escape(experiment.sentence)}</p><p class=paper><b>Paper:</b> {escape(experiment.paper)}</p>",
            _claims(outcome.claims),
            *(_sheet(sheet) for sheet in outcome.sheets),
            f"<div class=pictures>{pictures}</div>" if pictures else "",
            f"<div class=plots>{plots}</div>" if plots else "",
            *(f"<p class=note>{escape(note)}</p>" for note in outcome.notes),
            f"<p class=quiet>{run.seconds:.1f} s</p></section>",
        ]
    )


def _flags(claims: Sequence[Claim]) -> str:
    """Return as HTML each status other than "holds" among the claims, for the table of contents."""
    states = {claim.status for claim in claims}
    return "".join(f" <b class={CLASSES[state]}>{state}</b>" for state in CLASSES if state in states - {"holds"})


def _claims(claims: Sequence[Claim]) -> str:
    rows = "".join(
        f"<tr class={CLASSES[claim.status]}><td>{escape(claim.what)}</td><td class=n>{printed_value(claim)}</td>"
        f"<td>{escape(claim.limit)}{_limit_note(claim)}</td><td>{claim.status}</td>"
        f"<td>{escape(claim.paper) or '&ndash;'}</td><td>{_label(claim)}</td></tr>"
        for claim in claims
    )
    head = "<tr><th>assertion<th class=n>here<th>limit<th>result<th>the paper says<th>label</tr>"
    return f"<table class=claims><thead>{head}</thead><tbody>{rows}</tbody></table>" if claims else ""


def _limit_note(claim: Claim) -> str:
    """Return as HTML the reason of a limit; a star marks one that was set after the value was seen."""
    return f"<small>{escape(claim.derived)}</small>" if claim.derived else "&nbsp;*"


def _label(claim: Claim) -> str:
    why = f"<small>{escape(claim.why)}</small>" if claim.why else ""
    return f"<b class=label-{claim.label.replace(' ', '-')}>{claim.label}</b>{why}"


def _labels(claims: Sequence[Claim]) -> str:
    """Return how many claims have each label, in words."""
    found = Counter(claim.label for claim in claims)
    return ", ".join(f"{found[label]} {label}" for label in get_args(Label) if found[label])


def _sheet(sheet: Table) -> str:
    head = "".join(f"<th>{escape(word)}" for word in sheet.head)
    rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}" for cell in row) for row in sheet.rows)
    return f"<table class=sheet><thead><tr>{head}</thead><tbody>{rows}</tbody></table>"


def _figure(shown: Figure) -> str:
    words = escape(shown.caption)
    kind = " class=begins" if shown.begins else ""
    return f'<figure{kind}><img src="{shown.address}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def printed_value(claim: Claim) -> str:
    """Return the value in its digits; one that would be printed as zero in scientific notation, zero itself as 0."""
    printed = f"{claim.value:.{claim.digits}f}"
    if float(printed) != 0 or claim.digits == 0:
        return printed
    return f"{claim.value:.0e}" if claim.value else "0"
