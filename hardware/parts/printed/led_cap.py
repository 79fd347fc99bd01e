"""The LED cap: one hole for each LED of the ring, as long as makes the cone of the field; all others see a wall."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import box, joined, rod_y

UP = (0.0, 1.0, 0.0)
COLLAR_MM = 0.6  # how far the baffles between the LEDs reach down towards their board


def outline_mm(d: Dimensions) -> tuple[tuple[float, float], tuple[float, float]]:
    """(x, z) ranges of cap and cover: the board and a wall around it."""
    (x, z) = d.led_board_at_mm
    (wide, high) = d.bought.led_board_mm
    more = d.fit.slide_mm + d.fit.wall_mm
    return (x - wide / 2 - more, x + wide / 2 + more), (z - high / 2 - more, z + high / 2 + more)


def led_cap(d: Dimensions) -> Part:
    """The ears of the board lie on it, so the LEDs stand at their distance whatever the cover does."""
    part = d.bought
    fit = d.fit
    front = d.cap_front_y_mm
    board = d.led_y_mm + part.led_high_mm
    (x0, x1), (z0, z1) = outline_mm(d)
    (x, z) = d.led_board_at_mm
    (wide, high) = part.led_board_mm
    body = box((x0, x1), (front, board + part.led_board_thick_mm), (z0, z1))
    half = wide / 2 + fit.slide_mm, high / 2 + fit.slide_mm
    body -= box((x - half[0], x + half[0]), (board, board + 9), (z - half[1], z + half[1]))
    inner = high / 2 + fit.slide_mm  # the matrix itself is as wide as it is high
    field = d.led_y_mm - fit.press_mm
    body -= box((x - inner, x + inner), (field, board), (z - inner, z + inner))
    body += joined(_collar(d, at, field) for at in d.ring_places_mm)
    body -= joined(_pocket(d, at, field) for at in d.ring_places_mm)
    body -= joined(rod_y(d.led_hole_mm, (front, board), at) for at in d.ring_places_mm)
    body -= rod_y(part.film_mm + fit.slide_mm, (front, d.cap_end_y_mm), (0, d.plate_z_mm))
    return body - joined(rod_y(fit.m3_mm, (front, board), at) for at in d.led_screws_mm)


def _collar(d: Dimensions, at: tuple[float, float], field: float) -> Part:
    half = d.bought.led_mm / 2 + d.fit.slide_mm + d.fit.baffle_mm
    return _around(at, half, (field, field + COLLAR_MM))


def _pocket(d: Dimensions, at: tuple[float, float], field: float) -> Part:
    return _around(at, d.bought.led_mm / 2 + d.fit.slide_mm, (field, field + COLLAR_MM))


def _around(at: tuple[float, float], half: float, y: tuple[float, float]) -> Part:
    return box((at[0] - half, at[0] + half), y, (at[1] - half, at[1] + half))
