"""`make bench`: each line is a ratio to one bare planned forward + inverse real FFT of 1080 x 1920, in the same run.

Absolute times belong to one machine on one day; the ratio tells whether the code around the FFT is tight.
"""

import resource
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from skimage.restoration import wiener

from device.clock import SystemClock, VirtualClock
from device.head import Head, open_head
from device.recon.geometry import disc
from device.recon.model import field_radius_px
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.spec import load_head
from device.values import Counts, Frame, Glow, Image, Shot

SHAPE = (1080, 1920)
ROUNDS = 15
RECIPES = (
    Recipe("tikhonov"),
    Recipe("gradient"),
    Recipe("gradient", 2),
    Recipe("evidence", 4),
    Recipe("evidence", 2),
    Recipe("variation", 2),
)
PLANS = Path.home() / ".cache" / "diffuscope"


def side_by_side_ms(*acts: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median times of several acts that take turns, after two turns that warm up.

    A neighbour's burst then hits all of them alike, and the ratio of two medians is about the code.
    """
    times: list[list[float]] = [[] for _ in acts]
    for k in range(rounds + 2):
        for act, own in zip(acts, times, strict=True):
            begin = time.perf_counter()
            act()
            if k >= 2:
                own.append(time.perf_counter() - begin)
    return [statistics.median(own) * 1e3 for own in times]


def seen_by(head: Head) -> Frame:
    """One lit frame of a simulated head."""
    with head.light.on(Glow(head.spec.light.colour)):
        return head.camera.expose(Shot(head.spec.camera.exposure_s))


def correlation(picture: Image, truth: Image, inside: np.ndarray) -> float:
    """Pearson correlation inside the field."""
    return float(np.corrcoef(picture[inside], truth[inside])[0, 1])


def skimage_wiener(counts: Counts, psf: Image) -> Image:
    """The peer: scikit-image's Wiener filter with its default prior, at the balance of its own example, on [0, 1]."""
    return np.asarray(wiener(counts / counts.max(), np.fft.fftshift(np.fft.ifftshift(psf)), balance=1e-3, clip=False))


def main() -> None:
    """Print the table."""
    from device.sim.world import World

    spec = load_head(Path("hardware/heads/sim.toml"))
    head = open_head(spec, VirtualClock())
    counts = seen_by(head).counts
    truth = World(spec, VirtualClock()).truth("green")
    inside = disc(SHAPE, ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2), field_radius_px(head.calibration) - 2) > 0.5
    print(f"{'1080 x 1920, simulated retina':<42} {'ms':>8} {'ratio':>7} {'PCC':>6}")
    planner = Planner(PLANS)
    fft = planner.plan(SHAPE)
    makers = [Reconstructor(head.calibration, SHAPE, planner, SystemClock(), (recipe,)) for recipe in RECIPES]
    acts = [lambda: (fft.forward(), fft.inverse()), *(partial(make, counts) for make in makers)]
    pair_ms, *made_ms = side_by_side_ms(*acts)
    row("bare real FFT pair, planned", pair_ms, 1.0)
    for recipe, make, ms in zip(RECIPES, makers, made_ms, strict=True):
        pcc = correlation(make(counts).picture, truth, inside)
        row(f"{recipe.method}, bin {recipe.bin}, counts to picture", ms, ms / pair_ms, pcc)
    psf = head.calibration.psfs[0].pixels
    pair_ms, ms = side_by_side_ms(acts[0], partial(skimage_wiener, counts, psf), rounds=3)
    row("scikit-image restoration.wiener", ms, ms / pair_ms, correlation(skimage_wiener(counts, psf), truth, inside))
    print(f"peak memory of this run: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def row(name: str, ms: float, ratio: float, pcc: float | None = None) -> None:
    """One line of the table."""
    print(f"{name:<42} {ms:8.1f} {ratio:7.2f} {'' if pcc is None else f'{pcc:6.3f}'}", flush=True)


if __name__ == "__main__":
    main()
