"""S3, S4, S7: the paper's printed targets, lit by the LED ring, and the limits of the field."""

from math import atan, degrees

import numpy as np
from scipy import ndimage

from device.recon.assessment.metrics import shift_px
from device.values import Image
from services.lab.paper.bench import Bench, SimulatedFrame
from services.lab.paper.edges import edge_signs
from services.lab.paper.outcome import Experiment, Figure, Outcome, Table, above, below, within
from services.lab.paper.pictures import compared, cutline, raw_cutlines
from services.lab.paper.screen import DOT_MU, apply_floor, find_dots

MOVED_DEG = degrees(atan(4 / 25))  # 4 mm in the focal plane of a 25 mm lens
FAINT_STEP = 0.03  # step of a faint edge over the blur's width, of the field's mean
PATCH_DEG = 6.0  # half side of the retinal patch visible in both positions
RULER_DEG = 2 * degrees(atan(7.5 / 25))
POSITIONS = {"left": -MOVED_DEG, "middle": 0.0, "right": MOVED_DEG}


def ruler_deg(picture: Image, take: SimulatedFrame) -> float:
    """Return the length of the ruler in a picture in degrees, between the half-height points of its base line."""
    row = take.row(0)
    line = ndimage.gaussian_filter1d(picture[row - 1 : row + 2].mean(axis=0).astype(np.float64), 0.8)
    level = float(np.median(line[take.column(-12) : take.column(12)])) / 2
    lit = np.flatnonzero(line > level)
    ends = []
    for inner, step in ((lit[0], -1), (lit[-1], 1)):
        beyond = inner + step
        ends.append(inner + step * (line[inner] - level) / (line[inner] - line[beyond]))
    return float(ends[1] - ends[0]) / take.px_per_deg


def run_rulers(bench: Bench) -> Outcome:
    """Solve a white and a black ruler by the paper's solver with one weight, and the black one by ours too."""
    bench.progress("S3: rulers, white on black and black on white")
    sparse, dense = bench.expose("paper_ruler_positive"), bench.expose("paper_ruler_negative")
    mu, _, _ = bench.best_mu(dense)
    white, black = (np.maximum(bench.tikhonov(take, mu), 0) for take in (sparse, dense))
    flat = bench.solve(dense, "gradient")
    ours = bench.solve(dense, "variation")
    long_deg = ruler_deg(bench.tikhonov(sparse, DOT_MU), sparse)
    one, two, three, four = sparse.score(white), dense.score(black), dense.score(flat), dense.score(ours)
    claims = (
        within("15 mm as reconstructed, degrees", long_deg, 33.1, 33.7, "33.4", 2),
        above("PSNR, white over black, dB", one.psnr_db - two.psnr_db, 4.0, "much reduced", 1),
        above("SSIM, white over black", one.ssim - two.ssim, 0.15, "much reduced"),
        below("PCC, white over black", one.pcc - two.pcc, 0.15, "remains similar"),
        above("flat-sub over the paper's solver, black, PCC", three.pcc - two.pcc, 0.02),
        above("contrast of the raw frame, white over black", _contrast(sparse) / _contrast(dense), 2.0, "higher (4b)"),
    )
    rows = tuple(
        (name, f"{s.pcc:.3f}", f"{s.psnr_db:.1f}", f"{s.ssim:.2f}")
        for name, s in (("white on black, paper's solver", one), ("black on white, paper's solver", two),
                        ("black on white, flat-sub", three), ("black on white, ours", four))
    )  # fmt: skip
    shown = (
        *compared(sparse, {f"paper's solver, mu {mu:.0e}": white}, "white ruler"),
        *compared(dense, {f"paper's solver, mu {mu:.0e}": black, "flat-sub": flat, "ours": ours}, "black ruler"),
        raw_cutlines({"white ruler": sparse, "black ruler": dense}, -1.6, "The raw frames, as measured (figure 4b)"),
        cutline(sparse, -1.6, {"paper's solver": white}, "White ruler, across the ticks"),
        cutline(dense, -1.6, {"paper's solver": black, "ours": ours}, "Black ruler, across the ticks"),
    )
    note = (
        "The paper calls the black ruler on white the positive one in its results and the dense one in its discussion. "
        "Here white and black say it. The pictures are cut at zero, as a printed figure is."
    )
    return Outcome(claims, shown, (Table(("picture", "PCC", "PSNR, dB", "SSIM"), rows),), (note,))


def _contrast(take: SimulatedFrame) -> float:
    """Return standard deviation over mean of the lit raw frame, with coarse shading removed."""
    raw = take.raw.astype(np.float64)
    soft = ndimage.gaussian_filter(raw, 3 * take.px_per_deg)
    lit = soft > 0.5 * soft.max()
    fine = ndimage.gaussian_filter(raw, 2) / np.maximum(soft, 1e-9)
    return float(fine[lit].std())


