"""Single failures of the gate, computed from its netlist: do the LEDs have power after the heartbeat has stopped?

The model is logical: nets are high, low or floating; resistors pull, capacitors pass edges only. It answers for a
heartbeat line that stays at a level, because the kernel hangs or the wire is cut. `unknown` means that the data sheets
do not say it, such as for a floating input.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from hardware.gate.netlist import Netlist, Pin

Light = Literal["dark", "lit", "unknown"]
GROUND, SUPPLY, LOGIC, LED_SUPPLY, HEARTBEAT = "GND", "+5V", "+3V3", "+5V_LED", "HEARTBEAT"
SWITCH, ONE_SHOT = "U1", "U2"
IN = (SWITCH, "1")
SWITCH_GROUND = (SWITCH, "2")
ENABLE = (SWITCH, "3")
OUT = (SWITCH, "6")
A = (ONE_SHOT, "1")
B = (ONE_SHOT, "2")
CLEAR = (ONE_SHOT, "3")
SHOT_GROUND = (ONE_SHOT, "4")
Q = (ONE_SHOT, "5")
CEXT = (ONE_SHOT, "6")
RCEXT = (ONE_SHOT, "7")
SHOT_SUPPLY = (ONE_SHOT, "8")
GATE = (SWITCH, ONE_SHOT, "C1", "C2", "C3", "R1", "R2", "R3", "R4", "R5", "R6", "R7")


@dataclass(frozen=True)
class Failure:
    """One failure: name, and the netlist with it, or the state that a broken chip shows whatever its pins say."""

    name: str
    netlist: Netlist
    stuck: Literal["", "switch closed", "one-shot high", "one-shot low"] = ""


def failures(netlist: Netlist, components: tuple[str, ...] = GATE) -> Iterator[Failure]:
    """Yield every pin of the gate open, every two-pin part short, every two neighbouring pins of a chip short."""
    for ref in components:
        pins = netlist.pins(ref)
        label = f"{netlist.parts[ref]} {ref}"
        if len(pins) == 2:
            yield Failure(f"{label} open", netlist.opened(pins[0]))
            yield Failure(f"{label} short", netlist.shorted(*pins))
            continue
        for pin in pins:
            if netlist.nets[pin] is not None:
                yield Failure(f"{label} {netlist.names[pin]} open", netlist.opened(pin))
        for one, other in pairwise(pins):
            if None not in (netlist.nets[one], netlist.nets[other]) and netlist.nets[one] != netlist.nets[other]:
                name = f"{label} {netlist.names[one]} to {netlist.names[other]}"
                yield Failure(name, netlist.shorted(one, other))
    yield Failure("load switch U1 closed for ever", netlist, "switch closed")
    yield Failure("one-shot U2 Q high for ever", netlist, "one-shot high")
    yield Failure("one-shot U2 Q low for ever", netlist, "one-shot low")


def table(netlist: Netlist) -> dict[str, Light]:
    """Return by failure what the LEDs do after the heartbeat has stopped, the worst of a line left high and low."""
    found = dict[str, Light]()
    for one in failures(netlist):
        seen = {after_stop(one, high) for high in (False, True)}
        found[one.name] = "lit" if "lit" in seen else "unknown" if "unknown" in seen else "dark"
    return found


def after_stop(failure: Failure, line_high: bool) -> Light:
    """Return what the LEDs do half a second after the last edge, with the line left at a level."""
    state = _State(failure, line_high)
    if state.collapsed:
        return "dark"
    if failure.stuck == "switch closed" or state.net(OUT) == state.net(IN) or state.net_has(OUT, SUPPLY):
        return "lit"
    if state.net(IN) is None or state.net(OUT) is None:
        return "dark"
    enabled = None if state.net(SWITCH_GROUND) is None else state.level(ENABLE)
    return "unknown" if enabled is None else "lit" if enabled else "dark"


class _State:
    """Levels of the nets of a failed gate after the heartbeat has stopped; None: floating, or not known."""

    def __init__(self, failure: Failure, line_high: bool) -> None:
        self._nets = failure.netlist
        self._failure = failure
        self._fixed: dict[str, bool] = {HEARTBEAT: line_high}
        self._names = self._joined()

    def _joined(self) -> dict[str, str]:
        """Return the net to which each named net belongs now: short circuits give it another name."""
        header = {
            name: self._nets.nets["J1", pin]
            for pin, name in (("1", LOGIC), ("2", SUPPLY), ("6", GROUND), ("11", HEARTBEAT))
        }
        return {name: net for name, net in header.items() if net is not None}

    @property
    def collapsed(self) -> bool:
        """Whether a supply is shorted to ground, so that nothing has power."""
        return self._names[GROUND] in (self._names[SUPPLY], self._names[LOGIC])

    def net(self, pin: Pin) -> str | None:
        """Return the net of a pin; None where it is open."""
        return self._nets.nets[pin]

    def net_has(self, pin: Pin, name: str) -> bool:
        """Return whether a pin is on the net that the header's pin of this name drives."""
        return self.net(pin) is not None and self.net(pin) == self._names.get(name)

    def level(self, pin: Pin) -> bool | None:
        """Return the level of a pin's net: driven by ground, a supply, the line or Q; else by resistors."""
        if self.net(pin) is None:
            return None
        for name, high in ((GROUND, False), (SUPPLY, True), (LOGIC, True), (HEARTBEAT, self._fixed[HEARTBEAT])):
            if self.net_has(pin, name):
                return high
        if self.net(pin) == self.net(Q) and self.net(Q) is not None and self._has_power():
            return self._q()
        return self._pulled(self.net(pin))

    def _pulled(self, net: str | None) -> bool | None:
        """Return the level to which resistors pull a net; None without one, or where they disagree."""
        levels = set()
        for ref in self._nets.parts:
            if not ref.startswith("R"):
                continue
            ends = [self._nets.nets[pin] for pin in self._nets.pins(ref)]
            if net in ends and None not in ends:
                (other,) = [end for end in ends if end != net] or [net]
                levels |= {name in (LOGIC, SUPPLY) for name, at in self._names.items() if at == other}
        return levels.pop() if len(levels) == 1 else None

    def _has_power(self) -> bool:
        return self.net_has(SHOT_SUPPLY, LOGIC) and self.net_has(SHOT_GROUND, GROUND)

    def _q(self) -> bool | None:
        """Return the one-shot's output after its time: low if cleared or if its capacitor charges, else high."""
        if self._failure.stuck:
            return self._failure.stuck == "one-shot high"
        clear = self.level(CLEAR)
        if clear is False:
            return False
        if clear is None or self.level(A) is None or self.net(B) is None or self._floats(B):
            return None
        if self.net(RCEXT) is None or self.net(CEXT) is None:
            return None
        return not (self.net_has(RCEXT, LOGIC) or self._charges())

    def _floats(self, pin: Pin) -> bool:
        """Return whether nothing drives or pulls a pin's net, so that noise may count as edges."""
        return self.level(pin) is None

    def _charges(self) -> bool:
        """Return whether the timing node rises to the threshold: a resistor to a supply, and no short to ground."""
        return not self.net_has(RCEXT, GROUND) and self._pulled(self.net(RCEXT)) is True
