"""S1, S2, S2b: the paper's targets on a self-luminous screen."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from device.recon.assessment.metrics import Scores
from device.values import Image
from tests.paper.bench import DEFAULT, Bench, HeadChanges, SimulatedFrame
from tests.paper.edges import edge_signs, spots_followed
from tests.paper.outcome import Claim, Experiment, Outcome, Table, above, attempted, below, within
from tests.paper.pictures import compared, cutline, plane

FLOOR = 0.05  # of the brightest: darker values are no dots, and are zero in the figures
DOT_MU = 1e-5
FLOORS = (0.0, 0.01, 0.02, 0.05)  # values of the sweep
SWEPT_MUS = (1e-6, 1e-5, 1e-4, 1e-3)
APART_DEG = 1.5  # local maxima closer than this are one dot
EDGE_DEG = 25.64  # angle of the outermost dots on the centre row: 12 mm at 25 mm focal length
NEXT_DEG = 21.80  # angle of the dots beside them, 10 mm
WINDOW_DEG = 1.9
FLAT: HeadChanges = {"sim.eye.surface": "flat", "sim.eye.walks": True}
IMPROVES = "quality improvement"
HRF_DEG = (48.3, 34.6)  # lit part of figure 3c's photographs: 3262 x 2336 pixels, cut at top and bottom
CUT: HeadChanges = {"sim.object.cut_deg": HRF_DEG}
ROWS_DEG = (-8.0, -4.0, 0.0, 4.0, 8.0)
FALLOFF = "the falloff towards the edge was given to the simulation: the paper prints none"
WITH_FLOOR = "a floor of 5 %, of which the paper says nothing, that the direct picture of the row above does not have"
NO_FLOOR = "its counterpart, the next row, has a floor of 5 % that this picture does not have"
GIVEN = np.cos(np.radians(EDGE_DEG)) ** 4 * np.exp(-((EDGE_DEG / 28) ** 2))  # falloff and vignette of the scene
PARTLY = (
    f"a falloff to {GIVEN:.2f} at the edge was given to the simulation: the paper prints none; only the rest, the blur "
    "of the flat screen, is computed"
)
FLOORED = f"both pictures with a floor of 5 %, of which the paper says nothing; {FALLOFF}"
SPANNED = "the scene's dots span 51.3 degrees: the row shows that the outermost are found; S7 has a wider lattice"
DRAWN = "a drawn retina instead of the photograph, on a curved screen"
NO_NUMBER = "the paper names the flat screen as a possible cause, without a number"
ON_DOTS = (
    "The paper names one possible cause, the flat screen, and prints one pair. With the traced lens (T) and our "
    "falloff that screen comes within 0.1 of the pair if the flat-field correction also removes the background: the "
    "direct picture, cut at zero as a printed one, against the corrected one with values below 5 % of the brightest "
    "set to zero. The division alone changes SSIM by the amounts in the table, and mostly lowers it. That the paper's "
    "correction has such a floor is our assumption. Weight (1e-5) and floor (5 %) were set before the flat screen was "
    "simulated, not for this result; the table shows the others.",
    "The falloff towards the edge (cos^4 and a vignette of 28 degrees) is put in by hand; the blur of the flat screen "
    "is traced. On a curved screen the same gives 0.98 to 0.99.",
)
ON_THE_CUT = (
    "Figure 3c shows a photograph of the HRF set, whose disc is cut at top and bottom: 48.3 by 34.6 degrees. So cut, "
    "our drawn retina has its light on the sensor but for the outermost rows. The full disc of 48.3 degrees is ours "
    "and harder: 7.0 mm of light on a side of 5.4, which a periodic solution cannot know.",
    "mu is the weight with the best detail, as a person would choose who looks for vessels. The weight with the "
    "highest PCC is a blur.",
    "The flat field divides a picture by its own blur (sigma 4 degrees) inside the picture's outline. That lowers PCC: "
    "the division also removes the coarse brightness of disc and macula, which the truth has (the truth itself, so "
    "divided, is in the table), and it amplifies the ringing where the picture is dark. Detail, the correlation after "
    "subtraction of a blur of 2 degrees, falls less. SSIM falls as in the paper, but by less than 0.01. Inside the "
    "outline of the full disc instead of the photograph's it would rise by 0.009: the cut edges, whose blur takes in "
    "the dark beyond them, are then brightened.",
    "The stripes of flat-sub come from its own flat field, which is that of a full disc.",
)


class Dots(NamedTuple):
    """Detected dots: position (row, col), brightness, and angle to the axis in degrees."""

    places: np.ndarray
    peaks: np.ndarray
    angles_deg: np.ndarray


def find_dots(picture: Image, take: SimulatedFrame) -> Dots:
    """Return the dots of a picture: local maxima inside the field above the share FLOOR of the maximum."""
    soft = ndimage.gaussian_filter(picture, 0.8)
    size = int(APART_DEG * take.px_per_deg) | 1
    places = np.argwhere((soft == ndimage.maximum_filter(soft, size)) & (soft > FLOOR * soft.max()) & take.inside)
    middle = (np.array(picture.shape) - 1) / 2
    return Dots(places, soft[tuple(places.T)], np.hypot(*(places - middle).T) / take.px_per_deg)


def apply_floor(picture: Image, floor: float = FLOOR) -> Image:
    """Return a picture with values below `floor` times its maximum set to zero."""
    return np.where(picture < floor * picture.max(), 0, picture)


def flat_field_corrected(picture: Image, take: SimulatedFrame) -> Image:
    """Return a picture of dots divided by a smooth law of angle fitted to the dots' peaks; unchanged on the axis.

    For dots only; `SimulatedFrame.flat_field_corrected` differs: it divides by the picture's own blur.
    """
    dots = find_dots(picture, take)
    law = np.polynomial.Polynomial.fit(dots.angles_deg**2, np.log(dots.peaks), 2, w=np.sqrt(dots.peaks))
    rows, cols = (np.arange(n) - (n - 1) / 2 for n in picture.shape)
    angle_deg = np.hypot(rows[:, None], cols[None, :]) / take.px_per_deg
    gain = np.exp(law(0.0) - law(np.minimum(angle_deg, dots.angles_deg.max()) ** 2))
    return np.asarray(picture * gain, np.float32)


def peak(picture: Image, take: SimulatedFrame, right_deg: float) -> float:
    """Return the brightness of the dot at `right_deg` on the centre row."""
    cut = _window(picture, take, right_deg)
    return float(ndimage.gaussian_filter(cut, 0.8).max())


def edge_ratio(picture: Image, take: SimulatedFrame) -> float:
    """Return the ratio of the brightness of the outermost dot on the right to that of the centre dot."""
    return peak(picture, take, EDGE_DEG) / peak(picture, take, 0)


def elongation(picture: Image, take: SimulatedFrame, right_deg: float) -> float:
    """Return radial over tangential width (root second moments) of the dot at `right_deg` on the centre row."""
    cut = np.maximum(_window(picture, take, right_deg), 0).astype(np.float64)
    cut[cut < 0.2 * cut.max()] = 0
    rows, cols = (np.arange(n) for n in cut.shape)
    down, right = ndimage.center_of_mass(cut)
    across = (cut.sum(axis=1) * (rows - down) ** 2).sum()
    along = (cut.sum(axis=0) * (cols - right) ** 2).sum()
    return float(np.sqrt(along / across))


def _window(picture: Image, take: SimulatedFrame, right_deg: float) -> Image:
    row, col, reach = take.row(0), take.column(right_deg), round(WINDOW_DEG * take.px_per_deg)
    return picture[row - reach : row + reach + 1, col - reach : col + reach + 1]


def _row(name: str, scores: Scores) -> tuple[str, ...]:
    return name, f"{scores.pcc:.3f}", f"{scores.psnr_db:.1f}", f"{scores.ssim:.3f}"


class Cell(NamedTuple):
    """One setting of the sweep: weight, floor, and the scores of the picture with that floor, before and after."""

    mu: float
    floor: float
    before: Scores
    after: Scores


def cells(take: SimulatedFrame, bench: Bench) -> list[Cell]:
    """Return the scores before and after flat-field correction for every weight and floor."""
    out = []
    for mu, picture in bench.sweep_mu(take, SWEPT_MUS):
        for floor in FLOORS:
            before = apply_floor(picture, floor)
            out.append(Cell(mu, floor, take.score(before), take.score(flat_field_corrected(before, take))))
    return out


def dots_before_and_after(bench: Bench, take: SimulatedFrame) -> tuple[Image, Image]:
    """Return the paper's picture of dots, cut at zero, and the corrected one: floor FLOOR, then the division."""
    picture = bench.tikhonov(take, DOT_MU)
    return apply_floor(picture, 0.0), flat_field_corrected(apply_floor(picture), take)


