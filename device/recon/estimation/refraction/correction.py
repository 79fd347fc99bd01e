"""Refraction corrected by the offset that trial lenses gave for the head (`device/calibration/trial_lenses.py`).

Only the report is corrected. The PSF of a frame is scaled by the refraction as it was found: the offset is in that PSF.
"""

from dataclasses import replace
from math import hypot

from device.recon.estimation.refraction.estimator import Cylinder, Refraction
from device.values import RefractionOffset


def corrected(found: Refraction, offset: RefractionOffset | None) -> Refraction:
    """Return the refraction without the head's offset, with the offset's sd added in squares; unchanged without one.

    `found` is a wavefront, y downwards, and `offset` a correcting lens, y upwards: M and J0 have opposite signs.
    """
    if offset is None:
        return found
    cylinder = found.cylinder
    if cylinder is not None:
        cylinder = Cylinder(
            cylinder.j0_dpt + offset.j0_dpt,
            hypot(cylinder.j0_sd_dpt, offset.j0_sd_dpt),
            cylinder.j45_dpt - offset.j45_dpt,
            hypot(cylinder.j45_sd_dpt, offset.j45_sd_dpt),
        )
    m_dpt = found.m_dpt + offset.m_dpt
    sd_dpt = hypot(found.sd_dpt, offset.m_sd_dpt)
    return replace(found, m_dpt=m_dpt, sd_dpt=sd_dpt, cylinder=cylinder)
