"""Notation of a refraction: eye's wavefront, power vector of the correcting lens, and sphere, cylinder and axis.

`Refraction` holds the wavefront on the sensor: x with the columns, y with the rows, positive M for myopia. The report
holds the correcting lens, for the eye as the examiner sees it: x to the right, y up in the stored picture, angles
counter-clockwise from the right (TABO). So M and J0 change their signs; J45 does not, because y does as well.

Power vector after Thibos, Wheeler and Horner (1997), with a minus cylinder C on the axis alpha and sphere S:

    M = S + C/2,    J0 = -C/2 cos 2 alpha,    J45 = -C/2 sin 2 alpha
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from device.recon.estimation.refraction.estimator import NoRefraction, Refraction
from device.values import RefractionZero

FAR_DPT, MAX_SD_DPT = 8.0, 0.5  # beyond, a refraction is uncertain
SCATTER_KEYS = ("frames", "sd_dpt", "stated_sd_dpt", "chi2")
REFRACTION_KEYS = (
    "sphere",
    "sd",
    "j0",
    "j0_sd",
    "j45",
    "j45_sd",
    "sphere_sc",
    "cylinder",
    "axis_deg",
    "field_deg",
    "field_deg_sd",
    "zero",
    "refused",
)


class SphereCylinder(NamedTuple):
    """Correcting lens: sphere and cylinder (not positive) in dpt, and its axis in degrees, above 0 and up to 180."""

    sphere_dpt: float
    cylinder_dpt: float
    axis_deg: float


def sphere_cylinder(m_dpt: float, j0_dpt: float, j45_dpt: float) -> SphereCylinder:
    """Return the minus-cylinder notation of the power vector of a correcting lens; axis 180 without a cylinder."""
    half_dpt = math.hypot(j0_dpt, j45_dpt)
    axis_deg = math.degrees(math.atan2(j45_dpt, j0_dpt)) / 2 % 180
    return SphereCylinder(m_dpt + half_dpt, -2 * half_dpt, axis_deg if axis_deg > 0 else 180.0)


def report_of(found: Refraction | NoRefraction, zero: RefractionZero = "relative") -> dict[str, float | str | None]:
    """Return `refraction_dpt` of a report: the numbers and what fixes their zero, or the reason without any.

    Without a cylinder its figures are null.
    """
    report: dict[str, float | str | None] = dict.fromkeys(REFRACTION_KEYS)
    if isinstance(found, NoRefraction):
        return report | {"refused": found.reason}
    report |= {
        "sphere": -found.m_dpt,
        "sd": found.sd_dpt,
        "field_deg": found.edge.diameter_deg,
        "field_deg_sd": found.edge.diameter_sd_deg,
        "zero": zero,
    }
    if (cylinder := found.cylinder) is not None:
        lens = sphere_cylinder(-found.m_dpt, -cylinder.j0_dpt, cylinder.j45_dpt)
        report |= {
            "j0": -cylinder.j0_dpt,
            "j0_sd": cylinder.j0_sd_dpt,
            "j45": cylinder.j45_dpt,
            "j45_sd": cylinder.j45_sd_dpt,
            "sphere_sc": lens.sphere_dpt,
            "cylinder": lens.cylinder_dpt,
            "axis_deg": lens.axis_deg,
        }
    return report


def widened(
    refraction_dpt: Mapping[str, float | str | None] | None, more_sd_dpt: float
) -> dict[str, float | str | None] | None:
    """Return `refraction_dpt` of a report with one more standard deviation in those of M, J0 and J45."""
    if refraction_dpt is None:
        return None
    sds = ((key, refraction_dpt[key]) for key in ("sd", "j0_sd", "j45_sd"))
    more = {key: math.hypot(sd, more_sd_dpt) for key, sd in sds if isinstance(sd, float)}
    return {**refraction_dpt, **more}


def doubt_of(refraction_dpt: Mapping[str, float | str | None] | None) -> tuple[str, ...]:
    """Return the message about the uncertain refraction of a report; none for a certain or unknown one."""
    sphere, sd = (None, None) if refraction_dpt is None else (refraction_dpt.get(key) for key in ("sphere", "sd"))
    if not isinstance(sphere, float) or not isinstance(sd, float) or (abs(sphere) <= FAR_DPT and sd <= MAX_SD_DPT):
        return ()
    return (f"The refraction of {sphere:+.1f} dpt (sd {sd:.2f}) is uncertain.",)


def scatter_of(found: Refraction | NoRefraction | None) -> dict[str, float] | None:
    """Return `refraction_scatter` of a report; None if the refraction is not that of at least three frames."""
    if not isinstance(found, Refraction) or found.scatter is None:
        return None
    scatter = found.scatter
    return dict(zip(SCATTER_KEYS, (scatter.count, scatter.sd_dpt, scatter.stated_sd_dpt, scatter.chi2), strict=True))
