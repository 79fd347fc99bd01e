"""`make bench-retinas`: acceptance figures of the reconstruction on real photographs and recordings.

Every photograph is imaged by the simulated optics, which are unknown to the solver; the frame determines every
parameter. The paper's method is compared at the mu of the best PSNR, which only a known truth can give.
"""

import argparse
from functools import cache
from pathlib import Path

import numpy as np

from device.clock import Deadline, SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.image_files import as_raw, read_image, read_psf
from device.config.scene import EyeSpec, ObjectSpec
from device.recon.assessment.metrics import PictureScorer, Scores
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.scene_files import SimulatedExposure, simulate_exposure
from device.values import Calibration, Image, Reconstruction, Sensor
from tests.bench import timing
from tests.bench.peer_environment import lensless_pictures

HEAD = load_head(Path("hardware/heads/sim.toml"))
PHOTOGRAPHS = {
    "cc0": "skimage/retina.jpg",
    "06_dr": "hrf/images/06_dr.JPG",
    "07_h": "hrf/images/07_h.jpg",
    "09_g": "hrf/images/09_g.jpg",
    "01L": "chase/Image_01L.jpg",
    "05R": "chase/Image_05R.jpg",
    "11L": "chase/Image_11L.jpg",
}
FOUR = ("cc0", "06_dr", "07_h", "01L")
IMX296 = {"rows": 1088, "cols": 1456, "pitch_um": 3.45, "full_well_e": 23000.0, "read_noise_e": 2.2}
MUS = 10.0 ** np.arange(-6.5, -1.9, 0.25)
EYES_DPT = (-8.0, -6.0, -4.0, -2.0, -0.5, 0.0, 1.0, 2.5, 4.0, 5.5, 8.0)
BUDGET_S = 0.26
PLANNER = Planner(Path.home() / ".cache" / "diffuscope")
CLOCK = SystemClock()


def scene(
    photo: Path, peak_e: float = 20000.0, field_deg: float = 33.4, m_dpt: float = 0.0, **camera: float
) -> SimulatedExposure:
    """Return a photograph imaged by the paper's optics on the paper's sensor or another."""
    assert HEAD.sim is not None
    assert HEAD.optics is not None
    sim = HEAD.sim.model_copy(
        update={"peak_e": peak_e, "object": ObjectSpec(kind="image", image=photo), "eye": EyeSpec(m_dpt=m_dpt)}
    )
    optics = HEAD.optics.model_copy(update={"field_deg": field_deg})
    spec: InstrumentSpec = HEAD.model_copy(
        update={"sim": sim, "optics": optics, "camera": HEAD.camera.model_copy(update=camera)}
    )
    return simulate_exposure(spec)


def maker(shot: SimulatedExposure, *recipes: Recipe, refract: bool = True) -> Reconstructor:
    """Return the reconstructor planned for a scene's head, by default with the instrument's schedule."""
    return Reconstructor(shot.calibration, shot.counts.shape, PLANNER, CLOCK, recipes, refract=refract)


def judge(shot: SimulatedExposure) -> PictureScorer:
    """Return the scorer inside the field."""
    geometry = shot.calibration.geometry
    assert geometry is not None
    return PictureScorer(shot.truth, shot.truth > 0, geometry.px_per_deg)


def ours(shot: SimulatedExposure, budget_s: float = BUDGET_S) -> tuple[Reconstruction, float]:
    """Return the instrument's picture within a budget, after planning, and the time it took in s."""
    make = maker(shot)
    begin_s = CLOCK.now_s()
    made = make(shot.counts, deadline=Deadline.after(CLOCK, budget_s))
    return made, CLOCK.now_s() - begin_s


def paper(shot: SimulatedExposure) -> Scores:
    """Return the scores of the paper's Tikhonov solution at full resolution with the mu of the best PSNR."""
    make, score = maker(shot, Recipe("tikhonov"), refract=False), judge(shot)
    found = []
    for mu in MUS:
        make.stages[0].solver.mu = float(mu)  # type: ignore[attr-defined]  # the oracle's, not the frame's
        found.append(score(make(shot.counts).picture))
    return max(found, key=lambda scores: scores.psnr_db)


def retinas(folder: Path) -> None:
    """Measure seven photographs on the paper's sensor: gain within the budget over the paper's method."""
    timing.head(
        f"seven retinas, 20 ke-, within {BUDGET_S} s", "paper dB", "ours dB", "gain dB", "SSIM +", "s", "rounds"
    )
    gains, ssims = [], []
    for name, path in PHOTOGRAPHS.items():
        shot = scene(folder / path)
        made, took_s = ours(shot)
        mine, theirs = judge(shot)(made.picture), paper(shot)
        gains.append(mine.psnr_db - theirs.psnr_db)
        ssims.append(mine.ssim - theirs.ssim)
        timing.row(name, theirs.psnr_db, mine.psnr_db, gains[-1], ssims[-1], took_s, float(made.report.rounds))
    check_at_least("mean gain in PSNR >= 2.8 dB", float(np.mean(gains)), 2.8)
    check_at_least("least gain in PSNR >= 1.3 dB", min(gains), 1.3)
    check_at_least("mean gain in SSIM >= 0.05", float(np.mean(ssims)), 0.05)


