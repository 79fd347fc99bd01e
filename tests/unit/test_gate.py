"""Schematic of the gate: every pin agrees with the documents, the bill and the code, and single failures are known."""

import itertools
import re
from functools import cache

import pytest

from device.config.head_file import OUTPUT_MA, load_head
from hardware.gate.failures import GATE, Failure, after_stop, failures, table
from hardware.gate.netlist import Netlist, Pin, read
from tests.kicad_board import read_board
from tests.project_files import ROOT, text
from tests.unit.test_hardware_documents import BUSES, HEADER, parts

HEADS = ROOT / "hardware" / "heads"
WIRED = text("hardware/wiring.md")


@cache
def netlist() -> Netlist:
    return read()


@cache
def documented() -> dict[Pin, tuple[str, str | None]]:
    """Return name and net of every pin in the tables of wiring.md; of a two-pin part without a name."""
    rows = re.findall(r"^\| (U\d+) \| (\d+) \| (\S+) \| (\S+) \|$", WIRED, re.M)
    found = {(ref, pin): (name, None if net == "open" else net) for ref, pin, name, net in rows}
    for ref, first, second in re.findall(r"^\| ([A-Z]+\d+) \| [^|]+ \| [^|]+ \| (\S+) \| (\S+) \|$", WIRED, re.M):
        found |= {(ref, "1"): ("", first), (ref, "2"): ("", second)}
    return found


def differences(drawn: Netlist) -> list[Pin]:
    """Return the pins of chips and parts that are drawn and documented differently; those of the header besides."""
    names = {pin: re.sub(r"~\{(\w+)\}", r"/\1", name) for pin, name in drawn.names.items()}
    ours = {pin: (names[pin] if len(drawn.pins(pin[0])) > 2 else "", net) for pin, net in drawn.nets.items()}
    header = {pin for pin in ours if pin[0] == "J1"}
    return [
        pin for pin in ours.keys() | documented().keys() if pin not in header and ours.get(pin) != documented().get(pin)
    ] + wrong_header(drawn)


def wrong_header(drawn: Netlist) -> list[Pin]:
    """Return the pins of the computer's header whose line or net is not that of the code and the head file."""
    gpio = load_head(HEADS / "imx296_power.toml").gpio
    assert gpio is not None
    nets = {
        "3.3 V": "+3V3",
        "5 V": "+5V",
        "ground": "GND",
        f"GPIO{gpio.heartbeat}": "HEARTBEAT",
        f"GPIO{gpio.button}": "BUTTON",
    } | {line: signal for signal, (line, _) in BUSES.items()}
    return [pin for pin in drawn.pins("J1") if drawn.nets[pin] != nets[HEADER[int(pin[1])]]]


def test_every_pin_is_drawn_as_documented() -> None:
    assert len(netlist().nets) > 100
    assert differences(netlist()) == []


def test_every_swap_of_two_pins_of_a_component_is_found() -> None:
    drawn, tried = netlist(), 0
    for ref in drawn.parts:
        for left, right in itertools.combinations(drawn.pins(ref), 2):
            if drawn.nets[left] != drawn.nets[right]:
                tried += 1
                assert differences(drawn.swapped(left, right)), f"{left} and {right} swapped"
    assert tried > 300


def test_parts_and_quantities_are_those_of_the_bill() -> None:
    drawn = netlist()
    for part in set(drawn.parts.values()):
        count = sum(other == part for other in drawn.parts.values())
        assert int(parts()[part]["quantity"]) == count, part
    for ref, value in drawn.values.items():
        row = parts()[drawn.parts[ref]]
        if ref[0] in "RC":
            written = re.sub(r"(\d)([kun])(\d)", r"\1.\3\2", value)  # 2u2 is 2.2u
            number, unit = re.fullmatch(r"([\d.]+)([kpnu]?)", written).groups()  # type: ignore[union-attr]
            unit = {"k": "k", "": "ohm", "p": "pF", "n": "nF", "u": "uF"}[unit]
            assert f"{number} {unit}" in row["what_for"], ref


def test_outputs_of_the_led_driver_are_those_of_the_head_file() -> None:
    sinks = load_head(HEADS / "imx296_power.toml").light.sinks
    assert sinks is not None
    by_name = {netlist().names[pin]: netlist().nets[pin] for pin in netlist().pins("U5")}
    for colour, leds in sinks.colours.items():
        for number, outputs in enumerate(leds.outputs, 1):
            for output in outputs:
                assert by_name[f"OUT{'RGB'[output % 3]}{output // 3}"] == f"{colour.upper()}{number}"
        assert ", ".join(map(str, leds.places)) in WIRED, colour
    r8 = netlist().values["R8"]
    output_ma = 41 * 1.21 / float(r8) * 1000
    assert output_ma <= sinks.output_ma <= 1.05 * output_ma <= OUTPUT_MA, "no current is counted short"
    assert f"1.21 V x 41 / {r8} ohm = {output_ma:.1f} mA" in WIRED
    assert f"**current resistor** of {r8} ohm over the permitted share" in text("hardware/assembly.md")
    assert netlist().values["R6"] == "43k2"
    assert sinks.most_ma < 544, "least limit of the load switch with 43.2 k, SLVS841E table 1"


