"""`diffuscope data`: what a folder of recordings holds, and a check of every file."""

from collections.abc import Callable
from dataclasses import dataclass

from device.clock import Clock
from device.errors import DiffuscopeError
from services.research.dataset_pairs import Dataset, Entry, Pair

PROGRESS_S = 1.0
ProgressCallback = Callable[[str], None]


@dataclass(frozen=True)
class Problem:
    """A pair that cannot be used, and the reason with its remedy."""

    pair: str
    reason: str


def summary(dataset: Dataset) -> str:
    """Return as text the layout, the number of pairs, the first pair's size and PSFs, and what reading applies.

    FrameError or PsfError if the first pair cannot be read.
    """
    first = dataset.read(dataset.entries[0])
    layout = dataset.layout
    with_truth = sum(entry.truth is not None for entry in dataset.entries)
    lines = [
        f"{dataset.folder}: {layout.title}",
        f"  {'pairs':<10} {len(dataset)}, {with_truth} with a truth: {_names(dataset)}",
        f"  {'raw':<10} {_size(first)}, {_counts(first)}",
        f"  {'PSF':<10} {_psfs(dataset.entries[0], first)}",
    ]
    lines += [
        f"  {'applied' if k == 0 else '':<10} {phrase}" for k, phrase in enumerate(layout.applied(with_truth > 0))
    ]
    lines += [f"  {'cite':<10} {layout.citation}"] if layout.citation else []
    lines += [f"  {'licence':<10} {layout.licence}", *(f"  {'note':<10} {note}" for note in dataset.notes)]
    return "\n".join(lines)


def _names(dataset: Dataset) -> str:
    names = [entry.name for entry in dataset.entries]
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]} ... {names[-1]}"


def _size(pair: Pair) -> str:
    return " x ".join(str(size) for size in pair.raw.pixels.shape)


def _counts(pair: Pair) -> str:
    """Return the type of the values, and what is known of the sensor's counts."""
    raw = pair.raw
    if raw.pixels.dtype.kind == "f":
        return "float"
    shifted = f", stored shifted left by {raw.shift} bits" if raw.shift else ""
    left_out = f", {int(raw.bad.sum())} pixels left out" if raw.bad.any() else ""
    return f"counts up to {raw.white_dn:.0f} in {raw.stored_bits}-bit words{shifted}{left_out}"


def _psfs(entry: Entry, pair: Pair) -> str:
    rows, cols = pair.psfs[0].shape
    if len(pair.psfs) > 1:
        return f"{len(pair.psfs)} depths, {pair.psfs[0].name} to {pair.psfs[-1].name}, {rows} x {cols}"
    return f"{entry.psfs[0].name}, {rows} x {cols} on the raw's pixels"


def check(dataset: Dataset, clock: Clock, progress: ProgressCallback) -> tuple[Problem, ...]:
    """Read every file of a data set; return the pairs that cannot be read or differ in size from the first one read.

    `progress` is called with one line per second.
    """
    problems: list[Problem] = []
    shape: tuple[int, ...] | None = None
    shown_s = clock.now_s()
    for k, entry in enumerate(dataset.entries):
        try:
            pixels = dataset.read(entry).raw.pixels
        except DiffuscopeError as error:
            problems.append(Problem(entry.name, f"{error.message}. {error.remedy}"))
            continue
        shape = shape or pixels.shape
        if pixels.shape != shape:
            problems.append(Problem(entry.name, f"its shape is {pixels.shape}, that of the others {shape}"))
        if clock.now_s() - shown_s >= PROGRESS_S:
            shown_s = clock.now_s()
            progress(f"{k + 1} of {len(dataset)} pairs read")
    return tuple(problems)
