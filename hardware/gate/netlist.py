"""Netlist of a KiCad schematic whose pins carry labels: read from the text of the .kicad_sch file, without KiCad."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

SCHEMATIC = Path(__file__).with_name("gate.kicad_sch")
Node = list["str | Node"]
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
        kept, gone = self.nets[one], self.nets[other]
        if kept is None or gone is None:
            return self
        return replace(self, nets={pin: kept if net == gone else net for pin, net in self.nets.items()})

    def pins(self, ref: str) -> list[Pin]:
        """Return the pins of a component in the order of their numbers."""
        return sorted((pin for pin in self.nets if pin[0] == ref), key=lambda pin: int(pin[1]))


def read(path: Path = SCHEMATIC) -> Netlist:
    """Return the netlist of a schematic; ValueError for a pin that has neither a label nor the mark of an open pin."""
    root = _parsed(path.read_text(encoding="utf-8"))
    symbols = {str(one[1]): _pin_places(one) for one in _children(_child(root, "lib_symbols"), "symbol")}
    labels = {_place(one): str(one[1]) for one in _children(root, "global_label")}
    opened = {_place(one) for one in _children(root, "no_connect")}
    values, parts, names, nets = dict[str, str](), dict[str, str](), dict[Pin, str](), dict[Pin, str | None]()
    for one in _children(root, "symbol"):
        fields = {str(field[1]): str(field[2]) for field in _children(one, "property")}
        ref, (x, y) = fields["Reference"], _place(one)
        values[ref], parts[ref] = fields["Value"], fields["Part"]
        for number, (name, right, up) in symbols[str(_child(one, "lib_id")[1])].items():
            at = (round(x + right, 2), round(y - up, 2))
            if at not in labels and at not in opened:
                raise ValueError(f"{ref} pin {number} ({name}) has no label and is not marked as open")
            names[ref, number], nets[ref, number] = name, labels.get(at)
    return Netlist(values, parts, names, nets)


def _parsed(text: str) -> Node:
    """Return the S-expression of a text as nested lists of strings."""
    stack: list[Node] = [[]]
    for token in re.findall(r'"(?:[^"\\]|\\.)*"|[()]|[^\s()]+', text):
        if token == "(":
            stack.append([])
        elif token == ")":
            stack[-2].append(stack.pop())
        else:
            stack[-1].append(token.strip('"'))
    (root,) = stack[0]
    assert isinstance(root, list)
    return root


def _children(node: Node, name: str) -> list[Node]:
    return [one for one in node if isinstance(one, list) and one and one[0] == name]


def _child(node: Node, name: str) -> Node:
    return _children(node, name)[0]


def _place(node: Node) -> tuple[float, float]:
    _, x, y, *_rest = _child(node, "at")
    return round(float(str(x)), 2), round(float(str(y)), 2)


def _pin_places(symbol: Node) -> dict[str, tuple[str, float, float]]:
    """Return name and (right, up) of the pins of a library symbol by number, from its origin."""
    pins = [pin for unit in _children(symbol, "symbol") for pin in _children(unit, "pin")]
    return {str(_child(pin, "number")[1]): (str(_child(pin, "name")[1]), *_place(pin)) for pin in pins}
