"""N: the paper's first-order numbers by their formulas, and the contradictions between them."""

from device.optics.eye import Relay, correction_dpt, field_deg
from device.optics.field_extent import extent_mm, strict_field_deg
from services.lab.paper.bench import Bench
from services.lab.paper.outcome import Claim, Experiment, Outcome, above, below, within

LONG_MM, SHORT_MM = 9.6768, 5.4432
NOTES = (
    "The rule D > d + 2s holds for the long side of the paper's own sensor only. Its short side, 5.44 mm, is "
    "smaller than "
    "the 5.82 mm that 33.4 degrees need, and the 7.13 mm of 50. So every picture of more than 28.6 degrees is a "
    "cropped "
    "convolution, which the paper's periodic solution does not know; S2 and S10 show what that costs.",
    "The lens of the model eye is catalogued with 25.4 mm; only 25.0 gives the paper's 33.4 degrees and its -5.5 and "
    "+7.6 dpt. We use 25.0.",
    "The displacement s is a small-angle formula; an ideal relay would follow the tangent (3.8 % more at 50 degrees). "
    "The traced lenses follow the small-angle formula within 0.5 % (T), and so do our fields; dots on a screen are "
    "placed by the tangent of the model eye's lens.",
    'The field was "moved by translating the model eye laterally". At infinite conjugates that moves the pupil, '
    "not the "
    "field; S4 moves the print behind the lens.",
    "Robustness to 4 dpt is put down to lenslets with a large depth of focus. The blur is the ordinary blur "
    "circle; it is "
    "tolerated because the resolution is no better (S5).",
    "Which ruler is positive changes between results and discussion; we say white and black (S3).",
)


def run_numbers(bench: Bench) -> Outcome:
    """Evaluate the formulas; this experiment simulates nothing."""
    relay = Relay()
    lit_mm = extent_mm(relay, 50)
    claims: tuple[Claim, ...] = (
        within("15 mm behind 25 mm, degrees", field_deg(15), 33.35, 33.45, "33.4", 2),
        within("24 mm behind 25 mm, degrees", field_deg(24), 51.1, 51.3, "51.2", 2),
        within("screen at 29 mm, spectacle correction, dpt", correction_dpt(29), -5.55, -5.45, "-5.5", 2),
        within("screen at 21 mm, spectacle correction, dpt", correction_dpt(21), 7.55, 7.65, "+7.6", 2),
        within("LED cone 24.75 degrees lights, degrees", 24.75 * relay.pupil_magnification, 32.5, 33.5, "33", 2).put_in(
            "the cone is the paper's 33 degrees over f2 / f1; T traces it"
        ),
        above("sensor's long side over d + 2s at 50 degrees", LONG_MM / lit_mm, 1.0, "> 50 degrees", 2),
        below("sensor's short side over d + 2s at 50 degrees", SHORT_MM / lit_mm, 1.0, "not mentioned", 2).ours(),
        within(
            "field that the short side holds, degrees", strict_field_deg(relay, SHORT_MM), 28.4, 28.7, "> 50", 2
        ).ours("contradicts the paper: its rule, on its own sensor's short side"),
    )
    return Outcome(tuple(one.limit_from("rounding of the printed number") for one in claims), notes=NOTES)


EXPERIMENTS = (
    Experiment(
        "N", "The paper's numbers", "Every number of the paper's optics, by the formula that gives it, and six places "
        "where the paper contradicts itself or says less than it should.",
        "Sections \"Optical design\", \"Results\" and \"Discussion\".", run_numbers,
    ),
)  # fmt: skip
