"""`make bench-psf DATA=folder`: the PSF consistency check on recordings and hard frames, with the command's functions.

Each frame is reconstructed from files with its own PSF (no warning expected) and with PSFs that are mirrored, rotated
by 180 degrees, shuffled or another head's (one warning expected). The output has one line each; the exit status is 1 if
a line fails.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from device.config.head_file import InstrumentSpec, load_head
from device.config.image_files import read_psf
from device.recon.assessment.quality_figures import MISMATCHES
from device.sim.scene_files import simulate_exposure
from device.values import Image, Report
from services.research.reconstruct_file import reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions
from tests.simulated import SCENES, with_keys
from tests.wrong_psfs import orientations, resized, shuffled

HEAD = Path("hardware/heads/sim.toml")
PLANS = Path.home() / ".cache" / "diffuscope"
EYES_DPT = (-8.0, -4.0, 4.0, 8.0)
Counts = NDArray[np.uint16]


@dataclass(frozen=True)
class Case:
    """Files of a frame and its PSFs; `head` if the geometry is given."""

    name: str
    raw: Path
    psfs: tuple[Path, ...]
    head: Path | None = None


def recordings(lensless: Path) -> Iterator[Case]:
    """Yield every recording with its own PSF; the tilted target with its stack of depths."""
    yield Case("hand", lensless / "tutorial/rawdata_hand_sample.tif", (lensless / "tutorial/psf_sample.tif",))
    depths = tuple(sorted((lensless / "diffusercam3d/psf").glob("psf*.tiff")))
    yield Case("USAF, 11 depths", lensless / "diffusercam3d/example_raw.png", depths)
    for raw in sorted((lensless / "dlmd/diffuser").glob("*.npy")):
        yield Case(raw.stem, raw, (lensless / "dlmd/derived_psf_480x270_f32.npy",))


def simulated(folder: Path) -> Iterator[Case]:
    """Yield eyes of any refraction, low light and gaps, each with the PSF of a relaxed eye and the head's geometry."""
    head = load_head(HEAD)
    yield expose_case(folder, "simulated, 0 dpt", head, HEAD)
    yield expose_case(folder, "simulated, 0 dpt, no head file", head, None)
    for m_dpt in EYES_DPT:
        yield expose_case(folder, f"simulated, {m_dpt:+g} dpt", with_keys(head, eye={"m_dpt": m_dpt}), HEAD)
    yield expose_case(folder, "simulated, 500 e-", with_keys(head, peak_e=500), HEAD)
    yield expose_case(folder, "simulated, 144 e-", with_keys(head, peak_e=144), HEAD)
    for scene in ("small_pupil", "stray_light", "worn_sensor", "short_sighted", "crowded_imx296", "paper_retina"):
        yield expose_case(folder, scene, load_head(SCENES / f"{scene}.toml"), SCENES / f"{scene}.toml")
    yield expose_case(folder, "crowded_imx296, no head file", load_head(SCENES / "crowded_imx296.toml"), None)


def with_gaps(folder: Path) -> Iterator[Case]:
    """Yield frames with saturation, a glare spot, dead columns (count 0) and warm pixels, none of them declared."""
    shot = simulate_exposure(load_head(HEAD))
    rng = np.random.default_rng(5)
    bright = np.minimum(shot.counts.astype(np.float64) * 1.6, 4095)
    glare, dead, warm = (shot.counts.copy() for _ in range(3))
    rows, cols = np.ogrid[: shot.counts.shape[0], : shot.counts.shape[1]]
    glare[np.hypot(rows - 500, cols - 900) < 45] = 4095
    dead[:, rng.choice(shot.counts.shape[1], 12, replace=False)] = 0
    warm[rng.random(shot.counts.shape) < 1e-3] += 1500
    for name, counts in (("saturated", bright), ("glare spot", glare), ("dead columns", dead), ("warm pixels", warm)):
        full = np.minimum(counts, 4095).astype(np.uint16)
        yield write_case(folder, f"simulated, {name}", full, shot.calibration.psfs[0].pixels, HEAD)


def expose_case(folder: Path, name: str, spec: InstrumentSpec, head: Path | None) -> Case:
    """Expose a frame and write its files."""
    shot = simulate_exposure(spec)
    return write_case(folder, name, shot.counts, shot.calibration.psfs[0].pixels, head)


