"""Pictures of the report as data URLs: grey images (PNG, all marked as simulated) and plots (SVG)."""

from base64 import b64encode
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image as Pictures

from device.config.marked_files import Pixels, marked_pixels, png_bytes
from device.recon.assessment.metrics import fit_intensity
from device.values import Image, Mask
from services.plot import Mark, Plot, Series, svg, value_axis
from tests.paper.bench import SimulatedFrame
from tests.paper.outcome import Figure

DARKEST, BRIGHTEST = 0.5, 99.7  # percentiles of the field shown as black and white
MIN_SIDE_PX = 420
MARGIN_PX = 6
TILE_PX = 480


def plane(caption: str, image: Image, inside: Mask | None = None, box: Mask | None = None) -> Figure:
    """Return a grey picture of an image, cut to the bounds of `box` (default: `inside`).

    Black and white are the percentiles DARKEST and BRIGHTEST of the values inside.
    """
    inside = np.ones(image.shape, np.bool_) if inside is None else inside
    return Figure(caption, _png(_grey(image, inside, inside if box is None else box)))


def _grey(image: Image, inside: Mask, box: Mask) -> Pixels:
    """Return the 8-bit pixels of `plane`."""
    low, high = np.percentile(image[inside], [DARKEST, BRIGHTEST])
    grey = np.clip((image - low) / max(float(high - low), 1e-30), 0, 1)
    rows, cols = _around(box)
    return _enlarged((255 * grey[rows, cols]).astype(np.uint8))


def compared(take: SimulatedFrame, pictures: Mapping[str, Image], name: str = "") -> tuple[Figure, ...]:
    """Return one row of pictures: the frame, its truth, and reconstructions with their scores."""
    before = f"{name}: " if name else ""
    out = [
        Figure(f"{before}what the sensor sees", plane("", take.raw).address, begins=True),
        plane(f"{before}truth", take.truth, take.inside),
    ]
    for kind, picture in pictures.items():
        scores = take.score(picture)
        words = f"{before}{kind}: PCC {scores.pcc:.3f}, PSNR {scores.psnr_db:.1f} dB, SSIM {scores.ssim:.2f}"
        out.append(plane(words, np.where(take.inside, picture, 0), take.inside))
    return tuple(out)


def cutline(take: SimulatedFrame, down_deg: float, pictures: Mapping[str, Image], title: str) -> Figure:
    """Return a plot of truth and pictures along the row at `down_deg`, each fitted to the truth by gain and offset."""
    row = take.row(down_deg)
    cols = np.flatnonzero(take.inside[row])
    middle = (take.truth.shape[1] - 1) / 2
    degrees = (cols - middle) / take.px_per_deg
    truth = take.truth.astype(np.float64)
    lines = {"truth": truth[row, cols]}
    for name, picture in pictures.items():
        lines[name] = fit_intensity(picture.astype(np.float64), truth, take.inside)[row, cols]
    peak = max(float(np.abs(truth[take.inside]).max()), 1e-30)
    scaled = {name: values / peak for name, values in lines.items()}
    return _lines(title, _where(down_deg), "degrees from the axis", "share of the brightest", degrees, scaled)


def raw_cutlines(takes: Mapping[str, SimulatedFrame], down_deg: float, title: str) -> Figure:
    """Return a plot of raw frames along the row at `down_deg`, each over its own mean there, as measured."""
    first = next(iter(takes.values()))
    degrees = (np.arange(first.raw.shape[1]) - (first.raw.shape[1] - 1) / 2) / first.px_per_deg
    lines = {}
    for name, take in takes.items():
        values = take.raw[take.row(down_deg)].astype(np.float64)
        lines[name] = values / max(float(values.mean()), 1e-30)
    return _lines(title, _where(down_deg), "degrees from the axis", "counts over their mean", degrees, lines)


def psf_cutlines(psfs: Mapping[str, Image], reach_px: int, title: str) -> Figure:
    """Return a plot of PSFs along their middle row within `reach_px` of the middle, each over its mean there."""
    lines = {}
    for name, psf in psfs.items():
        row, col = (n // 2 for n in psf.shape)
        values = psf[row, col - reach_px : col + reach_px + 1].astype(np.float64)
        lines[name] = values / max(float(values.mean()), 1e-30)
    pixels = np.arange(-reach_px, reach_px + 1)
    return _lines(title, "through the axis", "pixels from the axis", "light over its mean", pixels, lines)


def _where(down_deg: float) -> str:
    side = "below" if down_deg > 0 else "above"
    return f"{abs(down_deg):g} degrees {side} the axis" if down_deg else "through the axis"


def trend(title: str, under: str, across: str, up: str, lines: Mapping[str, Mapping[float, float]]) -> Figure:
    """Return a plot with one line of marks per name; `lines` maps a name to {x: y}; `across`, `up`: axis titles."""
    series = tuple(
        Series(name, (tuple(Mark(x, y, tooltip=f"{name}: {y:.3f} at {x:g}") for x, y in sorted(line.items())),))
        for name, line in lines.items()
    )
    xs = [x for line in lines.values() for x in line]
    ys = [y for line in lines.values() for y in line.values()]
    return _svg(title, Plot(title, under, title, value_axis(xs, across), value_axis(ys, up), series, height=380))


def _lines(title: str, under: str, across: str, up: str, x: np.ndarray, lines: Mapping[str, np.ndarray]) -> Figure:
    series = tuple(
        Series(name, (tuple(Mark(float(a), float(b), weight=0) for a, b in zip(x, values, strict=True)),))
        for name, values in lines.items()
    )
    every = np.concatenate(list(lines.values()))
    plot = Plot(
        title, under, title, value_axis(x.tolist(), across, 0.0), value_axis(every.tolist(), up), series, height=340
    )
    return _svg(title, plot)


def side_by_side(caption: str, file: str, pictures: Sequence[tuple[Image, Mask]]) -> Figure:
    """Return pictures cut to their fields, at one height in one row; the report also writes it to `file`."""
    tiles = []
    for image, inside in pictures:
        tile = Pictures.fromarray(_grey(np.where(inside, image, 0), inside, inside))
        size = round(tile.width * TILE_PX / tile.height), TILE_PX
        tiles.append(marked_pixels(np.asarray(tile.resize(size, Pictures.Resampling.LANCZOS)), True))
    row = np.hstack([np.pad(tile, ((0, 0), (0, MARGIN_PX))) for tile in tiles])
    return Figure(caption, _png(row), wide=True, file=file)


def _svg(caption: str, plot: Plot) -> Figure:
    return Figure(caption, f"data:image/svg+xml;base64,{b64encode(svg(plot).encode()).decode()}", wide=True)


def _enlarged(grey: Pixels) -> Pixels:
    """Return a small picture with each pixel repeated, so that its shorter side has at least MIN_SIDE_PX."""
    enlarge = max(1, MIN_SIDE_PX // max(min(grey.shape), 1))
    return grey.repeat(enlarge, axis=0).repeat(enlarge, axis=1)


def _png(grey: Pixels) -> str:
    return f"data:image/png;base64,{b64encode(png_bytes(grey, True)).decode()}"


def _around(mask: Mask) -> tuple[slice, slice]:
    spans = []
    for axis, size in enumerate(mask.shape):
        there = np.flatnonzero(mask.any(axis=1 - axis))
        spans.append(slice(max(int(there[0]) - MARGIN_PX, 0), min(int(there[-1]) + MARGIN_PX + 1, size)))
    return spans[0], spans[1]
