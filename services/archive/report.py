"""`diffuscope archive report`: one self-contained HTML page from `captures.parquet` and the pictures of a run."""

from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from statistics import fmean, median, quantiles

import numpy as np
from pyarrow import Table, parquet

from device import atomic_io
from device.errors import DiffuscopeError, SettingError
from device.values import Image
from services.archive.plan import read_plan
from services.archive.result import PLAN, TABLE
from services.archive.solve import read_linear
from services.archive.source_files import earlier_picture
from services.imaging.picture_files import to_jpeg
from services.plot import Mark, Plot, Series, svg, value_axis
from services.report_style import STYLE
from services.research.reconstruct_file import write_or_raise

SHOWN = 6  # pictures of the largest improvements, and of the largest losses
SIDE_PX = 360
NAMED = 5  # captures of a message that are named
MAX_MARKS = 2_000  # of a plot; a larger table is sampled evenly
LOSS_DB = -0.1  # less is within the fit of intensity
LOSS_RATIO = 0.98
DONE = "done"  # state of a capture with a result
Cells = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Change:
    """Quality of one capture before and after, larger is better; `unit` is dB with a truth, else cycles per px."""

    id: str
    before: float
    after: float
    unit: str
    row: int

    @property
    def gain(self) -> float:
        """Difference in dB, or ratio of the cut-off frequencies minus 1."""
        return self.after - self.before if self.unit == "dB" else self.after / self.before - 1

    @property
    def is_loss(self) -> bool:
        """Whether the picture is worse by more than the uncertainty of the figure."""
        return self.gain < LOSS_DB if self.unit == "dB" else self.gain < LOSS_RATIO - 1


