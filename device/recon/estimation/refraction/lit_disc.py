"""Lit disc of a frame as its linear picture shows it, for frames whose lit field is not where the calibration has it.

The steps of the field edge (`edge`) need a start within the structure of the caustic, 0.5 deg. A dark border of a small
pupil or an uneven lamp is wider. The Wiener picture of the frame, with the PSF of the M found so far and a spectrum
f^-2.5 of the detail, shows the border itself: in each direction the field ends at the outermost radius with a third of
the usual light, and a circle is fitted to these radii without those that deviate (a lid, NUMERICS.md 7.5).
It needs a field that is nearly known; `assessment/lit_disc` finds the disc of files, and says why there are two.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.refraction.crop_model import DETAIL_EXPONENT, FLATTEST, REFERENCE, detail_levels
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.field import Edge
from device.values import Image

DIRECTIONS = 64
STEP_SAMPLES = 0.5  # along each of them
INNER = 0.7  # of the calibrated radius: the disc in which the median is the usual light
LIT = 0.3  # of the usual light: a retina that is darker counts as border
CUTS_SAMPLES = (6.0, 3.0, 2.0, 2.0, 2.0)  # largest deviations from the circle of one fit and the next
MIN_SHARE = 0.25  # of the directions, on the circle

Floats = NDArray[np.float64]


def seen_disc(edges: EdgeLikelihood, eye_dpt: Floats) -> Edge | None:
    """Return the lit disc of the frame that `edges` was started with, for a rough eye; None if there is no disc.

    Its width is that of the calibrated edge. `edges` then holds the smooth part for this eye.
    """
    edges.fit_smooth(eye_dpt)
    frequencies, levels = detail_levels(edges, eye_dpt)
    logs = np.log(levels) - DETAIL_EXPONENT * np.log(frequencies / REFERENCE)
    rows, cols = edges.grid.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
    power = np.exp(logs.mean()) * (np.maximum(frequency, FLATTEST) / REFERENCE) ** DETAIL_EXPONENT
    picture = edges.picture(eye_dpt, power.astype(np.float32))
    calibrated = edges.prior.calibrated
    turns = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    radii = _radii(picture, edges.grid.centre, turns, calibrated.radius_samples, edges.prior.largest_samples)
    circle = _circle(radii, turns)
    if circle is None or circle[0] <= 0:
        return None
    radius, down, right = circle.tolist()
    return Edge(radius, down, right, calibrated.width_samples)


def _radii(picture: Image, centre: tuple[float, float], turns: Floats, usual: float, largest: float) -> Floats:
    """Return the outermost lit radius in each direction, in samples; 0 for a dark direction."""
    places = np.arange(0.0, largest, STEP_SAMPLES)
    rows = centre[0] + np.sin(turns)[:, None] * places
    cols = centre[1] + np.cos(turns)[:, None] * places
    smooth = ndimage.gaussian_filter(picture, 1.0, mode="wrap")
    light = ndimage.map_coordinates(smooth, [rows, cols], order=1, mode="grid-wrap")
    is_lit = light > LIT * np.median(light[:, places < INNER * usual])
    return np.asarray(np.max(is_lit * places, axis=1))


def _circle(radii: Floats, turns: Floats) -> Floats | None:
    """Return radius and centre (down, right) of the circle through most radii; None without one."""
    shape = np.stack([np.ones_like(turns), np.sin(turns), np.cos(turns)], axis=1)
    circle = np.array([np.median(radii), 0.0, 0.0])
    for cut in CUTS_SAMPLES:
        is_near = np.abs(radii - shape @ circle) < cut
        if is_near.mean() < MIN_SHARE:
            return None
        circle = np.linalg.lstsq(shape[is_near], radii[is_near], rcond=None)[0]
    return circle