def run_dots(bench: Bench) -> Outcome:
    """Compare the dots of a flat screen before and after correction: pictures of one setting, scores of all."""
    bench.progress("S1: dots over 51 degrees, flat screen")
    take = bench.expose("paper_dots", FLAT)
    direct, after = dots_before_and_after(bench, take)
    dots = find_dots(after, take)
    row = dots.places[np.abs(dots.places[:, 0] - take.row(0)) <= 2, 1]
    bench.progress("S1: every weight and floor")
    swept = cells(take, bench)
    claims = (
        *_printed_scores(take.score(direct), take.score(after), swept),
        above("rise of PCC by the division, floor 5 % before and after", _rise(swept, "pcc"), 0.0, IMPROVES)
        .adapted(FLOORED)
        .limit_from("any improvement"),
        above("rise of PSNR by the division, floor 5 % before and after, dB", _rise(swept, "psnr_db"), 0.0, IMPROVES, 2)
        .adapted(FLOORED)
        .limit_from("any improvement"),
        within(
            "width of the lattice that is found, degrees",
            (row.max() - row.min()) / take.px_per_deg,
            50.2,
            52.2,
            "51.2",
            2,
        )
        .put_in(SPANNED)
        .limit_from("51.2 +- 1, a quarter of the distance to the next dot"),
        below("edge dot over middle dot before", edge_ratio(direct, take), 0.35, "uneven").put_in(PARTLY),
        within("edge dot over middle dot after", edge_ratio(after, take), 0.5, 1.5, "compensated")
        .adapted(f"computed, but {FALLOFF}")
        .limit_from("1: as bright as the middle; within a factor of two below"),
    )
    shown = (
        *compared(take, {"direct": direct, "corrected": after}),
        cutline(take, 0.0, {"direct": direct, "corrected": after}, "Along the middle row of dots"),
    )
    return Outcome(claims, shown, (_swept(swept),), ON_DOTS)


