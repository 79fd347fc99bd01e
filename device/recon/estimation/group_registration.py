"""Registration of the frames of a burst: the shift of each, and which of them do not show what the others show.

Two tests, NUMERICS.md 9.1: the correlation with the central frame finds lids, closed eyes and other retinas; that with
the mean of the other frames, which has less noise, finds motion blur.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from device.recon.estimation.registration import Detail, Registrar, Registration, Shift
from device.values import Image

MIN_SD = 6.0  # a match by chance: the highest of 10,000 independent values lies at about 4 sd
MIN_OF_TYPICAL = 0.75  # of the better half's median correlation; a frame half covered by the lid reaches 0.5 of it
MIN_SHARPNESS = 0.965  # of the expected correlation: 0.98 or more with 8 pixels of motion blur, 0.9 to 0.96 with 15
MIN_SCATTER = 5.0  # standard deviations of the frames' correlations below their median
FEWEST = 3  # frames that show which one is blurred


def register_group(
    registrar: Registrar, flats: Mapping[int, Image], light: Mapping[int, float]
) -> tuple[dict[int, Shift], dict[int, str]]:
    """Return the shift of each matching frame from the first of them, and the reason of each other frame.

    `flats` are flat pictures (`Registrar.flat`) by index, `light` is the mean light of each frame in any unit. The
    centre is the frame that correlates best with all others; a frame matches if its correlation with the centre is near
    that of most frames, and if it is as sharp as the others. Where no two frames match, nothing says which of them
    shows the retina, and the first one is kept.
    """
    indices = list(flats)
    found = _pairs(registrar, {k: registrar.detail(flat) for k, flat in flats.items()})
    centre = max(indices, key=lambda i: sum(found[i, k].correlation for k in indices if k != i))
    level = {k: found[centre, k].correlation for k in indices if k != centre}
    least = _least_correlation([found[centre, k] for k in level])
    used = [k for k in indices if k == centre or level[k] >= least]
    if len(used) == 1:
        return {indices[0]: (0.0, 0.0)}, dict.fromkeys(indices[1:], "no two frames show the same retina")
    reasons = {
        k: f"does not show what the other frames show (correlation {level[k]:.2f}, at least {least:.2f})"
        for k in indices
        if k not in used
    }
    near = {k: (0.0, 0.0) if k == centre else found[centre, k].shift_px for k in used}
    refined = _refined(registrar, {k: flats[k] for k in used}, near)
    if blurred := _blurred(refined, light):
        reasons |= blurred
        near = {k: registration.shift_px for k, registration in refined.items() if k not in blurred}
        refined = _refined(registrar, {k: flats[k] for k in near}, near)
    first = refined[min(refined)].shift_px
    shifts = {
        k: (registration.shift_px[0] - first[0], registration.shift_px[1] - first[1])
        for k, registration in refined.items()
    }
    return shifts, reasons


def _blurred(found: Mapping[int, Registration], light: Mapping[int, float]) -> dict[int, str]:
    """Return the reason of each frame that is less sharp than most, by its correlation with the mean of the others.

    The expected correlation is sqrt(p / (1 + p)), p being the signal-to-noise ratio of the median frame, times the
    light of this one over the median light if it has less. Fewer than FEWEST frames do not show which one is blurred,
    and two are always kept.
    """
    if len(found) < FEWEST:
        return {}
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
        if registration.correlation < least:
            reasons[k] = f"is blurred by motion (correlation {registration.correlation:.2f}, at least {least:.2f})"
    return reasons if len(found) - len(reasons) >= 2 else {}


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


def _refined(registrar: Registrar, flats: Mapping[int, Image], shifts: Mapping[int, Shift]) -> dict[int, Registration]:
    """Return shift and correlation of each picture after its registration, moved back, to the mean of the others.

    The mean has less noise than one picture. All are windowed to the part of the retina that is on each of them: the
    window does not pull the shift towards 0, and the correlations can be compared.
    """
    moved = {k: registrar.moved_back(flat, shifts[k]) for k, flat in flats.items()}
    common = np.min([window for _, window in moved.values()], axis=0)
    details = {k: registrar.windowed(image, common) for k, (image, _) in moved.items()}
    refined = {}
    for k, detail in details.items():
        found = registrar.register(registrar.mean([details[i] for i in details if i != k]), detail)
        row, col = found.shift_px
        refined[k] = replace(found, shift_px=(shifts[k][0] + row, shifts[k][1] + col))
    return refined