def run_prints(bench: Bench) -> Outcome:
    """Solve one print of a retina at three lateral positions behind the lens, by the paper's solver and `gradient`."""
    takes, pictures, rows = {}, {}, []
    shown: list[Figure] = []
    asked = same = faint = faint_same = 0
    for name, right_deg in POSITIONS.items():
        bench.progress(f"S4: a printed retina, {name}")
        take = takes[name] = bench.expose("paper_print", {"sim.object.at_deg": (right_deg, 0.0)})
        _, paper, scores = bench.best_mu(take)
        pictures[name] = bench.solve(take, "gradient")
        signs = [edge_signs(take, paper, down_deg) for down_deg in (-4.0, 0.0, 4.0)]
        weak = [edge_signs(take, paper, down_deg, FAINT_STEP) for down_deg in (-4.0, 0.0, 4.0)]
        asked, same = asked + sum(n for n, _ in signs), same + sum(n for _, n in signs)
        faint, faint_same = faint + sum(n for n, _ in weak), faint_same + sum(n for _, n in weak)
        ours = take.score(pictures[name])
        rows.append((name, f"{scores.pcc:.3f}", f"{ours.pcc:.3f}", f"{sum(n for _, n in signs)}/"
                     f"{sum(n for n, _ in signs)}"))  # fmt: skip
        both = {"paper's solver": paper, "flat-sub": pictures[name]}
        shown += compared(take, both, name)
        shown.append(cutline(take, 0.0, both, f"Across vessels, {name}"))
    off = [misregistration(pictures, takes, name) for name in ("left", "right")]
    claims = (
        above("edges on the cutlines that go the right way, share", same / max(asked, 1), 0.999, "both edges followed"),
        above("edges asked about", asked, 20, "", 0),
        below("common features of two positions apart, samples", max(off), 1.0, "", 2),
    )
    sheet = Table(("position", "PCC, paper's solver", "PCC, flat-sub", "edges right"), tuple(rows))
    note = (
        "The paper moved the model eye sideways to move the field. With an object at infinity that moves the "
        "pupil, not "
        "the field; here the print moves by 4 mm behind the lens, which is 9.09 degrees."
    )
    fainter = (
        f"Asked are edges of 5 % of the mean over 0.6 degrees. Of all from 3 % on, {faint_same} of {faint} go the "
        "right way "
        "in the paper's solution: the faintest drown in its ringing."
    )
    return Outcome(claims, tuple(shown), (sheet,), (note, fainter))


def misregistration(pictures: dict[str, Image], takes: dict[str, SimulatedFrame], name: str) -> float:
    """Return the registration error in samples of the retinal patch shared by a side position and the centre."""
    take, half = takes[name], round(PATCH_DEG * takes[name].px_per_deg)
    shared_deg = POSITIONS[name] / 2  # centre of the shared patch, in the coordinates of the side position
    patches = []
    for which, at_deg in ((name, shared_deg), ("middle", shared_deg - POSITIONS[name])):
        row, col = take.row(0), take.column(0) + round(at_deg * take.px_per_deg)
        patches.append(pictures[which][row - half : row + half, col - half : col + half])
    moved = (round(shared_deg * take.px_per_deg) - round((shared_deg - POSITIONS[name]) * take.px_per_deg)
             - POSITIONS[name] * take.px_per_deg)  # fmt: skip
    down, right = shift_px(patches[0], patches[1])
    return float(np.hypot(down, right + moved))


def run_fields(bench: Bench) -> Outcome:
    """Measure the width in degrees of the lit print and of the luminous lattice in pictures of the paper's solver."""
    bench.progress("S7: what limits the field")
    lit, shining = bench.expose("paper_print"), bench.expose("paper_dots")
    picture, dots = bench.best_mu(lit)[1], apply_floor(bench.tikhonov(shining, DOT_MU))
    row = lit.row(0)
    soft = ndimage.gaussian_filter(picture.astype(np.float64), 0.5 * lit.px_per_deg)[row]
    level = 0.5 * float(np.median(soft[lit.column(-12) : lit.column(12)]))
    bright = ndimage.label(soft > level)[0]
    print_deg = float((bright == bright[lit.column(0)]).sum()) / lit.px_per_deg
    places = find_dots(dots, shining).places
    cols = places[np.abs(places[:, 0] - shining.row(0)) <= 2, 1]
    dots_deg = float(np.ptp(cols)) / shining.px_per_deg
    claims = (
        within("lit print, degrees", print_deg, 32, 34, "33 (33.4)", 1).put_in("the scene is lit over 33.4 degrees"),
        within("shining dots, degrees", dots_deg, 50, 52, "51 (51.2)", 1).put_in("the dots span 51.3 degrees"),
    )
    shown = (*compared(lit, {"lit print": picture}), *compared(shining, {"shining dots": dots}))
    return Outcome(claims, shown)


EXPERIMENTS = (
    Experiment(
        "S3", "A printed ruler, white and black", "Fifteen millimetres with a tick each millimetre, white on black and "
        "black on white, with one and the same weight.",
        "Figure 4b: 15 mm are 33.4 degrees; PCC similar, PSNR and SSIM much reduced on white paper.", run_rulers,
    ),
    Experiment(
        "S4", "A printed retina at three places", "The print is moved by 4 mm to either side behind the lens.",
        "Figure 4c: vessels, haemorrhages and disc are captured at all three places.", run_prints,
        "the print moves behind the lens, not the model eye; the retina is drawn",
    ),
    Experiment(
        "S7", "What limits the field", "A print lit over 33.4 degrees beside dots that shine over 51.3.",
        "Discussion: \"the current system FOV is limited by the extent of the LED illumination\".", run_fields,
    ),
)  # fmt: skip
