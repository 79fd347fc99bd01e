"""Scores of pictures over the pairs of a data set: one row per method with mean and spread, as table and as values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from device.errors import DiffuscopeError
from device.recon.assessment.metrics import PictureScorer
from device.values import Image, Mask

HIGHPASS_PX = 32.0
ProgressCallback = Callable[[str], None]
PLANES = "mean over the channels of a colour truth, each with its own fit"


@dataclass(frozen=True)
class PairScore:
    """Time and scores of one picture; scores are None for a pair without a truth.

    `fft_pairs` is the time over that of a planned FFT pair of the frame's grid in the same run, `pi5_seconds` the time
    on a Raspberry Pi 5 by a stated factor: not measured.
    """

    pair: str
    method: str
    bin: int
    rounds: int
    seconds: float
    fft_pairs: float
    pi5_seconds: float
    psnr_db: float | None
    ssim: float | None
    pcc: float | None


@dataclass(frozen=True)
class Spread:
    """Mean over pairs, and sample standard deviation (None for one pair)."""

    mean: float
    sd: float | None

    @classmethod
    def of(cls, values: Sequence[float | None]) -> "Spread | None":
        """Return mean and spread of the known values, None if there are none."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        return cls(float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else None)


@dataclass(frozen=True)
class Row:
    """One method over `pairs` pairs: median times as of `PairScore`, and scores; `bin` is 0 where it differs."""

    method: str
    bin: int
    rounds: int
    pairs: int
    seconds_median: float
    fft_pairs_median: float
    pi5_seconds_median: float
    psnr_db: Spread | None
    ssim: Spread | None
    pcc: Spread | None


@dataclass(frozen=True)
class LeftOut:
    """A pair, or one method on a pair, without a result, and the reason with its remedy."""

    pair: str
    method: str | None
    reason: str

    def __str__(self) -> str:
        return f"{self.pair}{f', {self.method}' if self.method else ''}: {self.reason}"


def left(pair: str, method: str | None, error: DiffuscopeError, progress: ProgressCallback) -> LeftOut:
    """Report a pair, or a method on it, that failed, and return it with the reason and its remedy."""
    left_out = LeftOut(pair, method, f"{error.message}. {error.remedy}")
    progress(f"  left out: {left_out}")
    return left_out


class PairScorer:
    """Scoring of the pictures of one pair: PSNR, SSIM and PCC after one least-squares gain and offset per channel.

    `truth` is (rows, cols) or (rows, cols, 3), NaN where unknown; `inside` (rows, cols) is the scored region; `shift`
    (rows, cols) moves every picture back. FrameError as of `PictureScorer`.
    """

    def __init__(self, truth: Image, inside: Mask, shift: tuple[int, int] = (0, 0)) -> None:
        self._shift = shift
        self._judges = [PictureScorer(plane, inside, HIGHPASS_PX) for plane in _planes(truth)]

    def __call__(self, picture: Image) -> tuple[float, float, float]:
        """Return PSNR in dB, SSIM and PCC of a picture, means over the truth's channels; a grey truth takes its mean.

        FrameError for a picture of other rows and columns.
        """
        picture = np.roll(picture, (-self._shift[0], -self._shift[1]), axis=(0, 1))
        planes = _planes(picture)
        if len(planes) != len(self._judges):
            planes = [grey(picture)] * len(self._judges)
        scores = [judge(plane) for judge, plane in zip(self._judges, planes, strict=True)]
        return (
            float(np.mean([score.psnr_db for score in scores])),
            float(np.mean([score.ssim for score in scores])),
            float(np.mean([score.pcc for score in scores])),
        )


def _planes(image: Image) -> list[Image]:
    return [image] if image.ndim == 2 else [image[..., channel] for channel in range(image.shape[2])]


def grey(image: Image) -> Image:
    """Return the mean of the channels, (rows, cols)."""
    return image if image.ndim == 2 else np.asarray(image.mean(axis=2), np.float32)


def rows(scores: Sequence[PairScore]) -> tuple[Row, ...]:
    """Return one row per method, bin and number of rounds, in the order of their first score."""
    groups: dict[tuple[str, int, int], list[PairScore]] = {}
    for score in scores:
        groups.setdefault((score.method, score.bin, score.rounds), []).append(score)
    return tuple(
        Row(
            *key,
            len(group),
            float(np.median([score.seconds for score in group])),
            float(np.median([score.fft_pairs for score in group])),
            float(np.median([score.pi5_seconds for score in group])),
            Spread.of([score.psnr_db for score in group]),
            Spread.of([score.ssim for score in group]),
            Spread.of([score.pcc for score in group]),
        )
        for key, group in groups.items()
    )


def table(found: Sequence[Row]) -> str:
    """Return rows as text, in the given order."""
    width = max([len(row.method) for row in found] + [len("method")])
    lines = [
        f"{'method':<{width}} {'bin':>3} {'rounds':>6} {'pairs':>5} {'seconds':>8} {'FFT pairs':>9} {'Pi 5 s*':>8} "
        f"{'PSNR dB':>14} "
        f"{'SSIM':>14} {'PCC':>14}"
    ]
    for row in found:
        lines.append(
            f"{row.method:<{width}} {row.bin or '-':>3} {row.rounds or '-':>6} {row.pairs:>5} "
            f"{row.seconds_median:>8.3f} {row.fft_pairs_median:>9.1f} {row.pi5_seconds_median:>8.2f} "
            f"{_cell(row.psnr_db, 2):>14} {_cell(row.ssim, 3):>14} {_cell(row.pcc, 3):>14}"
        )
    lines.append("* by a stated factor, not measured")
    return "\n".join(lines)


def _cell(value: Spread | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value.mean:.{digits}f}" + ("" if value.sd is None else f" ± {value.sd:.{digits}f}")
