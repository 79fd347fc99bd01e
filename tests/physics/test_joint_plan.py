"""Proof of the plan on 250 drawn scenes with many small effects: what is skipped together changes no picture.

Each scene has some of the effects below, each with an eta between a tenth of the threshold and the threshold: alone
none of them would be simulated. 200 scenes are drawn at random; in 50 all effects are just below the threshold, or
those on one quantity share it. Criteria: joint eta (tests/plan_filter.py) below 0.05, and a correlation with the truth
that changes by less than 0.001, of the same noise with and without the skipped effects.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.recon.assessment.metrics import pcc
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.resolution import working_bin
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.fundus import field_mask
from device.sim.plan import ETA_THRESHOLD
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts, Image
from tests import scenes
from tests.plan_filter import COARSER, Filter
from tests.simulated import SCENES, coarse, expected_electrons, exposed_counts, with_keys, world

pytestmark = pytest.mark.paper  # minutes: every scene is rendered both ways

HEADS = ("healthy", "crowded_imx296", "dim")
SEEDS, ADVERSARIAL = 200, 50
MAX_PCC_CHANGE = 1e-3


class Knob(NamedTuple):
    """Key of a scene that gives one effect its size: at `value` the effect is near the threshold, eta ~ key^power."""

    effect: str
    table: str
    key: str
    value: float
    power: float = 1.0


KNOBS = (
    Knob("refraction", "eye", "m_dpt", 0.015),
    Knob("accommodation", "eye", "accommodation_lead_dpt", 0.015),
    Knob("oblique", "eye", "oblique_dpt", 0.05),
    Knob("tear_film", "eye", "tear_film_per_s", 0.001),
    Knob("motion", "eye", "drift_deg_per_s", 1.5, 2.0),
    Knob("falloff", "light", "vignette_deg", 250.0, -2.0),
    Knob("stray", "light", "stray", 1.5e-4),
    Knob("ambient", "light", "ambient", 1.5e-4),
    Knob("dark", "sensor", "dark_e_per_s", 5.0),
    Knob("prnu", "sensor", "prnu", 4e-4),
    Knob("dsnu", "sensor", "dsnu_e", 2.0),
    Knob("nonlinearity", "sensor", "nonlinearity", 4e-4),
)
ON_ONE_QUANTITY = (("refraction", "accommodation"), ("stray", "ambient", "dark"))


@dataclass(frozen=True)
class Bench:
    """One head: its noisy frame, calibration, filter and reconstruction, which no small effect changes."""

    spec: InstrumentSpec
    filter: Filter
    make: Reconstructor
    dark: Counts
    truth: np.ndarray
    inside: np.ndarray

    def score(self, counts: Image) -> float:
        """Return the correlation of the reconstruction with the truth inside the field."""
        return pcc(self.make(counts, self.dark).picture.astype(np.float64), self.truth, self.inside)


@cache
def bench(name: str) -> Bench:
    """Return the bench of one shipped scene with pixels that are twice as wide; its tear film has been dry for 20 s."""
    spec = with_keys(coarse(load_head(SCENES / f"{name}.toml"), COARSER), eye={"since_blink_s": 20.0})
    of = world(spec)
    calibration = simulated_calibration(of)
    recipe = Recipe("evidence", working_bin(calibration.psfs[0]))
    make = Reconstructor(calibration, of.shape, scenes.PLANNER, VirtualClock(), (recipe,), refract=False)
    truth = of.truth(spec.light.colour).astype(np.float64)
    inside = field_mask(of.shape, field_radius_px(calibration))
    return Bench(spec, Filter(calibration, of), make, exposed_counts(of, lit=False), truth, inside)


def drawn(name: str, etas: dict[str, float]) -> InstrumentSpec:
    """Return the head with effects of these etas."""
    spec = bench(name).spec
    for knob in KNOBS:
        if knob.effect not in etas:
            continue
        near = with_keys(spec, **{knob.table: {knob.key: knob.value}})
        eta = next(decision.eta for decision in world(near).plan if decision.name == knob.effect)
        value = knob.value * (etas[knob.effect] / eta) ** (1 / knob.power)
        spec = with_keys(spec, **{knob.table: {knob.key: value}})
    return spec


def random_etas(seed: int) -> dict[str, float]:
    """Return etas of four to twelve effects, log-uniform from 0.005 to the threshold."""
    draw = np.random.default_rng(seed)
    chosen = draw.permutation(len(KNOBS))[: draw.integers(4, len(KNOBS) + 1)]
    return {KNOBS[place].effect: float(np.exp(draw.uniform(np.log(0.005), np.log(ETA_THRESHOLD)))) for place in chosen}


def adversarial_etas(seed: int) -> dict[str, float]:
    """Return etas that are skipped one by one: all effects at 0.042 to 0.048, or those on one quantity at a share."""
    draw = np.random.default_rng(seed)
    if seed % 2:
        return {knob.effect: float(draw.uniform(0.042, 0.048)) for knob in KNOBS}
    group = ON_ONE_QUANTITY[seed // 2 % len(ON_ONE_QUANTITY)]
    return {effect: float(draw.uniform(0.8, 0.99)) * ETA_THRESHOLD / len(group) for effect in group}


DRAWN = [(f"random-{seed}", random_etas(seed)) for seed in range(SEEDS)]
DRAWN += [(f"adversarial-{seed}", adversarial_etas(seed)) for seed in range(ADVERSARIAL)]


@pytest.mark.parametrize("number", range(len(DRAWN)), ids=[name for name, _ in DRAWN])
def test_what_is_skipped_together_changes_no_picture(number: int, record_property) -> None:
    name, etas = HEADS[number % len(HEADS)], DRAWN[number][1]
    on = bench(name)
    planned = world(drawn(name, etas))
    everything = world(planned.spec, everything=True)
    skipped = [decision.name for decision in planned.plan if not decision.simulated and decision.name in etas]
    with_plan, with_all = expected_electrons(planned), expected_electrons(everything)
    joint = on.filter.eta(with_all, with_plan)
    record_property("joint", f"{joint:.4f} skipped {len(skipped)} of {len(etas)}")
    assert joint < ETA_THRESHOLD
    counts = exposed_counts(planned).astype(np.float32)  # most changes are less than one count
    changed = counts + ((with_all - with_plan) * dn_per_electron(planned)).astype(np.float32)
    assert on.score(changed) == pytest.approx(on.score(counts), abs=MAX_PCC_CHANGE)


def dn_per_electron(of: World) -> float:
    """Return the gain of a sensor, DN per electron."""
    return 1 / of.sensor.gain_e_per_dn
