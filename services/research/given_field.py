"""Field that was given for a raw frame, compared with the lit disc in the frame."""

from dataclasses import dataclass

from device.config.head_file import InstrumentSpec, load_head
from device.errors import FrameError, SettingError
from device.optics.lit_angle import has_sharp_edge, picture_field_deg
from device.recon.assessment.lit_disc import lit_disc_deg
from device.recon.assessment.quality_figures import LITTLE_LIGHT, MIN_EXPLAINED_LIT, UNEXPLAINED
from device.recon.corrections import MAX_EXPLAINED
from device.recon.model.fft_plans import Planner
from device.recon.model.kernels import Pixels
from device.values import Calibration, Report
from services.research.reconstruct_inputs import ReconstructOptions

TOLERANCE = 0.04  # of the given field: the disc is found within 0.012 of its diameter
NEAR_HEAD = 0.03  # of the field of the head, which is then the one to give
NO_DISC = "the light of the frame ends in no disc"
MARGIN = 1.01  # of a disc that was found: the picture must not end within it


@dataclass(frozen=True)
class LitField:
    """Lit disc in degrees, which is smaller than the field that was given; None where the light ends in no disc."""

    diameter_deg: float | None
    given_deg: float

    def note(self, is_used: bool) -> str:
        """Return the sentence of a report about it; `is_used`: the picture was made with the lit disc."""
        if self.diameter_deg is None:
            return f"{UNEXPLAINED} Its light does not end as a disc does: uneven stray light is a possible cause."
        found = f"Only a disc of {self.diameter_deg:g} degrees is lit, and the field was given as {self.given_deg:g}"
        if not is_used:
            return f"{found}. Give --field-deg {self.diameter_deg:g}; there was no time to solve the frame again."
        return (
            f"{found}: the picture was made with the lit disc, as by --field-deg {self.diameter_deg:g}. "
            f"With --field-fixed it keeps {self.given_deg:g} degrees."
        )


def is_doubtful(report: Report, options: ReconstructOptions) -> bool:
    """Return whether the field of a picture is to be compared with its frame: it was given, or the frame is odd.

    Never in too little light, where the disc's edge is noise.
    """
    if options.field_fixed or options.head is None or any(LITTLE_LIGHT in words for words in report.warnings):
        return False
    is_odd = _is_refused(report) or (report.residual or 0.0) > MAX_EXPLAINED or not _is_all_lit(report)
    return options.field_deg is not None or is_odd


def has_time_again(report: Report, options: ReconstructOptions) -> bool:
    """Return whether the time budget leaves time to solve the frame once more, as long as the report says."""
    return options.budget_s is None or 2 * sum(report.seconds.values()) < options.budget_s


def _is_refused(report: Report) -> bool:
    return report.refraction_dpt is not None and report.refraction_dpt.get("refused") is not None


def _is_all_lit(report: Report) -> bool:
    share = report.quality.get("coverage")
    return share is None or share >= MIN_EXPLAINED_LIT


def smaller_field(
    options: ReconstructOptions, calibration: Calibration, counts: Pixels, planner: Planner, report: Report
) -> LitField | None:
    """Return the lit disc of a frame (rows, cols) where it is smaller than the field that was given, else None.

    It is unknown where the light ends in no disc, and nothing in the report says why its refraction was refused.
    SettingError where the frame is lit outside of that field.
    """
    assert options.head is not None
    spec = options.head if isinstance(options.head, InstrumentSpec) else load_head(options.head)
    given_deg, of_head_deg = calibration.field_deg, picture_field_deg(spec)
    if given_deg is None or of_head_deg is None or not has_sharp_edge(spec):
        return None
    try:
        found_deg = lit_disc_deg(calibration, counts, planner, report.psf_index)
    except FrameError:  # too little of it is left
        return None
    if found_deg is None and _is_refused(report) and _is_all_lit(report) and not report.warnings:
        return LitField(None, given_deg)
    if found_deg is None or abs(found_deg / given_deg - 1) <= TOLERANCE:
        return None
    is_of_head = abs(found_deg / of_head_deg - 1) <= NEAR_HEAD
    fitting_deg = of_head_deg if is_of_head else round(MARGIN * found_deg, 1)
    if found_deg > given_deg:
        raise SettingError(
            f"the frame is lit in a disc of {fitting_deg:g} degrees, and its field was given as {given_deg:g}",
            f"Give --field-deg {fitting_deg:g}. With --field-fixed the picture keeps {given_deg:g} degrees.",
        )
    return LitField(fitting_deg, given_deg)
