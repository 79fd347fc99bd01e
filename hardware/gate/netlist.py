"""Netlist of a KiCad schematic whose pins carry labels: read from the text of the .kicad_sch file, without KiCad."""

from dataclasses import dataclass, replace
from pathlib import Path

from hardware.gate.s_expression import Node, child, children, parse

SCHEMATIC = Path(__file__).with_name("gate.kicad_sch")
Pin = tuple[str, str]  # reference of the component, number of the pin


@dataclass(frozen=True)
class Netlist:
    """Components with value, row of parts.csv and names of their pins, and the net of each pin, None where open."""

    values: dict[str, str]
    parts: dict[str, str]
    names: dict[Pin, str]
    nets: dict[Pin, str | None]

    def swapped(self, one: Pin, other: Pin) -> "Netlist":
        """Return the netlist with the nets of two pins exchanged."""
        return replace(self, nets={**self.nets, one: self.nets[other], other: self.nets[one]})

    def opened(self, pin: Pin) -> "Netlist":
        """Return the netlist with one pin disconnected."""
        return replace(self, nets={**self.nets, pin: None})

    def shorted(self, one: Pin, other: Pin) -> "Netlist":
        """Return the netlist with the nets of two pins joined under the name of the first; unchanged if one is open."""
        kept = self.nets[one]
        gone = self.nets[other]
        if kept is None or gone is None:
            return self
        return replace(self, nets={pin: kept if net == gone else net for pin, net in self.nets.items()})

    def pins(self, ref: str) -> list[Pin]:
        """Return the pins of a component in the order of their numbers."""
        return sorted((pin for pin in self.nets if pin[0] == ref), key=lambda pin: int(pin[1]))


def read(path: Path = SCHEMATIC) -> Netlist:
    """Return the netlist of a schematic; ValueError for a pin that has neither a label nor the mark of an open pin."""
    root = parse(path.read_text(encoding="utf-8"))
    symbols = {str(one[1]): _pin_places(one) for one in children(child(root, "lib_symbols"), "symbol")}
    labels = {_place(one): str(one[1]) for one in children(root, "global_label")}
    opened = {_place(one) for one in children(root, "no_connect")}
    values = dict[str, str]()
    parts = dict[str, str]()
    names = dict[Pin, str]()
    nets = dict[Pin, str | None]()
    for one in children(root, "symbol"):
        fields = {str(field[1]): str(field[2]) for field in children(one, "property")}
        ref = fields["Reference"]
        (x, y) = _place(one)
        values[ref], parts[ref] = fields["Value"], fields["Part"]
        for number, (name, right, up) in symbols[str(child(one, "lib_id")[1])].items():
            at = (round(x + right, 2), round(y - up, 2))
            if at not in labels and at not in opened:
                raise ValueError(f"{ref} pin {number} ({name}) has no label and is not marked as open")
            names[ref, number], nets[ref, number] = name, labels.get(at)
    return Netlist(values, parts, names, nets)


def _place(node: Node) -> tuple[float, float]:
    _, x, y, *_rest = child(node, "at")
    return round(float(str(x)), 2), round(float(str(y)), 2)


def _pin_places(symbol: Node) -> dict[str, tuple[str, float, float]]:
    """Return name and (right, up) of the pins of a library symbol by number, from its origin."""
    pins = [pin for unit in children(symbol, "symbol") for pin in children(unit, "pin")]
    return {str(child(pin, "number")[1]): (str(child(pin, "name")[1]), *_place(pin)) for pin in pins}
