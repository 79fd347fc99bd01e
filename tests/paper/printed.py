"""S3, S4, S7: the paper's printed targets, lit by the LED ring, and the limits of the field."""

from collections.abc import Iterable, Mapping
from math import atan, degrees, isfinite
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from device.optics.light_path import load_light_path
from device.recon.assessment.metrics import Scores, shift_px
from device.values import Image
from services import resources
from tests.paper.bench import DEFAULT, Bench, HeadChanges, SimulatedFrame
from tests.paper.edges import edge_signs, spots_followed
from tests.paper.outcome import Claim, Experiment, Figure, Outcome, Table, above, attempted, below, within
from tests.paper.pictures import compared, cutline, raw_cutlines
from tests.paper.relay_figures import BuiltRelay, built_relay, field_of_cone_deg
from tests.paper.screen import DOT_MU, apply_floor, find_dots
from tests.paper.traced import PAPER_CONE_DEG, PAPER_RING_MM

MOVED_DEG = degrees(atan(4 / 25))  # 4 mm in the focal plane of a 25 mm lens
ROWS_DEG = (-4.0, 0.0, 4.0)  # cutlines of each position
FAINT_STEP = 0.03  # step of a faint edge over the blur's width, of the field's mean
PATCH_DEG = 6.0  # half side of the retinal patch visible in both positions
EVEN = "even light, and so without the paper's flat-field correction"
UNCORRECTED = "the paper compares pictures after flat-field correction"
MUCH = "much: our reading, met without the correction; set after that value"
CAPTURED = "vessels, haemorrhages, disc captured"
MOVED_NOTE = (
    "The paper moved the model eye sideways to move the field. With an object at infinity that moves the pupil, not "
    "the field; here the print moves by 4 mm behind the lens, which is 9.09 degrees."
)
WIDER_CONE_DEG, HALF_OF_DEG = 30.0, 10.0
WIDE_LATTICE: HeadChanges = {
    "optics.field_deg": 62.0,
    "sim.object.dots_apart_um": 980.0,
    "sim.object.half_size_um": (14700.0, 1960.0),
    "sim.eye.surface": "flat",
    "sim.eye.walks": True,
    "sim.light.falloff": False,
    "sim.light.vignette_deg": 180.0,
}
LATTICE = "a lattice over 61 degrees, as bright at its edge as in the middle (within 3 %)"
LIMITED = "limited by the extent of the LED illumination"
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
    """Solve a white and a black ruler by the paper's solver with one weight, the black one by two of ours as well."""
    bench.progress("S3: rulers, white on black and black on white")
    sparse, dense = bench.expose("paper_ruler_positive"), bench.expose("paper_ruler_negative")
    mu, _, _ = bench.best_mu(dense)
    white, black = (np.maximum(bench.tikhonov(take, mu), 0) for take in (sparse, dense))
    flat, ours = (bench.solve(dense, method) for method in ("gradient", "variation"))
    long_deg = ruler_deg(bench.tikhonov(sparse, DOT_MU), sparse)
    one, two, three, four = sparse.score(white), dense.score(black), dense.score(flat), dense.score(ours)
    even = sparse.score(sparse.flat_field_corrected(white)), dense.score(dense.flat_field_corrected(black))
    claims = (
        within("15 mm as reconstructed, degrees", long_deg, 33.1, 33.7, "33.4", 2).put_in(
            "the scene's ruler is 33.4 degrees long: the row shows that the picture keeps its length"
        ),
        *_two_rulers(one, two, even),
        above("PCC of the black ruler, flat-sub", three.pcc, 0.89),
        above("PCC of the black ruler, our default", four.pcc, 0.9),
        above(
            "contrast of the raw frame, white ruler over black",
            _contrast(sparse) / _contrast(dense),
            2.0,
            "higher contrast (4b)",
        ),
    )
    rows = _score_rows(
        {
            "white on black, paper's solver": one,
            "black on white, paper's solver": two,
            "white on black, the same, flat field": even[0],
            "black on white, the same, flat field": even[1],
            "black on white, flat-sub": three,
            f"black on white, {DEFAULT}": four,
        }
    )
    shown = (
        *compared(sparse, {f"paper's solver, mu {mu:.0e}": white}, "white ruler"),
        *compared(dense, {f"paper's solver, mu {mu:.0e}": black, "flat-sub": flat, DEFAULT: ours}, "black ruler"),
        raw_cutlines({"white ruler": sparse, "black ruler": dense}, -1.6, "The raw frames, as measured (figure 4b)"),
        cutline(sparse, -1.6, {"paper's solver": white}, "White ruler, across the ticks"),
        cutline(dense, -1.6, {"paper's solver": black, DEFAULT: ours}, "Black ruler, across the ticks"),
    )
    return Outcome(claims, shown, (Table(("picture", "PCC", "PSNR, dB", "SSIM"), rows),), (_rulers_note(even),))