def write_case(folder: Path, name: str, counts: Counts, psf: Image, head: Path | None) -> Case:
    """Write a frame and its PSF as files."""
    stem = "".join(letter if letter.isalnum() else "_" for letter in name)
    raw, file = folder / f"{stem}.npy", folder / f"{stem}_psf.npy"
    np.save(raw, counts)
    np.save(file, psf)
    return Case(name, raw, (file,), head)


def report_of(case: Case, folder: Path, psfs: tuple[Path, ...]) -> Report:
    """Return the report of `diffuscope reconstruct`."""
    return reconstruct_file(case.raw, ReconstructOptions(psfs=psfs, head=case.head, plans=PLANS)).report


def wrong(case: Case, folder: Path, foreign: dict[str, Image]) -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Yield the files of PSFs that do not belong to a case, by kind."""
    stacks: dict[str, list[Path]] = {}
    for k, path in enumerate(case.psfs):
        psf = read_psf(path).pixels
        images = orientations(psf) | {"shuffled": shuffled(psf)}
        images |= {f"of {name}": resized(image, psf.shape) for name, image in foreign.items() if not same(image, psf)}
        for kind, image in images.items():
            file = folder / f"wrong_{kind.replace(' ', '_').replace(',', '')}_{k}.npy"
            np.save(file, image)
            stacks.setdefault(kind, []).append(file)
    for kind, files in stacks.items():
        yield kind, tuple(files) if not kind.startswith("of ") else tuple(files[:1])


def same(image: Image, psf: Image) -> bool:
    """Return whether both are one PSF: several recordings share one."""
    return image.shape == psf.shape and bool(np.allclose(image, psf))


def expected(kind: str, words: tuple[str, ...]) -> bool:
    """Return whether the PSF warnings are right for this kind of PSF."""
    found = [text for text in words if text in MISMATCHES.values()]
    return not found if kind == "right" else len(found) == 1 and ("rotated" in found[0]) == kind.startswith("rotated")


def line(case: Case, kind: str, report: Report) -> bool:
    """Print one line of the table; return whether the result is as expected."""
    fits = expected(kind, report.warnings)
    score, sd, orientation, mirrored = (
        report.quality.get(key) for key in ("psf_score", "psf_score_sd", "psf_orientation", "psf_mirrored")
    )
    figures = "" if score is None else f"{score:+7.2f}{sd:6.2f}{orientation:+8.1f}{mirrored:+8.1f}"
    warnings = " ".join(text.split(". ")[0] for text in report.warnings)
    print(f"{'ok  ' if fits else 'MISS'} {case.name:30}{kind:22}{figures:30} {warnings}", flush=True)
    return fits


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with lensless/")
    parser.add_argument("--only", nargs="*", default=["recordings", "simulated", "gaps"])
    parser.add_argument("--right", action="store_true", help="only the PSFs that belong to the frames")
    arguments, fits = parser.parse_args(), []
    lensless = arguments.data / "lensless"
    with TemporaryDirectory() as place:
        folder = Path(place)
        foreign = {"hand": read_psf(lensless / "tutorial/psf_sample.tif").pixels}
        foreign["im65"] = read_psf(lensless / "dlmd/derived_psf_480x270_f32.npy").pixels
        spec = with_keys(load_head(HEAD), seed=77)
        foreign["another seed"] = simulate_exposure(spec).calibration.psfs[0].pixels
        parts = {"recordings": recordings(lensless), "simulated": simulated(folder), "gaps": with_gaps(folder)}
        print(f"{'':35}{'PSF':22}{'score':>7}{'sd':>6}{'orient.':>8}{'mirr.':>8}")
        for part in arguments.only:
            for case in parts[part]:
                fits.append(line(case, "right", report_of(case, folder, case.psfs)))
                for kind, psfs in () if arguments.right else wrong(case, folder, foreign):
                    fits.append(line(case, kind, report_of(case, folder, psfs)))
    print(f"{sum(fits)} of {len(fits)} as they should be")
    raise SystemExit(0 if all(fits) else 1)


if __name__ == "__main__":
    main()
