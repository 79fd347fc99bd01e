"""Plan of a simulation: selection of the effects by their size eta, alone and together.

The rule (OPTICS.md 3.1): a change of the reconstruction by less than a twentieth of its noise changes no picture
(|dPCC| < 0.001 in every case of that table). The smallest effects are skipped as long as their joint eta stays below
it. Proof: tests/physics/test_plan_proof.py for the shipped scenes, tests/physics/test_joint_plan.py for random ones.
"""

import difflib
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from math import hypot
from typing import NamedTuple

from device.errors import SettingError
from device.sim.effects.effect import Effect
from device.sim.fundus import Fundus
from device.sim.installed_effects import effects_of
from device.sim.optical_setup import OpticalSetup, Scene, Size
from device.sim.sensor import SensorModel
from device.values import SimulatedEffects

ETA_THRESHOLD = 0.05
_OF_A_DIFFUSER = "the eta is a diffuser's, so simulated"  # OPTICS.md 2.9: none is measured behind lenslets


class Decision(NamedTuple):
    """Decision on one effect: simulated or not, its eta, and the text that explains the eta."""

    effect: Effect
    simulated: bool
    eta: float
    why: str

    @property
    def name(self) -> str:
        """Name of the effect, as in --only and --without."""
        return self.effect.name


def decide(
    scene: Scene,
    *,
    everything: bool = False,
    only: Collection[str] = (),
    without: Collection[str] = (),
    effects: Sequence[Effect] | None = None,
) -> tuple[Decision, ...]:
    """Return the decision on every effect, in the order of the light path; nothing is rendered.

    By default the smallest effects are skipped as long as their joint eta stays below 0.05, and the others simulated;
    behind lenslets, whose etas are not measured, only those of eta 0 are skipped.
    `everything` selects all effects, `only` just those named; `without` excludes those named in every case. `effects`:
    those to decide; None: the built-in ones, then those of plug-ins that the scene names. SettingError for
    `everything` with `only`, for a name that no effect has, or for a plug-in that fails.
    """
    if everything and only:
        raise SettingError("all effects and single ones cannot both be selected", "Give --all or --only, not both.")
    effects = effects_of(scene) if effects is None else effects
    _refuse_unknown_names([*only, *without], [effect.name for effect in effects])
    sizes = [effect.size(scene) for effect in effects]
    skipped = _negligible(sizes)
    if scene.optics.element.kind == "lenslets":
        for place in sorted(skipped):
            if sizes[place].eta > 0:
                skipped.remove(place)
                sizes[place] = sizes[place]._replace(why=f"{sizes[place].why}; {_OF_A_DIFFUSER}")
    decisions = []
    for place, (effect, size) in enumerate(zip(effects, sizes, strict=True)):
        chosen = everything or (effect.name in only if only else place not in skipped)
        decisions.append(Decision(effect, chosen and effect.name not in without, size.eta, size.why))
    return tuple(decisions)


def joint_eta(sizes: Iterable[Size]) -> float:
    """Return a bound of the joint eta of several effects.

    Effects on one quantity (`Size.shared`) change the frame in the same direction: their etas add. Changes of different
    quantities are taken as uncorrelated, so their squares add; OPTICS.md 3.1.
    """
    by_quantity: defaultdict[str, float] = defaultdict(float)
    independent = []
    for size in sizes:
        if size.shared:
            by_quantity[size.shared] += size.eta
        else:
            independent.append(size.eta)
    return hypot(*independent, *by_quantity.values())


def _negligible(sizes: Sequence[Size]) -> set[int]:
    """Return the places of the effects that together change no picture: the smallest, up to a joint eta of 0.05."""
    skipped: list[int] = []
    for place in sorted(range(len(sizes)), key=lambda place: sizes[place].eta):
        if joint_eta([sizes[other] for other in (*skipped, place)]) >= ETA_THRESHOLD:
            break  # each further one is larger
        skipped.append(place)
    return set(skipped)


def build_setup(scene: Scene, subject: Fundus, decisions: Sequence[Decision]) -> OpticalSetup:
    """Return the optical setup of a scene with `subject` as its object and the selected effects applied."""
    setup = OpticalSetup(scene, subject, SensorModel.ideal(scene.spec.camera))
    for decision in decisions:
        if decision.simulated:
            with setup.timed(decision.name):
                decision.effect.apply(setup)
    return setup


def simulated_effects(decisions: Sequence[Decision]) -> SimulatedEffects:
    """Return the names of the effects that are simulated, and the number of all."""
    return SimulatedEffects(tuple(decision.name for decision in decisions if decision.simulated), len(decisions))


def format_plan(decisions: Sequence[Decision], spent_ms: dict[str, float] | None = None) -> str:
    """Return the plan as a text table: decision, eta, reason, and with `spent_ms` the computing time of each effect."""
    head = f"{'effect':<14} {'':<9} {'eta':>8} {'ms':>7}  why"
    lines = [head]
    for decision in decisions:
        cost = "" if spent_ms is None or not decision.simulated else f"{spent_ms.get(decision.name, 0.0):.0f}"
        eta = "0" if decision.eta == 0 else f"{decision.eta:.3g}"
        lines.append(
            f"{decision.name:<14} {'simulated' if decision.simulated else 'skipped':<9} {eta:>8} {cost:>7}  "
            f"{decision.why}"
        )
    lines.append(
        f"eta: change of the picture over its noise; without --all, --only and --without, the smallest effects are "
        f"skipped up to a joint eta of {ETA_THRESHOLD:g} (1/20), and behind lenslets none that is present"
    )
    return "\n".join(lines)


def _refuse_unknown_names(names: Sequence[str], known: Sequence[str]) -> None:
    """Raise SettingError for a name that no effect has; the remedy names the closest known name, else all names."""
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"Did you mean {near[0]!r}?" if near else f"Choose from {', '.join(known)}."
            raise SettingError(f"no effect is called {name!r}", hint)