def _score_rows(scores: dict[str, Scores]) -> tuple[tuple[str, ...], ...]:
    return tuple((name, f"{s.pcc:.3f}", f"{s.psnr_db:.1f}", f"{s.ssim:.2f}") for name, s in scores.items())


def _rulers_note(even: tuple[Scores, Scores]) -> str:
    return (
        "The paper calls the black ruler on white the positive one in its results and the dense one in its discussion. "
        "Here the white ruler is white on black, the black one black on white. The pictures are cut at zero, as a "
        "printed figure is. The paper's statement has three parts, and no setting here has all of them: without "
        "flat-field correction PSNR and SSIM are much lower on white paper, but so is PCC; after the correction of "
        f"both, as in the paper, the PCC are similar ({even[0].pcc:.2f} and {even[1].pcc:.2f}), but PSNR and SSIM of "
        "the white ruler are no better: our correction spoils a picture that is mostly black."
    )


def _two_rulers(white: Scores, black: Scores, even: tuple[Scores, Scores]) -> tuple[Claim, ...]:
    """Return the claims on the scores of both rulers by the paper's solver; `even`: after flat-field correction."""
    gone = "gone after the flat-field correction, with which the paper has it; seen only without it"
    return (
        above(
            "PSNR after the flat field, white ruler minus black, dB",
            even[0].psnr_db - even[1].psnr_db,
            4.0,
            "much reduced",
            1,
        )
        .as_attempt()
        .because(f"{gone} (+{white.psnr_db - black.psnr_db:.1f} dB)")
        .limit_from(MUCH),
        above("SSIM after the flat field, white ruler minus black", even[0].ssim - even[1].ssim, 0.15, "much reduced")
        .as_attempt()
        .because(f"{gone} (+{white.ssim - black.ssim:.2f})")
        .limit_from(MUCH),
        attempted("PCC, white ruler minus black", white.pcc - black.pcc, -0.05, 0.05, "remains similar")
        .because(
            "without the flat-field correction it falls with the PSNR; tried: weights from 1e-6 to 1e-3, of which "
            f"this one has the least difference. With the correction {even[0].pcc - even[1].pcc:+.2f}, but then "
            "the two rows above fail"
        )
        .limit_from("similar: within 0.05, our reading"),
        above("PSNR without flat field, white ruler minus black, dB", white.psnr_db - black.psnr_db, 4.0, "", 1).ours(
            UNCORRECTED
        ),
        above("SSIM without flat field, white ruler minus black", white.ssim - black.ssim, 0.15).ours(UNCORRECTED),
        above("PCC of the black ruler, paper's solver", black.pcc, 0.85),
    )


def _contrast(take: SimulatedFrame) -> float:
    """Return standard deviation over mean of the lit raw frame, with coarse shading removed."""
    raw = take.raw.astype(np.float64)
    soft = ndimage.gaussian_filter(raw, 3 * take.px_per_deg)
    lit = soft > 0.5 * soft.max()
    fine = ndimage.gaussian_filter(raw, 2) / np.maximum(soft, 1e-9)
    return float(fine[lit].std())


