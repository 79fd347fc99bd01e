"""Pads, holes and outline of a KiCad board, read from the text of the .kicad_pcb file, without KiCad."""

from dataclasses import dataclass

from hardware.gate.netlist import Pin
from hardware.gate.s_expression import child, children, numbers, parse
from tests.project_files import text

MIDDLE_MM = 100.0  # of the ring board, on KiCad's sheet
Place = tuple[float, float]


@dataclass(frozen=True)
class Pad:
    """One pad: (right, up) of its middle, mm, seen from the front; net, None where open; true on the back."""

    place_mm: Place
    net: str | None
    is_back: bool


@dataclass(frozen=True)
class Board:
    """Pads by component and number, (right, up, width) of the holes without copper, corners of the outline, mm."""

    pads: dict[Pin, Pad]
    holes_mm: list[tuple[float, float, float]]
    corners_mm: list[Place]


def read_board(name: str) -> Board:
    """Return the board `gate` or `ring`; the origin is (100, 100) of KiCad's sheet, up is up.

    Footprints stand unrotated, so that a pad's place is the sum of two.
    """
    root = parse(text(f"hardware/gate/{name}.kicad_pcb"))
    pads = dict[Pin, Pad]()
    holes = list[tuple[float, float, float]]()
    for one in children(root, "footprint"):
        fields = {str(field[1]): str(field[2]) for field in children(one, "property")}
        x_mm, y_mm, *rotation = numbers(one, "at")
        assert not any(rotation), "a rotated footprint"
        for pad in children(one, "pad"):
            at = numbers(pad, "at")
            place = _place(x_mm + at[0], y_mm + at[1])
            if pad[2] == "np_thru_hole":
                holes.append((*place, numbers(pad, "size")[0]))
                continue
            net = str(child(pad, "net")[2]) if children(pad, "net") else None
            pads[fields["Reference"], str(pad[1])] = Pad(place, net, "B.Cu" in child(pad, "layers"))
    lines = [line for line in children(root, "gr_line") if child(line, "layer")[1] == "Edge.Cuts"]
    corners = [_place(*numbers(line, "start")) for line in lines]
    return Board(pads, holes, corners)


def _place(x_mm: float, y_mm: float) -> Place:
    return round(x_mm - MIDDLE_MM, 4), round(MIDDLE_MM - y_mm, 4)