def _printed_scores(before: Scores, after: Scores, swept: list[Cell]) -> tuple[Claim, ...]:
    """Return the claims on SSIM before and after flat-field correction, the only scores that the paper prints."""
    best = max(cell.after.ssim - cell.before.ssim for cell in swept)
    bare = next(cell for cell in swept if cell.mu == DOT_MU and cell.floor == 0.0)
    near = "the paper's value +- 0.1"
    return (
        attempted("SSIM of the direct picture", before.ssim, 0.49, 0.69, ".59")
        .adapted(f"{NO_FLOOR}; {FALLOFF}")
        .limit_from(near),
        attempted("SSIM of the corrected picture, floor 5 %", after.ssim, 0.75, 0.95, ".85")
        .adapted(f"{WITH_FLOOR}; without it {bare.after.ssim:.3f}; {FALLOFF}")
        .limit_from(near),
        attempted("rise of SSIM by the division, without a floor", bare.after.ssim - before.ssim, 0.16, 0.36, ".26")
        .because(
            f"the division lowers SSIM; a floor on the corrected picture only would give "
            f"{after.ssim - before.ssim:+.3f}, by the floor and not by the correction"
        )
        .limit_from(near),
        attempted("rise of SSIM by the division, best of 16 settings", best, 0.16, 0.36, ".26")
        .because("tried: four weights, four floors, the same before and after (table)")
        .limit_from(near),
    )


