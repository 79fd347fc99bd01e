"""Registration of the frames of a burst: the shift of each, and which of them do not show what the others show.

Three tests, NUMERICS.md 9.1: the correlation with the central frame finds lids, closed eyes and other retinas; that
with the mean of the other frames, which has less noise, finds frames that are less sharp; a second, displaced copy of
that mean in a frame is motion of the eye during its exposure.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import hypot

import numpy as np

from device.recon.estimation.registration import Detail, Registrar, Registration, Shift
from device.values import Image

MIN_SD = 6.0  # a match by chance: the highest of 10,000 independent values lies at about 4 sd
MIN_OF_TYPICAL = 0.75  # of the better half's median correlation; a frame half covered by the lid reaches 0.5 of it
MIN_SHARPNESS = 0.965  # of the expected correlation: 0.98 or more with 8 pixels of motion blur, 0.9 to 0.96 with 15
MIN_SCATTER = 5.0  # standard deviations of the frames' correlations below their median
FEWEST = 3  # frames that show which one is blurred
MIN_COPY, MIN_COPY_SD = 0.25, 8.0  # correlation of a second copy: still eyes 0.2 and less, NUMERICS.md 9.1
MIN_COPIED = 0.5  # of the power that the others explain of a usual frame: other retinas 0.35 and less
MAX_USUAL = (
    0.99  # of a usual correlation: a jump of 1 degree 0.984; in small frames a still eye may seem to have a copy
)
OTHER = "does not show what the other frames show"
IN_PART = "shows in part only what the other frames show: a lid, or a second image over it"
LESS_SHARP = "is less sharp than the other frames: out of focus, or a second image over it"
MOVED = "shows an eye that moved during its exposure, by about {px:.0f} pixels"
NONE_MATCH = "no two frames show the same retina"


@dataclass(frozen=True)
class _Compared:
    """Detail of a frame and the mean detail of the others, in their common window, and its registration to them.

    The shift of the registration is that of the whole frame; `left_px` is the part of it that the window still has.
    """

    others: Detail
    detail: Detail
    registration: Registration
    left_px: Shift


def register_group(
    registrar: Registrar, flats: Mapping[int, Image], light: Mapping[int, float]
) -> tuple[dict[int, Shift], dict[int, str]]:
    """Return the shift of each matching frame from the first of them, and the reason of each other frame.

    `flats` are flat pictures (`Registrar.flat`) by index, `light` is the mean light of each frame in any unit. The
    centre is the frame that correlates best with all others; a frame matches if its correlation with the centre is near
    that of most frames, if it is as sharp as the others, and if the eye did not move during its exposure. Where no two
    frames match, nothing says which of them shows the retina, and the first one is kept.
    """
    indices = list(flats)
    found = _pairs(registrar, {k: registrar.detail(flat) for k, flat in flats.items()})
    centre = max(indices, key=lambda i: sum(found[i, k].correlation for k in indices if k != i))
    level = {k: found[centre, k] for k in indices if k != centre}
    least = _least_correlation(list(level.values()))
    near = {k: (0.0, 0.0) if k == centre else found[centre, k].shift_px for k in indices}
    used = [k for k in indices if k == centre or level[k].correlation >= least]
    if len(used) == 1:
        return {indices[0]: (0.0, 0.0)}, dict.fromkeys(indices[1:], NONE_MATCH)
    compared = _compared(registrar, flats, near, used)
    reasons = _less_sharp(registrar, compared, light)
    typical = float(np.median([one.registration.correlation for one in compared.values()]))
    for k in set(indices) - set(used):
        one = _compared(registrar, flats, near, [*used, k])[k]
        words = IN_PART if level[k].correlation >= MIN_SD * level[k].sd else OTHER
        reasons[k] = _reason(_moved_words(registrar, one, typical) or words, level[k].correlation, least)
    if set(used) & set(reasons):
        used = [k for k in used if k not in reasons]
        near = {k: compared[k].registration.shift_px for k in used}
        compared = _compared(registrar, flats, near, used)
    first = compared[min(used)].registration.shift_px
    shifts = {k: _difference(one.registration.shift_px, first) for k, one in compared.items()}
    return shifts, reasons


def _less_sharp(registrar: Registrar, compared: Mapping[int, _Compared], light: Mapping[int, float]) -> dict[int, str]:
    """Return the reason of each frame that is less sharp than most, by its correlation with the mean of the others, or
    that shows a moved eye.

    The expected correlation is sqrt(p / (1 + p)), p being the signal-to-noise ratio of the median frame, times the
    light of this one over the median light if it has less. Fewer than FEWEST frames do not show which one is blurred,
    and two are always kept.
    """
    if len(compared) < FEWEST:
        return {}
    found = {k: one.registration for k, one in compared.items()}
    values = np.clip([registration.correlation for registration in found.values()], 0.0, 0.999)
    typical = float(np.median(values))
    usual = float(np.median([light[k] for k in found]))
    by_chance = float(np.median([registration.sd for registration in found.values()])) * (1 - typical**2)
    scatter = max(1.4826 * float(np.median(np.abs(values - typical))), by_chance)  # 1.4826: of a normal distribution
    signal = typical**2 / (1 - typical**2)  # over the noise of the median frame
    reasons = {}
    for k, registration in found.items():
        power = signal * min(light[k] / usual, 1.0)
        expected = float(np.sqrt(power / (1 + power)))
        least = min(MIN_SHARPNESS * expected, expected - MIN_SCATTER * scatter)
        words = _moved_words(registrar, compared[k], typical)
        if words or registration.correlation < least:
            reasons[k] = _reason(words or LESS_SHARP, registration.correlation, least)
    return reasons if len(found) - len(reasons) >= 2 else {}


def _moved_words(registrar: Registrar, one: _Compared, typical: float) -> str | None:
    """Return the words for a frame that shows a second, displaced copy of the others; None without one.

    `typical` is the correlation of a usual frame with the others.
    """
    found = replace(one.registration, shift_px=one.left_px)
    if found.correlation > MAX_USUAL * typical:
        return None
    copy = registrar.register(one.others, registrar.rest(one.others, one.detail, found))
    explained = found.correlation**2 + (1 - found.correlation**2) * copy.correlation**2
    if copy.correlation < max(MIN_COPY, MIN_COPY_SD * copy.sd) or explained < MIN_COPIED * typical**2:
        return None
    return MOVED.format(px=hypot(*_difference(copy.shift_px, found.shift_px)))


def _reason(words: str, correlation: float, least: float) -> str:
    return f"{words} (correlation {correlation:.2f}, at least {least:.2f})"


def _difference(left: Shift, right: Shift) -> Shift:
    return left[0] - right[0], left[1] - right[1]


def _pairs(registrar: Registrar, details: dict[int, Detail]) -> dict[tuple[int, int], Registration]:
    """Return the registration of each picture (second index) to each other one (first index)."""
    found = {}
    for i, k in combinations(details, 2):
        found[i, k] = registration = registrar.register(details[i], details[k])
        found[k, i] = replace(registration, shift_px=(-registration.shift_px[0], -registration.shift_px[1]))
    return found


def _least_correlation(found: Sequence[Registration]) -> float:
    """Return the least correlation of a matching frame: above chance, and near the median of the better half."""
    if not found:
        return 0.0
    sd = float(np.median([registration.sd for registration in found]))
    better = sorted(registration.correlation for registration in found)[len(found) // 2 :]
    return max(MIN_SD * sd, MIN_OF_TYPICAL * float(np.median(better)) - 2 * sd)


def _compared(
    registrar: Registrar, flats: Mapping[int, Image], shifts: Mapping[int, Shift], indices: Iterable[int]
) -> dict[int, _Compared]:
    """Return the comparison of each of these pictures, moved back by its shift, with the mean of the others.

    The mean has less noise than one picture. All are windowed to the part of the retina that is on each of them: the
    window does not pull the shift towards 0, and the correlations can be compared.
    """
    moved = {k: registrar.moved_back(flats[k], shifts[k]) for k in indices}
    common = np.min([window for _, window in moved.values()], axis=0)
    details = {k: registrar.windowed(image, common) for k, (image, _) in moved.items()}
    compared = {}
    for k, detail in details.items():
        others = registrar.mean([details[i] for i in details if i != k])
        found = registrar.register(others, detail)
        row, col = found.shift_px
        whole = replace(found, shift_px=(shifts[k][0] + row, shifts[k][1] + col))
        compared[k] = _Compared(others, detail, whole, found.shift_px)
    return compared
