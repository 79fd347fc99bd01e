"""Growth of time and memory of the closed form with the sensor: 0.25 to 8 megapixels, one process each.

`python -m tests.bench.scaling MPX` measures one size and prints it as JSON; `scaling()` makes the table and the plot.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from device.clock import SystemClock
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.values import Calibration, Geometry, Psf, Sensor
from services.plot import Mark, Plot, Series, log_axis, svg, time_axis
from tests.bench import timing
from tests.scenes import speckle

SIZES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
CASES = (Recipe("gradient", 1), Recipe("gradient", 2))
STEEPEST = 1.25  # N log N over this range is N^1.05; cache misses add the rest
OUT = Path("out")


def shape_of(megapixels: float) -> tuple[int, int]:
    """Return the shape of a 9:16 sensor of about that many pixels, its sides divisible by 24."""
    rows = round((megapixels * 1e6 * 9 / 16) ** 0.5 / 24) * 24
    return rows, round(rows * 16 / 9 / 24) * 24


def measure(megapixels: float, plans: Path) -> dict[str, float]:
    """Measure one size: milliseconds of each case, and growth of the process from its imports to its last picture."""
    shape = shape_of(megapixels)
    pitch_um = 5.04 * 1080 / shape[0]  # the same optics on finer or coarser pixels
    psf = Psf(speckle(shape, grain_px=2 * shape[0] / 1080))
    calibration = Calibration((psf,), Sensor(), Geometry(pitch_um, 6000, 0.75), 33.4)
    counts = np.random.default_rng(0).integers(100, 3000, shape, dtype=np.uint16)
    before_mb = peak_mb()
    planner = Planner(plans, effort="FFTW_MEASURE" if megapixels <= 2.5 else "FFTW_ESTIMATE")
    found = {}
    for recipe in CASES:
        make = Reconstructor(calibration, shape, planner, SystemClock(), (recipe,), refract=False)
        (found[f"bin {recipe.bin}"],) = timing.side_by_side_ms(lambda make=make: make(counts), rounds=7)
    return found | {"pixels": shape[0] * shape[1], "grown_mb": peak_mb() - before_mb, "peak_mb": peak_mb()}


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def scaling(plans: Path) -> None:
    """Print the table and the fitted power law, and write out/scaling.svg."""
    timing.head("closed form from 0.25 to 8 megapixels", "bin 1 ms", "bin 2 ms", "peak MB", "grown MB")
    found = []
    for size in SIZES:
        command = [sys.executable, "-m", "tests.bench.scaling", str(size), str(plans)]
        found.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        at = found[-1]
        name = f"{at['pixels'] / 1e6:.2f} megapixels"
        timing.row(name, at["bin 1"], at["bin 2"], at["peak_mb"], at["grown_mb"])
    logs = np.log([at["pixels"] for at in found])
    for case in ("bin 1", "bin 2"):
        power, _ = np.polyfit(logs, np.log([at[case] for at in found]), 1)
        timing.row(f"{case}: time ~ pixels^k, k", power, limit=STEEPEST, value=float(power))
    OUT.mkdir(exist_ok=True)
    (OUT / "scaling.svg").write_text(drawn(found), encoding="utf-8")
    print(f"{OUT / 'scaling.svg'}")


def drawn(found: list[dict[str, float]]) -> str:
    """Return the plot of time over sensor size, both logarithmic."""
    trails = {
        case: tuple(
            Mark(
                at["pixels"] / 1e6,
                at[case] / 1e3,
                f"{at['peak_mb']:.0f} MB" if case == "bin 1" else "",
                f"{at['pixels'] / 1e6:.2f} megapixels, {case}: {at[case]:.1f} ms",
            )
            for at in found
        )
        for case in ("bin 1", "bin 2")
    }
    series = tuple(Series(f"gradient, {case}", (marks,)) for case, marks in trails.items())
    x = log_axis([at["pixels"] / 1e6 for at in found], "sensor, megapixels", lambda value: f"{value:g}")
    y = time_axis([mark.y for own in trails.values() for mark in own], "time from counts in memory to the picture")
    says = "; ".join(f"{at['pixels'] / 1e6:.2f} Mpx in {at['bin 1']:.0f} ms" for at in found)
    under = "each size in a process of its own, one FFT thread; beside each the peak memory of that process"
    return svg(Plot("What a larger sensor costs: the closed form", under, says, x, y, series))


if __name__ == "__main__":
    print(json.dumps(measure(float(sys.argv[1]), Path(sys.argv[2]))))