def _rise(swept: list[Cell], score: str) -> float:
    """Return the rise of a score at DOT_MU with the floor before and after the division."""
    chosen = next(cell for cell in swept if cell.mu == DOT_MU and cell.floor == FLOOR)
    return float(getattr(chosen.after, score) - getattr(chosen.before, score))


def _swept(settings: list[Cell]) -> Table:
    """Return a table of SSIM before and after the division: a row per weight, a column per floor."""
    rows = []
    for mu in dict.fromkeys(cell.mu for cell in settings):
        pairs = (f"{cell.before.ssim:.3f} to {cell.after.ssim:.3f}" for cell in settings if cell.mu == mu)
        rows.append((f"{mu:.0e}", *pairs))
    return Table(("mu", *(f"SSIM, floor {floor:.0%}" for floor in FLOORS)), tuple(rows))


def run_retina(bench: Bench) -> Outcome:
    """Solve a retina of the photograph's shape by the paper's solver and two that model the crop, and a full disc."""
    bench.progress("S2: a retina over 48.3 degrees")
    take, disc = bench.expose("paper_retina", CUT), bench.expose("paper_retina")
    mu, direct = bench.best_detail_mu(take)
    even = take.flat_field_corrected(direct)
    pictures = {f"paper's, mu {mu:.0e}": direct, "the same, flat field": even}
    methods = {"flat-sub": "gradient", DEFAULT: "variation"}
    pictures |= {name: bench.solve(take, method) for name, method in methods.items()}
    harder_mu, harder = bench.best_detail_mu(disc)
    harder_even = disc.flat_field_corrected(harder)
    claims = (
        *_feature_claims(take, direct),
        attempted(
            "change of SSIM by the flat field",
            take.score(even).ssim - take.score(direct).ssim,
            -1.0,
            0.0,
            "reduced by loss of contrast",
        )
        .adapted(f"{DRAWN}; divided inside the outline of the cut picture (note)")
        .limit_from("any reduction"),
        above("PCC of our default", take.score(pictures[DEFAULT]).pcc, 0.9),
    )
    shown = (
        *compared(take, pictures),
        *compared(disc, {f"full disc, paper's, mu {harder_mu:.0e}": harder}),
        cutline(take, 0.4, _cutline_pictures(pictures), "Across disc and macula"),
    )
    rows = [_detail_row(name, take.score(x)) for name, x in pictures.items()]
    rows += [
        _detail_row("the truth itself, flat field", take.score(take.flat_field_corrected(take.truth))),
        _detail_row(f"full disc, paper's, mu {harder_mu:.0e}", disc.score(harder)),
        _detail_row("full disc, the same, flat field", disc.score(harder_even)),
    ]
    head = ("picture", "PCC", "PSNR, dB", "SSIM", "detail")
    return Outcome(claims, shown, (Table(head, tuple(rows)),), ON_THE_CUT)


def _feature_claims(take: SimulatedFrame, picture: Image) -> tuple[Claim, ...]:
    """Return the claims on edges and spots of the truth that the picture follows."""
    asked, same = _edges(take, picture)
    lesions, seen = spots_followed(take, picture)
    return (
        above(
            "edges on five cutlines with the truth's sign, share",
            same / max(asked, 1),
            0.9,
            "bright and dark edges are followed",
        ),
        above("clear edges of the truth on the five cutlines, number", asked, 20, digits=0).limit_from(
            "so that one edge is at most 5 %"
        ),
        above(
            "bright and dark spots with the truth's sign, share",
            seen / max(lesions, 1),
            0.75,
            "major features are captured",
        ),
        above("bright and dark spots of the truth, number", lesions, 10, digits=0).limit_from(
            "so that one spot is at most 10 %"
        ),
    )


