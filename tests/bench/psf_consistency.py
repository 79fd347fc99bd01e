"""`make bench-psf DATA=folder`: the PSF consistency check on recordings and hard frames, by the command's way.

Each frame is reconstructed from files with its own PSF, which must be silent, and with PSFs that are mirrored, rotated
by 180 degrees, shuffled or another head's, which must be reported. One line each; 1 where a line is missed.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from device.images import read_psf
from device.recon.quality import MISMATCHES
from device.sim.staged import staged
from device.spec import InstrumentSpec, load_head
from device.values import Image, Report
from services.instrument.once import Order, reconstruct_file
from tests.simulated import SCENES, having
from tests.wrong_psfs import orientations, resized, shuffled

HEAD = Path("hardware/heads/sim.toml")
PLANS = Path.home() / ".cache" / "diffuscope"
EYES_DPT = (-8.0, -4.0, 4.0, 8.0)
Counts = NDArray[np.uint16]


@dataclass(frozen=True)
class Case:
    """A frame and PSFs in files; `head` where the geometry is given."""

    name: str
    raw: Path
    psfs: tuple[Path, ...]
    head: Path | None = None


def recordings(lensless: Path) -> Iterator[Case]:
    """Every recording with its own PSF; the tilted target with its stack of depths."""
    yield Case("hand", lensless / "tutorial/rawdata_hand_sample.tif", (lensless / "tutorial/psf_sample.tif",))
    depths = tuple(sorted((lensless / "diffusercam3d/psf").glob("psf*.tiff")))
    yield Case("USAF, 11 depths", lensless / "diffusercam3d/example_raw.png", depths)
    for raw in sorted((lensless / "dlmd/diffuser").glob("*.npy")):
        yield Case(raw.stem, raw, (lensless / "dlmd/derived_psf_480x270_f32.npy",))


def simulated(folder: Path) -> Iterator[Case]:
    """Eyes of any refraction, little light, gaps; each with the stored PSF of a relaxed eye and the head's geometry."""
    head = load_head(HEAD)
    yield made(folder, "simulated, 0 dpt", head, HEAD)
    yield made(folder, "simulated, 0 dpt, no head file", head, None)
    for m_dpt in EYES_DPT:
        yield made(folder, f"simulated, {m_dpt:+g} dpt", having(head, eye={"m_dpt": m_dpt}), HEAD)
    yield made(folder, "simulated, 500 e-", having(head, peak_e=500), HEAD)
    yield made(folder, "simulated, 144 e-", having(head, peak_e=144), HEAD)
    for scene in ("small_pupil", "stray_light", "worn_sensor", "short_sighted", "crowded_imx296", "paper_retina"):
        yield made(folder, scene, load_head(SCENES / f"{scene}.toml"), SCENES / f"{scene}.toml")
    yield made(folder, "crowded_imx296, no head file", load_head(SCENES / "crowded_imx296.toml"), None)


def with_gaps(folder: Path) -> Iterator[Case]:
    """Saturated, with a glare spot, with dead columns that read 0 and with warm pixels, none of them declared."""
    shot = staged(load_head(HEAD))
    rng = np.random.default_rng(5)
    bright = np.minimum(shot.counts.astype(np.float64) * 1.6, 4095)
    glare, dead, warm = (shot.counts.copy() for _ in range(3))
    rows, cols = np.ogrid[: shot.counts.shape[0], : shot.counts.shape[1]]
    glare[np.hypot(rows - 500, cols - 900) < 45] = 4095
    dead[:, rng.choice(shot.counts.shape[1], 12, replace=False)] = 0
    warm[rng.random(shot.counts.shape) < 1e-3] += 1500
    for name, counts in (("saturated", bright), ("glare spot", glare), ("dead columns", dead), ("warm pixels", warm)):
        full = np.minimum(counts, 4095).astype(np.uint16)
        yield kept(folder, f"simulated, {name}", full, shot.calibration.psfs[0].pixels, HEAD)


def made(folder: Path, name: str, spec: InstrumentSpec, head: Path | None) -> Case:
    """Expose a frame and keep it in files."""
    shot = staged(spec)
    return kept(folder, name, shot.counts, shot.calibration.psfs[0].pixels, head)


def kept(folder: Path, name: str, counts: Counts, psf: Image, head: Path | None) -> Case:
    """A frame and its PSF as files."""
    stem = "".join(letter if letter.isalnum() else "_" for letter in name)
    raw, file = folder / f"{stem}.npy", folder / f"{stem}_psf.npy"
    np.save(raw, counts)
    np.save(file, psf)
    return Case(name, raw, (file,), head)


def report_of(case: Case, folder: Path, psfs: tuple[Path, ...]) -> Report:
    """What `diffuscope reconstruct` reports."""
    order = Order(case.raw, psfs, folder / "out.npy", None, None, None, None, case.head, None, False, PLANS)
    return reconstruct_file(order).report


def wrong(case: Case, folder: Path, foreign: dict[str, Image]) -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Files of the PSFs that do not belong to a case, by kind."""
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
    """Whether both are one PSF: several recordings have it in common."""
    return image.shape == psf.shape and bool(np.allclose(image, psf))


def expected(kind: str, words: tuple[str, ...]) -> bool:
    """Whether the warnings about a PSF are right for its kind."""
    said = [text for text in words if text in MISMATCHES.values()]
    return not said if kind == "right" else len(said) == 1 and ("rotated" in said[0]) == kind.startswith("rotated")


def line(case: Case, kind: str, report: Report) -> bool:
    """Print one line of the table; whether it is as it should be."""
    fits = expected(kind, report.warnings)
    score, sd, orientation, mirrored = (
        report.quality.get(key) for key in ("psf_score", "psf_score_sd", "psf_orientation", "psf_mirrored")
    )
    figures = "" if score is None else f"{score:+7.2f}{sd:6.2f}{orientation:+8.1f}{mirrored:+8.1f}"
    said = " ".join(text.split(". ")[0] for text in report.warnings)
    print(f"{'ok  ' if fits else 'MISS'} {case.name:30}{kind:22}{figures:30} {said}", flush=True)
    return fits


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with lensless/")
    parser.add_argument("--only", nargs="*", default=["recordings", "simulated", "gaps"])
    parser.add_argument("--right", action="store_true", help="only the PSFs that belong to the frames")
    wish, fits = parser.parse_args(), []
    lensless = wish.data / "lensless"
    with TemporaryDirectory() as place:
        folder = Path(place)
        foreign = {"hand": read_psf(lensless / "tutorial/psf_sample.tif").pixels}
        foreign["im65"] = read_psf(lensless / "dlmd/derived_psf_480x270_f32.npy").pixels
        spec = having(load_head(HEAD), seed=77)
        foreign["another seed"] = staged(spec).calibration.psfs[0].pixels
        parts = {"recordings": recordings(lensless), "simulated": simulated(folder), "gaps": with_gaps(folder)}
        print(f"{'':35}{'PSF':22}{'score':>7}{'sd':>6}{'orient.':>8}{'mirr.':>8}")
        for part in wish.only:
            for case in parts[part]:
                fits.append(line(case, "right", report_of(case, folder, case.psfs)))
                for kind, psfs in () if wish.right else wrong(case, folder, foreign):
                    fits.append(line(case, kind, report_of(case, folder, psfs)))
    print(f"{sum(fits)} of {len(fits)} as they should be")
    raise SystemExit(0 if all(fits) else 1)


if __name__ == "__main__":
    main()
