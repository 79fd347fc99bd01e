"""Search for the lenslets of a head as text, and the best layout as a file: `diffuscope optics --design`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path

from device.errors import SettingError
from device.optics.budget import Design, optical_budget
from device.optics.lens_design import COUNTS, Candidate, Figure, figure, search
from device.optics.lens_layout import layout_csv
from services.research.reconstruct_file import write_or_raise

SAMPLE_UM = 6.0  # least width of a sample of the sensor: of the detail that a human eye's light gives, none is finer
SEED = 0


def design_layout(
    chosen: Design, layout: Path | None, show: Callable[[str], None], counts: Sequence[int] = COUNTS
) -> Candidate:
    """Show the search for lenslets of a head and return the best, which `layout` gets as CSV.

    The best has the most detail in the refraction that has least. SettingError for a head without light.
    """
    merged = ceil(SAMPLE_UM / chosen.pitch_um)
    pitch_um = merged * chosen.pitch_um
    object_e = _object_e(replace(chosen, pitch_um=pitch_um))
    if object_e == 0:
        raise SettingError(
            "no light of this head's ring passes the pupil", "Give a head, or a wider pupil, with light."
        )
    show(
        f"{chosen.title}: correlation of the detail with the truth, expected for {object_e:.0f} electrons in an object"
    )
    show(f"sample of {pitch_um:g} um; PSF averaged over the field; made within tolerances")
    show(f"{'lenses':<12}{'focal, mm':>10}{'focus, dpt':>11}{'axis':>7}{'edge':>7}{'mean':>7}{'worst':>7}")
    own = figure(chosen.optics, pitch_um, object_e, SEED)
    show(f"{'this head':<33}{_numbers(own)}")
    best: Candidate | None = None
    for found in search(chosen.optics, pitch_um, object_e, SEED, counts):
        focal_mm = found.lenses[0][2] / 1000
        show(f"{len(found.lenses):<12}{focal_mm:>10.3f}{found.focus_dpt:>11.1f}{_numbers(found.figure)}")
        if best is None or found.figure.worst > best.figure.worst:
            best = found
    assert best is not None
    gain = best.figure.worst - own.worst
    show(f"best: {len(best.lenses)} lenses, focus {best.focus_dpt:g} dpt, {gain:+.3f} beside this head")
    if layout is not None:
        write_or_raise(layout, lambda: layout.write_text(layout_csv(best.lenses), encoding="utf-8"))
        show(f"{layout}")
    return best


def _object_e(design: Design) -> float:
    """Return the mean electrons of the object in a sample: those of the frame, which is wider, in the field's disc."""
    budget = optical_budget(design)
    return budget.electrons_per_px * (budget.extent_mm / (2 * budget.half_shift_mm)) ** 2


def _numbers(found: Figure) -> str:
    return "".join(f"{number:>7.3f}" for number in found)
