"""The tube flange: carries the lens tube, which slides in it until the eye's pupil is sharp on the iris."""

from build123d import Axis, Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed.splitter_block import tube_screws_mm
from hardware.parts.shapes import cone, joined, rod, rod_y

UP = (0.0, 0.0, -1.0)
SOCKET_MM = 10.0
WALL_MM = 4.0  # of the socket: an M3 insert fits through it
HEAD_MM = 6.4  # countersunk M3


def tube_z_mm(d: Dimensions) -> tuple[float, float]:
    """From the socket's rim to the plate on which the tube would end: no lens comes nearer to the iris."""
    return d.tube_stop_z_mm - SOCKET_MM, d.tube_stop_z_mm


def tube_flange(d: Dimensions) -> Part:
    """A plate with countersunk screws, and a socket with three clamping screws."""
    rim, floor = tube_z_mm(d)
    rear = d.block_z_mm[0]
    lens = (0, d.lens_y_mm)
    inside = d.bought.tube_mm + 2 * d.fit.slide_mm
    body = rod(inside + 2 * WALL_MM, (rim, rear), lens) - rod(inside, (rim, floor), lens)
    body -= rod(d.light_mm(floor), (floor, rear), lens)
    sunk = (HEAD_MM - d.fit.m3_mm) / 2
    for at in tube_screws_mm(d):
        body -= rod(d.fit.m3_mm, (floor, rear), at) + cone(HEAD_MM, d.fit.m3_mm, (floor, floor + sunk), at)
    clamps = rod_y(d.fit.insert_mm, (d.lens_y_mm + inside / 2 - 1, d.lens_y_mm + inside), (0, (rim + floor) / 2))
    axis = Axis((*lens, 0), (0, 0, 1))
    return body - joined(clamps.rotate(axis, turn) for turn in (0, 120, 240))
