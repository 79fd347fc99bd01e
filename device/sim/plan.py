"""Which effects a scene calls for: each is asked for its size, and what would not be seen is left out.

The rule (optics.md 3.0): an effect that changes the reconstruction by less than a twentieth of its noise changes no
picture (|dPCC| < 0.001 in every case of that table), and is skipped. tests/physics/test_plan_proof.py proves it.
"""

import difflib
from collections.abc import Collection, Sequence
from typing import NamedTuple

from device.errors import SettingError
from device.sim.effects import EFFECTS
from device.sim.effects.effect import Effect
from device.sim.fundus import Fundus
from device.sim.sensor import SensorModel
from device.sim.setup import Scene, Setup

SEEN = 0.05


class Decision(NamedTuple):
    """Whether one effect is simulated, the number that decided, and why."""

    effect: Effect
    simulated: bool
    eta: float
    why: str

    @property
    def name(self) -> str:
        """As --only and --without call it."""
        return self.effect.name


def decide(
    scene: Scene,
    *,
    everything: bool = False,
    only: Collection[str] = (),
    without: Collection[str] = (),
    effects: Sequence[Effect] = EFFECTS,
) -> tuple[Decision, ...]:
    """Ask every effect, in the order of the light's way; nothing is rendered.

    `everything` forces all of them, `only` just those named, `without` leaves those out. SettingError for a name that
    no effect has.
    """
    _refuse_strangers([*only, *without], [effect.name for effect in effects])
    decisions = []
    for effect in effects:
        eta, why = effect.size(scene)
        chosen = everything or (effect.name in only if only else eta >= SEEN)
        decisions.append(Decision(effect, chosen and effect.name not in without, eta, why))
    return tuple(decisions)


def prepared(scene: Scene, subject: Fundus, decisions: Sequence[Decision]) -> Setup:
    """The setup of a scene and its object, with the chosen effects in it."""
    setup = Setup(scene, subject, SensorModel.ideal(scene.spec.camera))
    for decision in decisions:
        if decision.simulated:
            with setup.timed(decision.name):
                decision.effect.apply(setup)
    return setup


def table(decisions: Sequence[Decision], spent_ms: dict[str, float] | None = None) -> str:
    """The plan for people: what is simulated, the number that decided, and what it cost if it has been rendered."""
    head = f"{'effect':<14} {'':<9} {'eta':>8} {'ms':>7}  why"
    lines = [head]
    for one in decisions:
        cost = "" if spent_ms is None or not one.simulated else f"{spent_ms.get(one.name, 0.0):.0f}"
        eta = "0" if one.eta == 0 else f"{one.eta:.3g}"
        lines.append(f"{one.name:<14} {'simulated' if one.simulated else 'skipped':<9} {eta:>8} {cost:>7}  {one.why}")
    return "\n".join(lines)


def _refuse_strangers(names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"Did you mean {near[0]!r}?" if near else f"Choose from {', '.join(known)}."
            raise SettingError(f"no effect is called {name!r}", hint)