class Position(NamedTuple):
    """One print at one place behind the lens: its frame, two pictures, and the features that the paper's has.

    Each pair is the number of features in the truth, and how many have the same sign in the paper's solution.
    """

    take: SimulatedFrame
    paper: Image
    flat: Image
    edges: tuple[int, int]
    faint: tuple[int, int]
    spots: tuple[int, int]


def print_at(bench: Bench, right_deg: float) -> Position:
    """Return the print moved by `right_deg`, solved by the paper's solver and `gradient`."""
    take = bench.expose("paper_print", {"sim.object.at_deg": (right_deg, 0.0)})
    _, paper, _ = bench.best_mu(take)
    edges = _sum([edge_signs(take, paper, down_deg) for down_deg in ROWS_DEG])
    faint = _sum([edge_signs(take, paper, down_deg, FAINT_STEP) for down_deg in ROWS_DEG])
    return Position(take, paper, bench.solve(take, "gradient"), edges, faint, spots_followed(take, paper))


def _sum(counts: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """Return the sums of counted and followed features."""
    counted, followed = zip(*counts, strict=True)
    return sum(counted), sum(followed)


def run_prints(bench: Bench) -> Outcome:
    """Solve one print of a retina at three lateral positions behind the lens, by the paper's solver and `gradient`."""
    found: dict[str, Position] = {}
    for name, right_deg in POSITIONS.items():
        bench.progress(f"S4: a printed retina, {name}")
        found[name] = print_at(bench, right_deg)
    asked, same = _sum(position.edges for position in found.values())
    faint, faint_same = _sum(position.faint for position in found.values())
    spots, seen = _sum(position.spots for position in found.values())
    off = [misregistration(found, name) for name in ("left", "right")]
    claims = (
        above("edges on nine cutlines with the truth's sign, share", same / max(asked, 1), 0.999, CAPTURED).limit_from(
            "every one of them"
        ),
        above("clear edges of the truth on the nine cutlines, number", asked, 20, "", 0).limit_from(
            "so that one edge is at most 5 %"
        ),
        above("bright and dark spots with the truth's sign, share", seen / max(spots, 1), 0.75, CAPTURED),
        above("bright and dark spots of the truth, number", spots, 20, "", 0).limit_from(
            "so that one spot is at most 5 %"
        ),
        below("distance between a feature in two positions, samples", max(off), 1.0, "", 2).limit_from(
            "one sample of 0.13 degrees"
        ),
    )
    rows = tuple(
        (
            name,
            *(f"{position.take.score(x).pcc:.3f}" for x in (position.paper, position.flat)),
            *(f"{got}/{of}" for of, got in (position.edges, position.spots)),
        )
        for name, position in found.items()
    )
    sheet = Table(("position", "PCC, paper's solver", "PCC, flat-sub", "edges followed", "spots followed"), rows)
    return Outcome(claims, _shown(found), (sheet,), (MOVED_NOTE, _clear_edges(faint, faint_same)))


def _shown(found: dict[str, Position]) -> tuple[Figure, ...]:
    shown: list[Figure] = []
    for name, position in found.items():
        both = {"paper's solver": position.paper, "flat-sub": position.flat}
        shown += compared(position.take, both, name)
        shown.append(cutline(position.take, 0.0, both, f"Across vessels, {name}"))
    return tuple(shown)


def _clear_edges(faint: int, same: int) -> str:
    """Return the note on the thresholds of edges and spots, with the count of the faint edges."""
    return (
        "An edge counts if the truth changes by 5 % of the mean over 0.6 degrees: one and a half times the rms error "
        "of that change in the paper's solution, 2.3 to 3.2 % at the three positions, which is its ringing. Of the "
        f"edges from 3 % on {same} of {faint} have the truth's sign: the faintest are lost in the ringing. A spot is a "
        "lesion or other patch away from vessels that differs from its surroundings by 3 % of the mean."
    )


def misregistration(found: Mapping[str, Position], name: str) -> float:
    """Return the registration error in samples of the retinal patch shared by a side position and the centre."""
    take = found[name].take
    half = round(PATCH_DEG * take.px_per_deg)
    shared_deg = POSITIONS[name] / 2  # centre of the shared patch, in the coordinates of the side position
    patches = []
    for which, at_deg in ((name, shared_deg), ("middle", shared_deg - POSITIONS[name])):
        row, col = take.row(0), take.column(0) + round(at_deg * take.px_per_deg)
        patches.append(found[which].flat[row - half : row + half, col - half : col + half])
    moved = (
        round(shared_deg * take.px_per_deg)
        - round((shared_deg - POSITIONS[name]) * take.px_per_deg)
        - POSITIONS[name] * take.px_per_deg
    )
    down, right = shift_px(patches[0], patches[1])
    return float(np.hypot(down, right + moved))


def lit_print_deg(bench: Bench, field_deg: float) -> tuple[SimulatedFrame, Image, float]:
    """Return frame, picture by the paper's solver, and its width in degrees, of a print lit over a field.

    The width is that of the middle row above half of its median brightness, after a blur of half a degree.
    """
    take = bench.expose("paper_print", {"optics.field_deg": field_deg, "sim.eye.walks": True})
    _, picture = bench.best_detail_mu(take)
    soft = ndimage.gaussian_filter(picture.astype(np.float64), 0.5 * take.px_per_deg)[take.row(0)]
    level = 0.5 * float(np.median(soft[take.column(-12) : take.column(12)]))
    bright = ndimage.label(soft > level)[0]
    return take, picture, float((bright == bright[take.column(0)]).sum()) / take.px_per_deg


def lattice_deg(take: SimulatedFrame, picture: Image) -> tuple[float, float]:
    """Return the width in degrees of the dots found on the middle row, and that of those at half the middle's light.

    Half: interpolated on each side between the dots where the brightness first falls below half of the median within
    HALF_OF_DEG of the axis.
    """
    dots = find_dots(picture, take)
    row = np.abs(dots.places[:, 0] - take.row(0)) <= 2
    right_deg = (dots.places[row, 1] - (picture.shape[1] - 1) / 2) / take.px_per_deg
    light = dots.peaks[row] / np.median(dots.peaks[row][np.abs(right_deg) < HALF_OF_DEG])
    halves = []
    for side in (-1, 1):
        out = np.flatnonzero(side * right_deg > 0)
        out = out[np.argsort(side * right_deg[out])]
        beyond = int(np.argmax(light[out] < 0.5))
        last = out[[beyond, beyond - 1]]  # in the order of rising light
        halves.append(float(np.interp(0.5, light[last], right_deg[last])))
    return float(np.ptp(right_deg)), halves[1] - halves[0]


def field_to_rims_deg(relay: BuiltRelay, led_mm: float) -> float:
    """Return the field that the widest cone of an LED lights whose rays pass the rims of all lenses, degrees."""
    low, high = 0.0, 60.0
    for _ in range(20):
        middle = (low + high) / 2
        passes = isfinite(field_of_cone_deg(relay, middle, led_mm))
        low, high = (middle, high) if passes else (low, middle)
    return field_of_cone_deg(relay, low, led_mm)


def run_fields(bench: Bench) -> Outcome:
    """Measure the width of a print lit by two cones of the LEDs, and that of a lattice wider than the paper's."""
    bench.progress("S7: what limits the field")
    relay, led_mm = built_relay(load_light_path(resources.LIGHT_PATH)), PAPER_RING_MM / 2
    fields = [field_of_cone_deg(relay, cone, led_mm) for cone in (PAPER_CONE_DEG, WIDER_CONE_DEG)]
    (lit, picture, lit_deg), (wide, wider, wide_deg) = (lit_print_deg(bench, field_deg) for field_deg in fields)
    shining = bench.expose("paper_dots", WIDE_LATTICE)
    dots = apply_floor(bench.tikhonov(shining, DOT_MU))
    found_deg, half_deg = lattice_deg(shining, dots)
    to_rims_deg = field_to_rims_deg(relay, led_mm)
    claims = (
        *_cone_claims(lit_deg, wide_deg, fields[1]),
        above("even dots found on a flat screen, degrees", found_deg, 51.2, "51 (51.2)", 1)
        .adapted(f"{LATTICE}; the dots have at least 5 % of the brightest")
        .limit_from("the paper's lattice, beyond which this one reaches"),
        above("dots at half the middle's light over the lit print", half_deg / lit_deg, 1.0, LIMITED, 2)
        .adapted(f"{LATTICE}; the print is lit by a cone that was put in")
        .limit_from("the light ends first"),
        above(
            "field lit by an LED without its cap, to the rims, degrees",
            to_rims_deg,
            51.2,
            "mitigated by improving the illumination NA",
            1,
        )
        .adapted("traced; orientation and distances of the lenses are ours")
        .limit_from("the imaging path's 51.2"),
    )
    shown = (
        *compared(lit, {"cone of 24.75 degrees": picture}),
        *compared(wide, {"cone of 30 degrees": wider}),
        *compared(shining, {"shining dots": dots}),
    )
    return Outcome(claims, shown, (), (_fields_note(half_deg),))


def _cone_claims(lit_deg: float, wide_deg: float, traced_wide_deg: float) -> tuple[Claim, ...]:
    """Return the claims on the field lit by the paper's cone and by a wider one."""
    return (
        within("print lit by a cone of 24.75 degrees, degrees", lit_deg, 32, 34, "33 (33.4)", 1)
        .put_in("the paper prints no cone: 24.75 is its 33 over f2 / f1")
        .limit_from("the paper's 33 +- 1"),
        within(
            "print lit by a cone of 30 degrees, degrees",
            wide_deg,
            round(traced_wide_deg - 1.5, 1),
            round(traced_wide_deg + 1.5, 1),
            LIMITED,
            1,
        )
        .adapted("the cone is wider than the paper's; if something else limits the field, it does not grow")
        .limit_from(f"traced light: {traced_wide_deg:.1f} degrees; +- 1.5, blur and sample at both edges"),
    )


def _fields_note(half_deg: float) -> str:
    return (
        "Nothing but the first row was given its width. The second asks whether the picture's field follows the cone "
        "of the LEDs; a cone wider than 30 degrees lights more than the short side of the sensor holds, and the "
        "paper's periodic solver then loses the edge of the field. The lattice reaches to 30.5 degrees from the axis, "
        f"where a tenth of the iris is lit (T); its dots have half the light of the middle over {half_deg:.0f} degrees "
        "on the flat screen, whose blur dims them. Without the cap only the rims of the lenses limit the light of an "
        "LED; it would then light more than the imaging path takes in. So the cap limits the field, not the rims."
    )


EXPERIMENTS = (
    Experiment(
        "S3",
        "A printed ruler, white and black",
        "Fifteen millimetres with a tick each millimetre, white on black and "
        "black on white, with one and the same weight.",
        "Figure 4b: 15 mm are 33.4 degrees; PCC similar, PSNR and SSIM much reduced on white paper.",
        run_rulers,
        EVEN,
    ),
    Experiment(
        "S4",
        "A printed retina at three places",
        "The print is moved by 4 mm to either side behind the lens.",
        "Figure 4c: vessels, haemorrhages and disc are captured at all three places.",
        run_prints,
        f"the print moves behind the lens, not the model eye; the retina is drawn; {EVEN}",
    ),
    Experiment(
        "S7",
        "What limits the field",
        "A print lit by LEDs whose cap leaves a cone of 24.75 or 30 degrees, traced "
        "through the relay, beside shining dots that reach farther than the paper's and the beam walk of T.",
        'Discussion: "the current system FOV is limited by the extent of the LED illumination".',
        run_fields,
    ),
)
