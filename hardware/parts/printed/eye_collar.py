"""The eye collar: holds the model eye, or a card for the meter, before the lens tubes, where the eye's pupil belongs.

In the eye's own coordinates, drawn where the model eye lies in it; the lens tubes come from the right.
"""

from build123d import Axis, Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed import model_eye_tube
from hardware.parts.shapes import cone, joined, rod, rod_y

UP = (0.0, 0.0, -1.0)
CARD_MM = 35.0  # a disc of card or paper, which falls onto the shoulder in the pupil's plane
GRIP_MM = 14.0  # behind the pupil: 18 mm of a meter still see the whole light there
SOCKET_MM = 20.0  # over the lens tubes, whose end is 17.6 to 24.1 mm from the pupil
WALL_MM = 4.0  # an M3 insert fits through it
SCREWS_FROM_END_MM = 4.0
SEAT_MM = 1.2  # of the cone, beyond the eye's face
SLOPE = 0.5  # of the cone's radius: the rim of the eye's face is centred on it, and can still be tilted


def opening_mm(d: Dimensions) -> float:
    """Narrowest width, at the end of the seat: no light of the field touches it."""
    return model_eye_tube.WIDE_MM - 2 * SLOPE * SEAT_MM


def socket_z_mm(d: Dimensions) -> tuple[float, float]:
    """Where the bore for the lens tubes begins, and its rim; the cone before it is of 45 degrees for the printer."""
    wide = d.bought.tube_mm + 2 * d.fit.slide_mm
    begin = model_eye_tube.face_z_mm(d) + SEAT_MM + (wide - opening_mm(d)) / 2
    return begin, begin + SOCKET_MM


def eye_collar(d: Dimensions) -> Part:
    """Two sockets with three M3 grub screws each: those of the tubes clamp, those of the eye also tilt it."""
    pupil = model_eye_tube.pupil_z_mm(d)
    face = model_eye_tube.face_z_mm(d)
    socket, rim = socket_z_mm(d)
    card = CARD_MM + d.fit.slide_mm
    tube = d.bought.tube_mm + 2 * d.fit.slide_mm
    narrow = card + 2 * WALL_MM
    wide = tube + 2 * WALL_MM
    rear = pupil - GRIP_MM
    seat = face + SEAT_MM
    flare = seat + (wide - narrow) / 2
    body = rod(narrow, (rear, seat)) + cone(narrow, wide, (seat, flare)) + rod(wide, (flare, rim))
    body -= rod(card, (rear, pupil))
    body -= cone(model_eye_tube.WIDE_MM + 2 * SLOPE * (face - pupil), opening_mm(d), (pupil, seat))
    body -= cone(opening_mm(d), tube, (seat, socket)) + rod(tube, (socket, rim))
    clamps = [_screw(d, card, rear + SCREWS_FROM_END_MM), _screw(d, tube, rim - SCREWS_FROM_END_MM)]
    return body - joined(one.rotate(Axis.Z, turn) for one in clamps for turn in (0, 120, 240))


def _screw(d: Dimensions, inside_mm: float, z_mm: float) -> Part:
    return rod_y(d.fit.insert_mm, (inside_mm / 2 - 1, inside_mm / 2 + 2 * WALL_MM), (0, z_mm))
