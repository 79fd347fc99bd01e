"""Real lenses of the light path, placed as `hardware/optics.toml` has them in [layout], and the iris behind them.

The pupil lies in the front focus of the first pair of doublets, the second pair is afocally behind it, then the tilted
plate, and the iris where rays near the axis image the pupil (OPTICS.md 6). The figures of this relay, nominal and with
tolerances, are in tests/paper/relay_figures.py.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import cos, inf, radians, sin
from typing import NamedTuple

import numpy as np

from device.errors import SpecError
from device.optics.lens_data import LayoutSpec, lens_surfaces, named_glass
from device.optics.light_path import LightPath
from device.optics.ray_trace import Surface, at_plane, moved, paraxial, rays, trace

NEAR_DEG = 0.05  # field angle of the paraxial limit


class TracedRelay(NamedTuple):
    """Surfaces of the relay with the pupil's nominal place at z = 0, and the place of the iris on the axis, mm."""

    surfaces: tuple[Surface, ...]  # both pairs and the plate
    lamp_surfaces: tuple[Surface, ...]  # both pairs: the plate mirrors the light of the LEDs
    iris_at_mm: float


def traced_relay(path: LightPath) -> TracedRelay:
    """Return the relay of a light path at its wavelength; SpecError without a layout, for a missing lens or glass."""
    if path.layout is None:
        raise SpecError("the light path has no [layout]: no real lenses to trace", "Add [layout], [lens] and [glass].")
    first, second = _pairs(path, path.layout)
    first_lens = paraxial(first)
    second_lens = paraxial(second)
    first = moved(first, first_lens.front_mm)
    second = moved(second, first[-1].at_mm + first_lens.back_mm + second_lens.front_mm)
    lamp_at_mm = second[-1].at_mm + second_lens.back_mm
    plate = _plate(path, path.layout, lamp_at_mm - path.relay.splitter_to_iris_mm)
    surfaces = (*first, *second, *plate)
    return TracedRelay(surfaces, (*first, *second), _image_of_pupil(surfaces, lamp_at_mm))


def _image_of_pupil(surfaces: Sequence[Surface], near_mm: float) -> float:
    """Return the plane in which a ray near the axis through the pupil's middle meets the axial ray again, mm."""
    tilt = radians(NEAR_DEG)
    beam = trace(without_rims(surfaces), rays(np.zeros((2, 3)), np.array([[0, 0, 1], [0, sin(tilt), cos(tilt)]])))
    start = at_plane(beam, near_mm)
    slopes = beam.directions[:, 1] / beam.directions[:, 2]
    return near_mm - float((start[1, 1] - start[0, 1]) / (slopes[1] - slopes[0]))


def _pairs(path: LightPath, layout: LayoutSpec) -> tuple[tuple[Surface, ...], tuple[Surface, ...]]:
    """Return both groups of lenses, each with its first vertex at 0."""
    groups = []
    for names in (layout.first, layout.second):
        group: tuple[Surface, ...] = ()
        for name in names:
            at = group[-1].at_mm + layout.gap_mm if group else 0.0
            group += lens_surfaces(path.lens, path.glass, name, path.optics.wavelength_um, at)
        groups.append(group)
    return groups[0], groups[1]


def _plate(path: LightPath, layout: LayoutSpec, middle_mm: float) -> tuple[Surface, ...]:
    """Return the two faces of the beam splitter at 45 degrees, its middle on the axis."""
    index = named_glass(path.glass, layout.plate_glass, "the beam splitter").index(path.optics.wavelength_um)
    half = layout.plate_mm / 2 / cos(radians(45))
    clear = path.relay.splitter_mm
    return (
        Surface(middle_mm - half, inf, index, clear, 45.0, "first face of the beam splitter"),
        Surface(middle_mm + half, inf, 1.0, inf, 45.0, "second face of the beam splitter"),
    )


def without_rims(surfaces: Sequence[Surface]) -> tuple[Surface, ...]:
    """Return the surfaces without clear apertures."""
    return tuple(replace(surface, clear_mm=inf) for surface in surfaces)