def test_address_of_the_memory_is_that_of_the_head_file() -> None:
    bus = load_head(HEADS / "imx296_power.toml").bus
    assert bus is not None
    address = sum((netlist().nets["U4", pin] != "GND") << bit for bit, pin in enumerate("123"))
    assert bus.memory == 0x50 + address
    assert netlist().nets["U4", "7"] == "GND", "a write-protected memory takes no calibration"


def test_the_sound_gate_is_dark_when_the_heartbeat_stops() -> None:
    for high in (False, True):
        assert after_stop(Failure("none", netlist()), high) == "dark"


def test_failures_that_do_not_leave_the_leds_dark_are_those_of_the_document() -> None:
    found = {re.sub(r"~\{(\w+)\}", r"/\1", name): light for name, light in table(netlist()).items()}
    words = text("hardware/dead-man.md")
    listed = dict(re.findall(r"^\| ([^|]+) \| (lit|unknown) \|$", words, re.M))
    assert listed == {name: light for name, light in found.items() if light != "dark"}
    numbers = re.search(r"for ever: (\d+) failures.*?(\d+) leave the LEDs dark", words, re.S)
    assert numbers is not None
    assert [int(number) for number in numbers.groups()] == [len(found), len(found) - len(listed)]


def ohms(drawn: Netlist, left: str, right: str) -> list[str]:
    """Return the values of the resistors between two nets."""
    ends = {ref: {drawn.nets[ref, "1"], drawn.nets[ref, "2"]} for ref in drawn.values if ref[0] == "R"}
    return [drawn.values[ref] for ref, nets in ends.items() if nets == {left, right}]


def reached(drawn: Netlist, net: str) -> set[str | None]:
    """Return the nets to which resistors lead from a net."""
    nets = {net}
    while (
        more := {
            other
            for ref in drawn.values
            if ref[0] == "R"
            for here, other in itertools.permutations((drawn.nets[ref, "1"], drawn.nets[ref, "2"]))
            if here in nets
        }
        - nets
    ):
        nets |= more
    return nets


def test_resistances_of_the_check_before_the_computer_are_those_of_the_schematic() -> None:
    """Between supplies and ground no resistor conducts; heartbeat and gated supply have one to ground each."""
    rows = re.findall(r"^\| (J\d) (\d+) and (\d+) \| (\S+), (\S+) \| ([^|,]+)", text("hardware/assembly.md"), re.M)
    assert len(rows) == 5
    pads, drawn = read_board("gate").pads, netlist()
    for plug, left, right, first, second, shown in rows:
        assert (pads[plug, left].net, pads[plug, right].net) == (first, second)
        if shown.startswith("above"):
            assert second not in reached(drawn, first), f"{first} to {second}"
        else:
            assert ohms(drawn, first, second) == [shown.replace(" ", "").strip()]
    along = sorted((pad.place_mm[1], pad.net) for (ref, _), pad in pads.items() if ref == "J1")
    for (_, before), (_, after) in itertools.pairwise(along):
        assert before is not None
        assert after not in reached(drawn, before), "the other neighbours"


def test_every_component_of_the_gate_fails_in_the_table() -> None:
    names = [failure.name for failure in failures(netlist())]
    assert len(names) == len(set(names)) > 40
    assert all(any(f" {ref} " in f"{name} " for name in names) for ref in GATE)


@pytest.mark.parametrize(
    ("pin", "net"),
    [(("U1", "3"), "+3V3"), (("U1", "6"), "+5V"), (("U2", "7"), "GND"), (("R4", "2"), "GND"), (("R3", "2"), "+3V3")],
)
def test_a_wrong_drawing_is_not_dark(pin: Pin, net: str) -> None:
    """Enable at a supply, output at the input, timing node at ground, a pull-up instead of the timing charge."""
    wrong = Netlist(netlist().values, netlist().parts, netlist().names, {**netlist().nets, pin: net})
    if pin == ("R3", "2"):  # alone it changes nothing: the one-shot drives the net
        wrong = wrong.opened(("U2", "5"))
    assert after_stop(Failure("drawn so", wrong), False) != "dark"
