"""Table and plot of the lesions' bench: sensitivity against false grains a picture, with sampling errors.

The rate of false grains is that of a whole lit field: their number over the searched share of the field. The sampling
error is the larger of two standard deviations: over bootstrap samples of the eyes, in each of which the threshold is
chosen again, and of a share of so many lesions (Jeffreys), which is not 0 where all or none were found.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor
from pathlib import Path
from typing import Any

import numpy as np

from services.plot import Axis, Mark, Plot, Series, log_axis, stacked_svg
from tests.bench.drawn_lesions import SPOTS, VESSELS, Kind

HEADS = {
    "imx296": "diffuser",
    "imx296_lenslets": "lenslets",
    "imx296_power_lenslets": "lenslets, high-power ring",
    "imx296_control": "one lens, stop of 1.2 mm",
}
TRUTH = "truth"
FALSE_A_PICTURE = 1.0
DRAWN = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # false grains a picture of the marks
SAMPLES = 400
Eyes = list[dict[str, Any]]


@dataclass(frozen=True)
class Found:
    """One kind of lesion in the eyes of one head: contrasts at its lesions and of its false grains.

    `lesions` has an array for each eye, `false` a pair of contrasts and searched share of the field for each picture
    of an eye.
    """

    lesions: list[Any]
    false: list[list[tuple[Any, float]]]

    @classmethod
    def of(cls, eyes: Eyes, kind: Kind) -> "Found":
        """Return what was found in the figures of eyes; of a refused frame no lesion."""
        known = [eye[kind.name] for eye in eyes if "refused" not in eye]
        none = [np.zeros(kind.count)] * (len(eyes) - len(known))
        false = [[(np.array(one["contrasts"]), one["share"]) for one in eye["false"].values()] for eye in known]
        return cls([np.array(eye["lesions"]) for eye in known] + none, false + [[]] * len(none))

    def sensitivity(self, false_a_picture: float, chosen: Sequence[int] | None = None) -> float:
        """Return the share of the lesions above the threshold that this rate of false grains gives.

        `chosen`: indices of the eyes, by default all.
        """
        indices = range(len(self.lesions)) if chosen is None else chosen
        pictures = [picture for k in indices for picture in self.false[k]]
        if not pictures:
            return 0.0
        grains = np.sort(np.concatenate([contrasts for contrasts, _ in pictures]))[::-1]
        allowed = floor(false_a_picture * sum(share for _, share in pictures))
        threshold = grains[allowed] if allowed < grains.size else 0.0
        return float(np.mean(np.concatenate([self.lesions[k] for k in indices]) > threshold))

    def error(self, false_a_picture: float) -> float:
        """Return the sampling error of the sensitivity, a standard deviation."""
        rng, count = np.random.default_rng(0), len(self.lesions)
        samples = [self.sensitivity(false_a_picture, rng.integers(count, size=count)) for _ in range(SAMPLES)]
        lesions = sum(one.size for one in self.lesions)
        share = (self.sensitivity(false_a_picture) * lesions + 0.5) / (lesions + 1)
        return max(float(np.std(samples)), (share * (1 - share) / (lesions + 2)) ** 0.5)


def read(folder: Path, head: str) -> dict[str, Eyes]:
    """Return the figures of the eyes of a head, by number of frames, prior, or TRUTH."""
    found: dict[str, Eyes] = {}
    for path in sorted(folder.glob(f"{head}-*.json")):
        for way, figures in json.loads(path.read_text(encoding="utf-8")).items():
            found.setdefault(way, []).append(figures)
    return found


def table(folder: Path) -> str:
    """Return the sensitivities at FALSE_A_PICTURE with their sampling errors as a Markdown table.

    The last row is the drawn retina itself, as sampled by the first head that was measured: what texture and vessels
    alone leave of a detector.
    """
    measured = [(words, way, eyes) for head, words in HEADS.items() for way, eyes in read(folder, head).items()]
    rows = [row for row in measured if row[1] != TRUTH] + [row for row in measured if row[1] == TRUTH][:1]
    kinds = (*SPOTS, *VESSELS)
    titles = ["head", "picture", "eyes", *(kind.name for kind in kinds)]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for words, way, eyes in rows:
        cells = [
            f"{found.sensitivity(FALSE_A_PICTURE):.2f} ± {found.error(FALSE_A_PICTURE):.2f}"
            for found in (Found.of(eyes, kind) for kind in kinds)
        ]
        refused = sum("refused" in eye for eye in eyes)
        count = f"{len(eyes)}" + (f", {refused} refused" if refused else "")
        lines.append(f"| {' | '.join(['no optics' if way == TRUTH else words, in_words(way), count, *cells])} |")
    return "\n".join(lines)


def in_words(way: str) -> str:
    """Return the words of a way: "4 frames", "1 frame, shrinkage"."""
    number, _, prior = way.partition(" ")
    if not number.isdigit():
        return way
    return f"{number} frame{'s' if number != '1' else ''}" + (f", {prior}" if prior else "")


def plot_of(folder: Path, kind: Kind) -> Plot:
    """Return the ROC of one kind of lesion: a line of each head, hollow of one frame and full of four."""
    series = []
    for number, (head, words) in enumerate(HEADS.items()):
        for way, hollow in (("1", True), ("4", False)):
            eyes = read(folder, head).get(way)
            if not eyes:
                continue
            found = Found.of(eyes, kind)
            marks = tuple(
                Mark(rate, found.sensitivity(rate), tooltip=f"{words}, {in_words(way)}: {found.sensitivity(rate):.2f}")
                for rate in DRAWN
            )
            series.append(Series(words, (marks,), number, hollow, named=not hollow))
    ticks = tuple((share, f"{share:g}") for share in (0, 0.2, 0.4, 0.6, 0.8, 1))
    return Plot(
        title=f"Sensitivity against false grains: {kind.name}",
        subtitle="simulated; contrast 0.2, default solver, light of a human eye; full marks: four frames, hollow: one",
        description="",
        x=log_axis(DRAWN, "false grains a picture of the whole lit field", lambda value: f"{value:g}"),
        y=Axis(-0.03, 1.03, "share of the lesions found", ticks),
        series=tuple(series),
        limits=((FALSE_A_PICTURE, ""),),
        height=440,
    )


def write_report(folder: Path) -> None:
    """Print the table of all figures in a folder, and write the plot `lesions.svg` into it."""
    print(table(folder))
    document = stacked_svg([plot_of(folder, kind) for kind in SPOTS[1::-1] + SPOTS[2:3]])
    (folder / "lesions.svg").write_text(document, encoding="utf-8")
