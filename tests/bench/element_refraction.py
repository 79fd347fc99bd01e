"""`make bench-element-refraction`: errors of the refraction of drawn eyes behind each element, beside the stated sds.

Each eye has a drawing, noise, calibration and refraction of its own: M from -8 to 8 dpt, a cylinder of 0 to 2 dpt at
any axis. One frame at the light of a human eye, each lens a thin plate with a curved image surface, the report of the
default `Reconstructor` without a deadline. Figures of each eye are kept in the output folder, and measured once. Exit
status 1 if a limit fails.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.scene_files import lit_frames
from device.sim.simulated_calibration import simulated_calibration
from tests.bench.element_scenes import HEADS, Eye, scene, world

PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")
FIRST_EYE = 1000  # seed of the first drawn eye
MOST_DPT, MOST_CYLINDER_DPT = 8.0, 2.0
SIGNS = {"sphere": -1, "j0": -1, "j45": 1}  # of the wavefront, rows down, over those of the lens, axis upwards
LIMITED = ("lenslets", "lenslets, power")
MAX_RMS_DPT, MAX_MEAN_DPT = 0.05, 0.02
WITHIN_2_SD, MAX_BEYOND_4_SD = (0.93, 0.98), 1 / 600

Floats = NDArray[np.float64]


def drawn_eye(seed: int) -> Eye:
    """Return the eye of a seed."""
    rng = np.random.default_rng((seed, 8))
    m_dpt = float(rng.uniform(-MOST_DPT, MOST_DPT))
    size_dpt, turn = rng.uniform(0, MOST_CYLINDER_DPT / 2), rng.uniform(0, 2 * np.pi)
    return Eye(m_dpt, float(size_dpt * np.cos(turn)), float(size_dpt * np.sin(turn)), seed)


def measured(head: str, eye: Eye) -> dict[str, object]:
    """Return the refraction that the report of one frame of an eye states, with the true one."""
    present = world(scene(head, eye))
    solver = Reconstructor(simulated_calibration(present), present.shape, PLANNER, VirtualClock(), timed=False)
    report = solver(lit_frames(present)[0], simulated=True).report
    return {"eye": eye[:3], "refraction": report.refraction_dpt, "warnings": report.warnings}


def measure(head: str, seeds: Sequence[int], folder: Path) -> None:
    """Write the figures of each eye that has no file yet."""
    for seed in seeds:
        path = place(folder, head, seed)
        if not path.is_file():
            path.write_text(json.dumps(measured(head, drawn_eye(seed))), encoding="utf-8")


def place(folder: Path, head: str, seed: int) -> Path:
    """Return the file of the figures of an eye behind a head."""
    return folder / f"{head.replace(', ', '_').replace(' ', '_')}-{seed}.json"


def errors_and_sds(folder: Path, head: str, seeds: Sequence[int]) -> tuple[Floats, Floats]:
    """Return errors and sds of M, J0 and J45 in dpt, (eyes, 3) each; NaN for a refused eye."""
    errors, sds = np.full((2, len(seeds), 3), np.nan)
    for k, seed in enumerate(seeds):
        known = json.loads(place(folder, head, seed).read_text(encoding="utf-8"))
        found = known["refraction"]
        if found["sphere"] is not None and found["j0"] is not None:
            errors[k] = [sign * found[name] for name, sign in SIGNS.items()] - np.array(known["eye"])
            sds[k] = [found["sd"], found["j0_sd"], found["j45_sd"]]
    return errors, sds


def row(head: str, errors: Floats, sds: Floats) -> str:
    """Return the line of the table of a head."""
    known = np.isfinite(errors[:, 0])
    if not known.any():
        return f"| {head} | {len(errors)} | {len(errors)} |" + " - |" * 5
    error, z = errors[known], np.abs(errors[known] / sds[known])
    parts = [
        " / ".join(f"{value:.3f}" for value in np.sqrt(np.mean(error**2, axis=0))),
        " / ".join(f"{value:+.3f}" for value in error.mean(axis=0)),
        " / ".join(f"{value:.3f}" for value in np.median(sds[known], axis=0)),
        f"{np.mean(z < 2):.1%}",
        f"{int((z > 4).sum())} of {z.size}",
    ]
    return f"| {head} | {len(errors)} | {int((~known).sum())} | {' | '.join(parts)} |"


def misses(found: dict[str, tuple[Floats, Floats]]) -> list[str]:
    """Return a line for each limit that the heads with lenslets miss."""
    lines = []
    for head, (errors, _) in found.items():
        rms, mean = np.sqrt(np.nanmean(errors**2, axis=0)), np.abs(np.nanmean(errors, axis=0))
        if not (rms.max() <= MAX_RMS_DPT and mean.max() <= MAX_MEAN_DPT):
            lines.append(f"MISS {head}: RMS {rms.max():.3f} (at most {MAX_RMS_DPT}), mean {mean.max():.3f}")
    z = np.concatenate([np.abs(errors / sds).ravel() for errors, sds in found.values()])
    z = z[np.isfinite(z)]
    within, beyond = float(np.mean(z < 2)), int((z > 4).sum())
    if not (WITHIN_2_SD[0] <= within <= WITHIN_2_SD[1] and beyond <= MAX_BEYOND_4_SD * z.size):
        lines.append(f"MISS pooled: {within:.1%} within 2 sd (93 to 98), {beyond} of {z.size} beyond 4 sd")
    return lines


def main() -> None:
    """Measure the eyes that have no figures yet, and print the table; exit status 1 if a limit fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.element_refraction", description=__doc__)
    parser.add_argument("--heads", nargs="*", choices=list(HEADS), default=list(HEADS))
    parser.add_argument("--eyes", type=int, default=200, help="of lenslets")
    parser.add_argument("--other-eyes", type=int, default=60, help="of the other elements")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/element-refraction"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    print("| element | eyes | refused | RMS of M / J0 / J45 | mean | median sd | within 2 sd | beyond 4 sd |")
    print("|---|---|---|---|---|---|---|---|")
    found = {}
    for head in asked.heads:
        seeds = range(FIRST_EYE, FIRST_EYE + (asked.eyes if head in LIMITED else asked.other_eyes))
        measure(head, seeds, asked.out)
        found[head] = errors_and_sds(asked.out, head, seeds)
        print(row(head, *found[head]), flush=True)
    limited = {head: figures for head, figures in found.items() if head in LIMITED}
    missed = misses(limited) if limited else []
    print("\n".join(missed))
    raise SystemExit(bool(missed))


if __name__ == "__main__":
    main()