class Columns:
    """Columns of a table as Python lists, read when they are first used."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._read: dict[str, list[object]] = {}

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def values(self, name: str) -> list[object]:
        """Return a column; KeyError if the table has none."""
        if name not in self._read:
            self._read[name] = self._table.column(name).to_pylist()
        return self._read[name]

    def words(self, name: str) -> list[str]:
        """Return a column of texts; empty for null."""
        return ["" if value is None else str(value) for value in self.values(name)]

    def numbers(self, name: str) -> list[float | None]:
        """Return a column of numbers; None for null."""
        return [float(value) if isinstance(value, int | float) else None for value in self.values(name)]


def write_report(folder: Path, output: Path, progress: Callable[[str], None]) -> str:
    """Write the page of a folder of results; return one line with the counts.

    SettingError for a folder without a table; StoreError if the page cannot be written.
    """
    path = folder / TABLE
    if not path.is_file():
        raise SettingError(f"{path} does not exist", "Run the plan first: diffuscope archive run PLAN.toml -o FOLDER.")
    columns = Columns(parquet.read_table(path))
    progress(f"{len(columns)} captures")
    found = changes(columns)
    page = html(folder, columns, found)
    write_or_raise(output, lambda: atomic_io.write_atomically(output, page.encode(), mode=None))
    losses = sum(change.is_loss for change in found)
    return f"{len(columns)} captures, {len(found)} compared with an earlier picture, {losses} got worse"


def changes(columns: Columns) -> list[Change]:
    """Return the change of each capture with a figure before and after; by PSNR, else by the cut-off frequency."""
    names = ("psnr_db", "before_psnr_db", "quality_cutoff_per_px", "before_cutoff_per_px")
    psnr, before_psnr, cutoff, before_cutoff = (columns.numbers(name) for name in names)
    found = []
    for row, id in enumerate(columns.words("id")):
        after = psnr[row]
        before = before_psnr[row]
        if after is not None and before is not None:
            found.append(Change(id, before, after, "dB", row))
            continue
        after = cutoff[row]
        before = before_cutoff[row]
        if after is not None and before:
            found.append(Change(id, before, after, "cycles/px", row))
    return found


def html(folder: Path, columns: Columns, found: list[Change]) -> str:
    """Return the page."""
    simulated = any(value is True for value in columns.values("simulated"))
    mark = "<b>Pictures of simulated frames carry a mark.</b>" if simulated else ""
    parts = [
        _section("What was done", _summary(folder, columns)),
        _section("Quality before and after", _quality(found)),
        _section("Largest improvements", _pictures(folder, columns, _best(found))),
        _section("Largest losses", _losses(folder, columns, found)),
        _section("Frames and colours", _frames(columns)),
        _section("Messages and quarantine", _causes(columns)),
        _section("PSF consistency", _drift(columns)),
        _section("Retakes", _retakes(columns)),
        _section("Refraction", _refraction(columns)),
        _section("Cost", _cost(columns)),
    ]
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    style = f"<style>{STYLE} img {{ max-width: 100%; }} .pair {{ display: flex; gap: 8px; }}</style>"
    title = "Reprocessed archive"
    return f"{head}<title>{title}</title>{style}<main><h1>{title}</h1><p>{mark}</p>{''.join(parts)}</main></html>\n"


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>\n"


def _table(head: Sequence[str], rows: Cells) -> str:
    above = "".join(f"<th>{escape(cell)}" for cell in head)
    below = "".join("<tr>" + "".join(f"<td>{escape(cell)}" for cell in row) for row in rows)
    return f"<table><thead><tr>{above}</thead><tbody>{below}</tbody></table>"


def _summary(folder: Path, columns: Columns) -> str:
    states = Counter(columns.words("state"))
    rows = [[state, str(count)] for state, count in states.most_common()]
    kept = folder / PLAN
    words = ""
    if kept.is_file() and len(columns) < MAX_MARKS:  # a large plan takes seconds to parse
        plan = read_plan(kept)
        given = {key: value for key, value in plan.settings.model_dump().items() if value is not None}
        versions = ", ".join(f"{name} {value}" for name, value in plan.software.items())
        words = f"<p>Settings: {escape(str(given or 'chosen from PSF and frame'))}. Versions: {escape(versions)}.</p>"
    methods = Counter(word for word in columns.words("method") if word)
    return words + _table(("state", "captures"), rows) + _table(("method", "captures"), _counted(methods))


def _counted(counts: Counter[str]) -> list[list[str]]:
    return [[name, str(count)] for name, count in counts.most_common(20)]


def _quality(found: list[Change]) -> str:
    if not found:
        return "<p>Nothing to compare: no capture has a figure before and after.</p>"
    rows = []
    for unit in ("dB", "cycles/px"):
        some = [change for change in found if change.unit == unit]
        if some:
            before = fmean(change.before for change in some)
            after = fmean(change.after for change in some)
            worse = sum(change.is_loss for change in some)
            name = "PSNR (dB)" if unit == "dB" else "cut-off frequency (cycles/px)"
            rows.append([name, str(len(some)), f"{before:.4g}", f"{after:.4g}", str(worse)])
    return _table(("figure", "captures", "mean before", "mean after", "worse"), rows) + _plot(found)


def _plot(found: list[Change]) -> str:
    """Return the plot of the figure after against the figure before, of one unit, sampled evenly."""
    unit = Counter(change.unit for change in found).most_common(1)[0][0]
    points = [(change.before, change.after, change.id) for change in found if change.unit == unit]
    return _scatter("After against before", f"before ({unit})", f"after ({unit})", points)


def _scatter(title: str, x: str, y: str, points: Sequence[tuple[float, float, str]]) -> str:
    """Return a plot of points (x, y, label) as an SVG picture; empty if there is nothing to draw."""
    if len(points) < 2:
        return ""
    points = points[:: max(1, len(points) // MAX_MARKS)]
    trails = tuple(
        (Mark(x_value, y_value, "", f"{label}: {x_value:.4g}, {y_value:.4g}", 0.5),)
        for x_value, y_value, label in points
    )
    across = value_axis([x_value for x_value, _, _ in points], x)
    up = value_axis([y_value for _, y_value, _ in points], y)
    plot = Plot(title, "", f"{y} against {x}", across, up, (Series("capture", trails),), height=420)
    drawn = svg(plot)
    return _image("image/svg+xml", drawn.encode(), title)


def _image(kind: str, content: bytes, words: str) -> str:
    return f'<img src="data:{kind};base64,{b64encode(content).decode()}" alt="{escape(words)}">'


def _best(found: list[Change]) -> list[Change]:
    ordered = sorted((change for change in found if change.gain > 0), key=lambda change: -change.gain)
    return ordered[:SHOWN]


def _losses(folder: Path, columns: Columns, found: list[Change]) -> str:
    if not found:
        return "<p>Nothing to compare.</p>" + _least_explained(folder, columns)
    losses = sorted((change for change in found if change.is_loss), key=lambda change: change.gain)
    if not losses:
        return "<p>No capture got worse.</p>"
    words = f"<p>{len(losses)} captures got worse. The largest losses are shown.</p>"
    return words + _pictures(folder, columns, losses[:SHOWN])


def _least_explained(folder: Path, columns: Columns) -> str:
    """Return the pictures with the largest residuals: the frames that PSF and picture explain least."""
    residuals = columns.numbers("residual")
    worst = sorted((-value, row) for row, value in enumerate(residuals) if value is not None)[:SHOWN]
    ids = columns.words("id")
    places = columns.words("picture")
    simulated = columns.values("simulated")
    out = []
    for residual, row in worst:
        picture = _thumbnail(folder / places[row] if places[row] else None, simulated[row] is not False, "after")
        words = (
            f"{ids[row]}: residual {-residual:.3g} (rms over the noise; about 1 where the picture explains the frame)"
        )
        out.append(f"<figure>{picture}<figcaption>{escape(words)}</figcaption></figure>")
    return "<h3>Least explained</h3>" + "".join(out) if out else ""


def _pictures(folder: Path, columns: Columns, shown: Sequence[Change]) -> str:
    """Return the earlier and the new picture of captures, side by side, with figures and messages."""
    out = []
    for change in shown:
        place = columns.words("picture")[change.row]
        messages = columns.values("messages")[change.row]
        before = columns.words("before_picture")[change.row]
        simulated = columns.values("simulated")[change.row] is not False
        pair = _thumbnail(Path(before) if before else None, simulated, "before")
        pair += _thumbnail(folder / place if place else None, simulated, "after")
        notes = "; ".join(map(str, messages)) if isinstance(messages, list) else ""
        words = f"{change.id}: {change.before:.4g} to {change.after:.4g} {change.unit}. {notes}"
        out.append(f'<figure><div class="pair">{pair}</div><figcaption>{escape(words)}</figcaption></figure>')
    return "".join(out) or "<p>None.</p>"


def _thumbnail(path: Path | None, simulated: bool, words: str) -> str:
    """Return a small picture; its name if the file is gone or unreadable."""
    if path is None:
        return f"<span>no picture {words}</span>"
    try:
        picture: Image = read_linear(path) if path.suffix in (".tiff", ".npy") else earlier_picture(path)
        jpeg = to_jpeg(np.nan_to_num(picture), SIDE_PX, simulated)
    except DiffuscopeError as error:
        return f"<span>{escape(error.message)}</span>"
    return _image("image/jpeg", jpeg, words)


def _frames(columns: Columns) -> str:
    """Return how many captures used how many of their frames, and which colours of light their pictures have."""
    pairs = zip(columns.values("frames_used"), columns.values("frames"), strict=True)
    used = Counter(f"{some} of {all}" for some, all in pairs if all is not None)
    kinds = {"channels": "measured", "predicted_channels": "predicted", "missing_channels": "missing"}
    colours = Counter(
        f"{colour} ({word})"
        for name, word in kinds.items()
        for many in columns.values(name)
        for colour in (many if isinstance(many, list) else ())
    )
    words = _table(("frames used", "captures"), _counted(used)) if used else "<p>No capture has a result.</p>"
    return words + (_table(("colour of light", "captures"), _counted(colours)) if colours else "")


def _causes(columns: Columns) -> str:
    """Return messages and reasons with the number of their captures, and the ids of the first ones."""
    ids = columns.words("id")
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    for id, many in zip(ids, columns.values("messages"), strict=True):
        for message in many if isinstance(many, list) else ():
            found["message", str(message)].append(id)
    for id, state, reason in zip(ids, columns.words("state"), columns.words("reason"), strict=True):
        if reason:
            found[state, reason].append(id)
    ordered = sorted(found.items(), key=lambda entry: -len(entry[1]))[:40]
    rows = [[kind, words, str(len(some)), ", ".join(some[:NAMED])] for (kind, words), some in ordered]
    head = ("kind", "words", "captures", f"the first {NAMED}")
    return _table(head, rows) if rows else "<p>No messages, and nothing in quarantine.</p>"


def _drift(columns: Columns) -> str:
    """Return PSF consistency by device, and against the age of the calibration."""
    scores = columns.numbers("quality_psf_score")
    ages = columns.numbers("calibration_age_days")
    devices = columns.words("device")
    by_device: dict[str, list[float]] = defaultdict(list)
    points = []
    for score, age, device in zip(scores, ages, devices, strict=True):
        if score is not None:
            by_device[device or "unknown"].append(score)
            if age is not None:
                points.append((age, score, device))
    rows = [[name, str(len(some)), f"{fmean(some):.3f}", f"{min(some):.3f}"] for name, some in by_device.items()]
    words = _table(("device", "captures", "mean score", "least"), sorted(rows)[:20]) if rows else "<p>No scores.</p>"
    return words + _scatter("PSF consistency by age of the calibration", "days", "score", points)


def _retakes(columns: Columns) -> str:
    """Return the share of captures whose first verdict asked for another one, by cause."""
    verdicts = [word for word in columns.words("before_verdict") if word]
    if not verdicts:
        return "<p>No capture has a stored verdict.</p>"
    causes = Counter(word for word in columns.words("before_cause") if word)
    states = columns.words("state")
    hard = [row for row, word in enumerate(columns.words("before_verdict")) if word == "again" and states[row] == DONE]
    clear = sum(not columns.values("messages")[row] for row in hard)
    rows = [[cause, str(count), f"{count / len(verdicts):.1%}"] for cause, count in causes.most_common(20)]
    words = f"<p>{len(hard)} frames had the verdict to take another; {clear} of them now have no message.</p>"
    return words + _table(("cause", "captures", "share"), rows)


def _refraction(columns: Columns) -> str:
    spheres = columns.numbers("sphere_dpt")
    sds = columns.numbers("sphere_sd_dpt")
    known = [(sphere, sd) for sphere, sd in zip(spheres, sds, strict=True) if sphere is not None and sd is not None]
    if len(known) < 2:
        return "<p>Fewer than two captures have a refraction.</p>"
    low, middle, high = quantiles([sphere_dpt for sphere_dpt, _ in known], n=4)
    words = f"<p>{len(known)} captures: median {middle:+.2f} dpt, quartiles {low:+.2f} and {high:+.2f} dpt; "
    words += f"median uncertainty (sd) {median(sd for _, sd in known):.2f} dpt.</p>"
    return words + _scatter(
        "Refraction", "sphere (dpt)", "sd (dpt)", [(sphere_dpt, sd, "") for sphere_dpt, sd in known]
    )


def _cost(columns: Columns) -> str:
    totals = [total_s for total_s in columns.numbers("total_s") if total_s is not None]
    solving = [solve_s for solve_s in columns.numbers("solve_s") if solve_s is not None]
    if not totals:
        return "<p>Nothing was computed.</p>"
    workers = Counter(word for word in columns.words("worker") if word)
    hours = sum(totals) / 3600
    rows = [
        ["time of all tasks", f"{hours:.3g} h"],
        ["median of a capture", f"{median(totals):.2f} s"],
        ["of which the solver", f"{median(solving):.2f} s"],
        ["longest", f"{max(totals):.2f} s"],
        ["workers", str(len(workers))],
    ]
    return _table(("cost", ""), rows)