def sensors(folder: Path) -> None:
    """Measure fields larger than the sensor: correlation with the truth over the whole field."""
    least = []
    for title, field_deg, camera, limit in (
        ("the paper's sensor, 48.3 deg", 48.3, {}, 0.955),
        ("IMX296, 33.4 deg", 33.4, IMX296, 0.955),
        ("IMX296, 45 deg", 45.0, IMX296, 0.95),
    ):
        timing.head(title, "paper", "ours")
        found = []
        for name in FOUR:
            shot = scene(folder / PHOTOGRAPHS[name], field_deg=field_deg, **camera)
            found.append(judge(shot)(ours(shot, 5.0)[0].picture).pcc)
            timing.row(name, paper(shot).pcc, found[-1])
        check_at_least(f"mean PCC >= {limit}", float(np.mean(found)), limit)
        least += found
    check_at_least("every one >= 0.90", min(least), 0.9)


def refraction(folder: Path) -> None:
    """Measure eyes from -8 to 8 dpt at 10 ke-: estimated refraction, and its effect on the picture."""
    errors, losses, kept = [], [], []
    for name in FOUR:
        timing.head(f"{name}: an eye's M, dpt", "found", "sd", "dB", "PCC, 0 dpt PSF")
        relaxed: dict[str, float] = {}
        for m_dpt in sorted(EYES_DPT, key=abs):
            shot = scene(folder / PHOTOGRAPHS[name], 10000.0, m_dpt=m_dpt)
            made, score = ours(shot, 5.0)[0], judge(shot)
            psnr_db = score(made.picture).psnr_db
            stored = score(maker(shot, Recipe("gradient"), refract=False)(shot.counts).picture).pcc
            relaxed = relaxed or {"dB": psnr_db, "PCC": stored}
            estimate_dpt = made.report.refraction_dpt
            known = estimate_dpt is not None and estimate_dpt["refused"] is None
            found = -estimate_dpt["sphere"] if known else np.nan
            errors.append(found - m_dpt)
            losses.append(relaxed["dB"] - psnr_db)
            kept += [stored / relaxed["PCC"]] if abs(m_dpt) == 4 else []
            sd_dpt = estimate_dpt["sd"] if known else np.nan
            timing.row(f"{m_dpt:+.1f}", found, sd_dpt, psnr_db, stored)
    check_at_least("RMS error of M <= 0.12 dpt", -float(np.sqrt(np.mean(np.square(errors)))), -0.12)
    check_at_least("loss of PSNR by the warped PSF <= 0.3 dB", -max(losses), -0.3)
    check_at_least("PCC of the 0 dpt PSF at +-4 dpt >= 0.88 of that at 0", min(kept), 0.88)


def dlmd(folder: Path) -> None:
    """Measure three public recordings with a lensed truth; the data's README gives the protocol."""
    timing.head("dlmd", "PSNR dB", "s")
    for name, mark_db in (("im65", 18.16), ("im326", 21.60), ("im43", 14.72)):
        frame = as_raw(read_image(folder / f"dlmd/diffuser/{name}.npy"))
        psf = read_psf(folder / "dlmd/derived_psf_480x270_f32.npy")
        make = Reconstructor(
            Calibration((psf,), Sensor(white_dn=frame.white_dn), bad=frame.bad), frame.pixels.shape[:2], PLANNER, CLOCK
        )
        begin_s = CLOCK.now_s()
        picture = make(frame.pixels).picture
        took_s = CLOCK.now_s() - begin_s
        truth = np.load(folder / f"dlmd/lensed/{name}.npy")
        psnr_db = butterfly_db(picture, truth)
        timing.row(f"{name}, ours", psnr_db, took_s)
        check_at_least(f"{name}: PSNR >= {mark_db} dB", psnr_db, mark_db)
        for title, ms, _, theirs in lensless_pictures(frame.pixels, psf.pixels, (100,)):
            timing.row(f"{name}, {title}", butterfly_db(theirs, truth), ms / 1000)
            check_at_least(f"{name}: their PSNR is not higher, dB", psnr_db - butterfly_db(theirs, truth), 0.0)
            check_at_least(f"{name}: times of theirs >= 5", ms / 1000 / took_s, 5.0)


def butterfly_db(picture: Image, truth: Image) -> float:
    """Return the PSNR in the authors' crop, with one gain per channel, clipped to 0..1."""
    truth, x = (image[0:210, 62:442].astype(np.float64) for image in (truth, picture))
    x *= (x * truth).sum(axis=(0, 1)) / (x * x).sum(axis=(0, 1))
    return float(-10 * np.log10(np.mean((np.clip(x, 0, 1) - truth) ** 2)))


@cache
def verdicts() -> list[bool]:
    """Return the list of all verdicts so far."""
    return []


def check_at_least(what: str, value: float, limit: float) -> None:
    """Print one acceptance line and record whether it holds: `value` is at least `limit`."""
    verdicts().append(value >= limit)
    print(f"  {'ok  ' if value >= limit else 'MISS'} {what}: {abs(value):.3f}", flush=True)


def main() -> None:
    """Run the named measurements, by default all; exit status 1 if a line fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with fundus/ and lensless/")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    arguments = parser.parse_args()
    if not (arguments.data / "fundus").is_dir():
        raise SystemExit("say where the real data are: DATA=folder, which holds fundus/ and lensless/")
    for part in arguments.only:
        measure, inside = PARTS[part]
        measure(arguments.data / inside)
    raise SystemExit(0 if all(verdicts()) else 1)


PARTS = {
    "retinas": (retinas, "fundus"),
    "sensors": (sensors, "fundus"),
    "refraction": (refraction, "fundus"),
    "dlmd": (dlmd, "lensless"),
}

if __name__ == "__main__":
    main()
