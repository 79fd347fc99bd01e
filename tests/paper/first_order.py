"""N: the paper's first-order numbers by their formulas, and the contradictions between them."""

from device.optics.eye import Relay, correction_dpt, field_deg
from device.optics.field_extent import extent_mm, strict_field_deg
from tests.paper.bench import Bench
from tests.paper.outcome import Claim, Experiment, Outcome, above, below, within

LONG_MM, SHORT_MM = 9.6768, 5.4432
ROUNDED = "half a unit of the last printed digit"
PRINTED_FOCUS = "f = 25 mm as the paper prints it; the lens's maker has 25.4 mm"
LONG_SIDE = "D read as the long side; the short side breaks the rule beyond 28.6 degrees (the last two rows)"
NOTES = (
    "The rule D > d + 2s holds for the long side of the paper's own sensor only. Its short side, 5.44 mm, is "
    "smaller than "
    "the 5.82 mm that 33.4 degrees need, and the 7.13 mm of 50. So every picture of more than 28.6 degrees is a "
    "cropped "
    "convolution, which the paper's periodic solution does not know; S2 and S10 show what that costs.",
    "The paper prints f = 25 mm for the lens of the model eye, the maker 25.4 mm; only 25.0 gives the paper's 33.4 "
    "degrees and its -5.5 and +7.6 dpt. We use 25.0.",
    "The displacement s is a small-angle formula. At 25 degrees from the axis an ideal relay, which keeps the tangent, "
    "has 6.9 % more, the traced lenses 3.4 % more (T): 3.8 and 1.9 % of d + 2s over 50 degrees; at 16.7 degrees the "
    "traced lenses have 1.2 % more. The simulator follows the paper's formula. Dots on a screen are placed by the "
    "tangent of the model eye's lens.",
    'The field was "moved by translating the model eye laterally". At infinite conjugates that moves the pupil, '
    "not the "
    "field; S4 moves the print behind the lens.",
    "Robustness to 4 dpt is put down to lenslets with a large depth of focus. In the simulator the blur is the "
    "ordinary blur circle, and it is tolerated because the resolution is no better (S5).",
    "Which ruler is positive changes between results and discussion; we say white and black (S3).",
)


def run_numbers(bench: Bench) -> Outcome:
    """Evaluate the formulas; this experiment simulates nothing."""
    relay = Relay()
    claims: tuple[Claim, ...] = (
        within("field of 15 mm behind a lens of 25 mm, degrees", field_deg(15), 33.35, 33.45, "33.4", 2)
        .because(PRINTED_FOCUS)
        .limit_from(ROUNDED),
        within("field of 24 mm behind a lens of 25 mm, degrees", field_deg(24), 51.2, 51.3, "51.2", 2)
        .because(PRINTED_FOCUS)
        .limit_from("51.28 is printed as 51.2: cut off after one decimal, not rounded"),
        within("correction Rx of a screen at 29 mm, dpt", correction_dpt(29), -5.55, -5.45, "-5.5", 2)
        .because(PRINTED_FOCUS)
        .limit_from(ROUNDED),
        within("correction Rx of a screen at 21 mm, dpt", correction_dpt(21), 7.55, 7.65, "+7.6", 2)
        .because(PRINTED_FOCUS)
        .limit_from(ROUNDED),
        within(
            "field lit by an LED's cone of 24.75 degrees, degrees",
            24.75 * relay.pupil_magnification,
            32.5,
            33.5,
            "33",
            2,
        )
        .put_in("the paper prints no cone: 24.75 is its 33 over f2 / f1")
        .limit_from(ROUNDED),
        *_sensor_claims(relay),
    )
    return Outcome(claims, notes=NOTES)


def _sensor_claims(relay: Relay) -> tuple[Claim, ...]:
    """Return the claims on the paper's rule for the size of the sensor."""
    lit_mm = extent_mm(relay, 50)
    return (
        above("sensor's long side over d + 2s at 50 degrees", LONG_MM / lit_mm, 1.0, "D > d + 2s for > 50 degrees", 2)
        .adapted(LONG_SIDE)
        .limit_from("the rule: D is more than d + 2s"),
        below("rule broken on the short side: D over d + 2s, 50 degrees", SHORT_MM / lit_mm, 1.0, "", 2)
        .ours("the paper does not mention the short side")
        .limit_from("the rule is broken below 1"),
        within(
            "field that the rule allows on the short side, degrees",
            strict_field_deg(relay, SHORT_MM),
            28.5,
            28.6,
            "",
            2,
        )
        .ours("the paper's rule on its own sensor; it contradicts the paper's 33 and 50 degrees")
        .limit_from("by hand: (5.443 - 3.2) mm / (0.75 x 6 mm) is 28.56 degrees"),
    )


EXPERIMENTS = (
    Experiment(
        "N",
        "The paper's numbers",
        "Numbers of the paper's optics, by the formula that gives them; nothing is "
        "simulated. The notes name six places where the paper contradicts itself or says less than it should.",
        'Sections "Optical design", "Results" and "Discussion".',
        run_numbers,
    ),
)
