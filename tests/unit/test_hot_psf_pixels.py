"""Hot pixels in a PSF: found as in a raw; a PSF that is sharp by itself is kept."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter

from device.calibration.import_psf import ImportedPsfInfo, read_imported_psf
from device.config.image_files import as_psf
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.values import Psf
from services.research.reconstruct_inputs import ReconstructOptions, load_psfs, load_raw
from tests.journey.wrong_inputs import SHAPE, caustic, scene


def measured() -> Any:
    noise = np.random.default_rng(4).normal(64, 2, SHAPE)
    return np.rint(caustic() + noise).astype(np.uint16)


def with_hot_pixels(count: int) -> tuple[Any, Any]:
    """Return the counts of `measured` with hot pixels where it is dark, and their mask."""
    rng, counts = np.random.default_rng(5), measured()
    hot = np.zeros(SHAPE, np.bool_)
    hot.ravel()[rng.choice(np.flatnonzero(maximum_filter(counts, 5) < 200), count, replace=False)] = True
    counts[hot] = rng.integers(1500, 4096, count)
    return counts, hot


@pytest.mark.parametrize("count", [1, 40])
def test_hot_pixels_are_replaced_and_no_other_pixel_changes(count: int) -> None:
    counts, hot = with_hot_pixels(count)
    given, clean = as_psf(counts, "p"), as_psf(measured(), "q")
    mended = without_hot_pixels(given)
    light = float(given.pixels[~hot].sum() / mended.pixels[~hot].sum())
    assert np.allclose(mended.pixels[~hot] * light, given.pixels[~hot], rtol=1e-4, atol=1e-9)
    assert np.abs(mended.pixels[hot] - clean.pixels[hot]).max() < 0.05 * clean.pixels.max()


def points(step_px: int, dark_dn: float) -> Any:
    spots = (np.indices(SHAPE) % step_px == step_px // 2).all(axis=0) * 1000.0
    return np.random.default_rng(6).normal(dark_dn + spots, 1.0)


def spots() -> Any:
    """Return the counts of the spots of 30 lenses, a third of them in focus within little more than a pixel."""
    rng, shape = np.random.default_rng(7), SHAPE
    rows, cols = rng.uniform(10, shape[0] - 10, 30), rng.uniform(10, shape[1] - 10, 30)
    down, right = np.indices(shape)
    wide_px = np.where(np.arange(30) < 10, 0.55, 1.5)
    parts = (
        np.exp(-((down - row) ** 2 + (right - col) ** 2) / (2 * wide**2)) / wide**2
        for row, col, wide in zip(rows.round(), cols.round(), wide_px, strict=True)
    )
    return rng.normal(64 + 1000 * np.sum(list(parts), axis=0), 1.0)


def fine_grain() -> Any:
    """Return the counts of a PSF of grains of one to two pixels in the dark, most of them beside no other."""
    rng = np.random.default_rng(5)
    grain = gaussian_filter(rng.standard_normal(SHAPE), 0.8)
    light = np.maximum(grain - 1.2 * grain.std(), 0) ** 2
    return rng.poisson(light / light.max() * 12_000) / 4


SHARP: dict[str, Callable[[], Any]] = {
    "diffuser": measured,
    "one pixel": lambda: points(60, 0) * (np.indices(SHAPE) < 60).all(axis=0),
    "points": lambda: points(16, 64),
    "points of two pixels": lambda: gaussian_filter(points(16, 64), 0.8),
    "spots": spots,
    "fine grain": fine_grain,
    "one pixel of half the light": lambda: (
        gaussian_filter(points(60, 64), 20) + 4e6 * (np.indices(SHAPE) == 48).all(axis=0)
    ),
}


@pytest.mark.parametrize("name", SHARP)
def test_a_psf_without_hot_pixels_stays_as_it_is(name: str) -> None:
    psf = as_psf(SHARP[name](), "p")
    assert without_hot_pixels(psf) is psf


@pytest.mark.parametrize("way", ["reconstruct", "import-psf"])
def test_files_of_psfs_are_read_without_hot_pixels(way: str, tmp_path: Path) -> None:
    counts, hot = with_hot_pixels(40)
    np.save(tmp_path / "psf.npy", counts)
    if way == "import-psf":
        psf: Psf = read_imported_psf((tmp_path / "psf.npy",), ImportedPsfInfo()).calibration.psfs[0]
    else:
        psf = load_psfs(ReconstructOptions(psfs=(tmp_path / "psf.npy",)), load_raw(scene())).stacks[0][0]
    assert psf.pixels[hot].max() < 0.1 * psf.pixels.max()
