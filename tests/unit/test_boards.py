"""Boards of gate and ring: nets of the schematic, LEDs where the head file has them, outline of the matrix."""

import itertools
import re
from dataclasses import replace
from functools import cache

import pytest

from device.config.head_file import ChainSpec, load_head
from device.optics.matrix import led_positions_mm
from hardware.gate.netlist import Pin, read
from hardware.parts.dimensions import Bought
from tests.kicad_board import Board, Pad, read_board
from tests.project_files import ROOT, text

RING_PARTS = {"U5", "R8", "C7", "C8", "C9", *(f"D{number}" for number in range(1, 9))}
WIRES = {"1": "+5V_LED", "2": "GND", "3": "DATA", "4": "CLOCK"}  # J2 of the gate board to J3 of the ring board
PLACED_MM = 0.001  # KiCad's files have micrometres


@cache
def board(name: str) -> Board:
    return read_board(name)


def wrong_pads(name: str, drawn: Board) -> set[Pin]:
    """Return the pads whose net is not that of the schematic, or of the wires between the boards."""
    nets, plug = read().nets, {"gate": "J2", "ring": "J3"}[name]
    expected = {pin: net for pin, net in nets.items() if (pin[0] in RING_PARTS) == (name == "ring")}
    expected |= {(plug, number): net for number, net in WIRES.items()}
    drawn_nets = {pin: pad.net for pin, pad in drawn.pads.items()}
    return {
        pin
        for pin in expected.keys() | drawn_nets.keys()
        if pin not in drawn_nets or pin not in expected or drawn_nets[pin] != expected[pin]
    }


@pytest.mark.parametrize("name", ["gate", "ring"])
def test_every_pad_has_the_net_of_the_schematic(name: str) -> None:
    assert len(board(name).pads) > 40
    assert wrong_pads(name, board(name)) == set()


@pytest.mark.parametrize("name", ["gate", "ring"])
def test_every_swap_of_two_pads_of_a_component_is_found(name: str) -> None:
    pads = board(name).pads
    for left, right in itertools.combinations(pads, 2):
        if left[0] == right[0] and pads[left].net != pads[right].net:
            swapped = {left: replace(pads[left], net=pads[right].net), right: replace(pads[right], net=pads[left].net)}
            assert wrong_pads(name, replace(board(name), pads=pads | swapped)), f"{left} and {right}"


def misplaced_leds(pads: dict[Pin, Pad]) -> set[str]:
    """Return the LEDs that are not at their place of the head file, on the front, with the cathode inwards."""
    sinks = load_head(ROOT / "hardware" / "heads" / "imx296_power.toml").light.sinks
    assert sinks is not None
    places, wrong = led_positions_mm(ChainSpec()), set[str]()
    leds = [place for leds in (sinks.colours["green"], sinks.colours["amber"]) for place in leds.places]
    for ref, place in zip((f"D{number}" for number in range(1, 9)), leds, strict=True):
        (x, y), cathode, anode = places[place], pads[ref, "1"], pads[ref, "2"]
        middle = [(a + b) / 2 for a, b in zip(cathode.place_mm, anode.place_mm, strict=True)]
        inwards = sum(a**2 for a in cathode.place_mm) < sum(a**2 for a in anode.place_mm)
        if middle != pytest.approx([x, y], abs=PLACED_MM) or not inwards or cathode.is_back:
            wrong.add(ref)
    return wrong


def test_leds_are_where_the_head_file_has_them() -> None:
    pads = board("ring").pads
    assert misplaced_leds(pads) == set()
    for left, right in itertools.combinations([f"D{number}" for number in range(1, 9)], 2):
        exchanged = {(left, number): pads[right, number] for number in "12"}
        assert misplaced_leds(pads | exchanged) == {left}
    turned = {("D1", "1"): pads["D1", "2"], ("D1", "2"): pads["D1", "1"]}
    assert misplaced_leds(pads | turned) == {"D1"}


def test_everything_but_the_leds_is_on_the_back() -> None:
    """The cap lies on the front; only LEDs of 1.3 x 1.7 mm fit into its pockets."""
    assert {ref for (ref, _), pad in board("ring").pads.items() if not pad.is_back} == {f"D{n}" for n in range(1, 9)}


def test_ring_board_fits_cap_and_cover_as_the_matrix_does() -> None:
    bought = Bought()
    (wide, high), (across, up), ear = bought.led_board_mm, bought.led_holes_mm, bought.led_ear_mm
    corners = {(abs(x), abs(y)) for x, y in board("ring").corners_mm}
    assert corners == {(wide / 2, high / 2), (wide / 2, round(high / 2 - ear, 4)), (high / 2, round(high / 2 - ear, 4))}
    assert len(board("ring").corners_mm) == 12
    holes = {(abs(x), abs(y), width) for x, y, width in board("ring").holes_mm}
    assert holes == {(across / 2, up / 2, 3.2)}
    assert len(board("ring").holes_mm) == 4


def test_wires_between_the_boards_are_those_of_the_document() -> None:
    rows = re.findall(r"^\| (\d) \| (\S+) \| J2 to J3 \|$", text("hardware/wiring.md"), re.M)
    assert dict(rows) == WIRES