def _detail_row(name: str, scores: Scores) -> tuple[str, ...]:
    return *_row(name, scores), f"{scores.highpass_pcc:.3f}"


def _edges(take: SimulatedFrame, picture: Image) -> tuple[int, int]:
    """Return the number of clear edges of the truth on the cutlines ROWS_DEG, and how many the picture follows."""
    found = [edge_signs(take, picture, down_deg) for down_deg in ROWS_DEG]
    return sum(n for n, _ in found), sum(n for _, n in found)


def _cutline_pictures(pictures: dict[str, Image]) -> dict[str, Image]:
    """Return the pictures of a cutline: the paper's solver, flat-sub and our default."""
    return {name: x for number, (name, x) in enumerate(pictures.items()) if number in (0, 2, 3)}


def run_flat_screen(bench: Bench) -> Outcome:
    """Solve the lattice of dots on a flat screen with beam walk, the paper's suspected cause of the uneven pictures."""
    bench.progress("S2b: dots on a flat screen")
    curved, flat = bench.expose("paper_dots"), bench.expose("paper_dots", FLAT)
    good, bad = (apply_floor(bench.tikhonov(take, DOT_MU)) for take in (curved, flat))
    scores = curved.score(good), flat.score(bad)
    drawn_out = sum(elongation(bad, flat, at) / elongation(good, curved, at) for at in (-NEXT_DEG, NEXT_DEG)) / 2
    claims = (
        below("edge dot over middle dot on the flat screen", edge_ratio(bad, flat), 0.35, "uneven").put_in(PARTLY),
        above(
            "PCC lost by the flat screen", scores[0].pcc - scores[1].pcc, 0.05, "more blurred, lower contrast"
        ).adapted(f"{NO_NUMBER}; {FALLOFF}, for both screens"),
        above("length over width of edge dots, flat screen over curved", drawn_out, 1.1),
    )
    shown = (
        *compared(flat, {"flat screen": bad, "curved screen": good}),
        plane("right edge of the flat screen", _edge(bad, flat)),
        cutline(flat, 0.0, {"curved": good, "flat": bad}, "Along the middle row of dots"),
    )
    rows = (_row("curved", scores[0]), _row("flat", scores[1]))
    note = (
        "The flat screen is 4.7 and 9.8 dpt out of focus at its edge, across and along the radius (T); so its dots are "
        "drawn out along the radius."
    )
    return Outcome(claims, shown, (Table(("screen", "PCC", "PSNR, dB", "SSIM"), rows),), (note,))


def _edge(picture: Image, take: SimulatedFrame) -> Image:
    return picture[take.row(-7) : take.row(7), take.column(14) : take.column(28)]


EXPERIMENTS = (
    Experiment(
        "S1",
        "Dots on a flat screen",
        "A lattice of 275 um dots over 51.2 degrees, direct and after the flat field.",
        "Figure 3b: 51.2 degrees; the flat field raises SSIM from 0.59 to 0.85.",
        run_dots,
    ),
    Experiment(
        "S2",
        "A retina on a screen",
        "A diabetic retina in the shape of the paper's photograph, 48.3 by 34.6 degrees; and the full disc.",
        "Figure 3c: 48.3 degrees; the flat field's loss of contrast lowers SSIM; vessels blurred, edges followed.",
        run_retina,
        DRAWN,
    ),
    Experiment(
        "S2b",
        "The screen is flat",
        "The same dots on a flat screen behind a single lens, with the walk of the beam.",
        'Figure 3: "possibly due to the mismatch between the model curved retina and the flat OLED screen".',
        run_flat_screen,
    ),
)
