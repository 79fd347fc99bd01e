"""Colours of a press by the LEDs of the ring: amber in place of red where there is no red."""

from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.config.radiometry import BeamSpec, RadiometrySpec
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.recon.colour_reconstructor import ColourReconstruction
from services.instrument.capture_pipeline import plan_pipeline
from services.instrument.press_exposure import colours_of_lamp, expose_press
from services.records.capture import OtherColour
from tests.simulated import coarse

HEADS = Path(__file__).parents[2] / "hardware" / "heads"


@pytest.mark.parametrize(
    ("head", "wanted", "taken"),
    [
        ("sim", ("red",), ("red",)),
        ("imx296", ("red", "blue"), ("red", "blue")),
        ("imx296_power", ("red",), ("amber",)),
        ("imx296_power", ("red", "amber"), ("amber",)),
        ("imx296_power", ("blue",), ("blue",)),
        ("imx296_power", (), ()),
    ],
)
def test_amber_stands_for_red_on_a_ring_without_red(
    head: str, wanted: tuple[OtherColour, ...], taken: tuple[OtherColour, ...]
) -> None:
    assert colours_of_lamp(load_head(HEADS / f"{head}.toml"), wanted) == taken


def test_a_press_of_a_ring_with_amber_gives_a_picture_in_colour(tmp_path: Path) -> None:
    """Its ring, its light measured low enough for full drive, before a simulated eye."""
    green = BeamSpec(wavelength_um=0.525, retina_mw_per_cm2=0.5, waist_mw_per_cm2=20)
    amber = BeamSpec(wavelength_um=0.59, retina_mw_per_cm2=0.2, waist_mw_per_cm2=8)
    measured = RadiometrySpec(measured="meter X, 2026-11-26", guard_factor=1.3, green=green, amber=amber)
    spec = load_head(HEADS / "imx296_power.toml")
    camera = spec.camera.model_copy(update={"backend": "sim"})
    light = spec.light.model_copy(update={"backend": "sim", "radiometry": measured})
    spec = coarse(spec.model_copy(update={"camera": camera, "light": light, "bus": None, "gpio": None}), 4)
    assert isinstance(spec.sim.peak_e, float)
    spec = spec.model_copy(update={"sim": spec.sim.model_copy(update={"peak_e": spec.sim.peak_e / 2})})  # not saturated
    clock = VirtualClock()
    head = open_head(spec, clock, MemoryLedger(clock))
    try:
        press = expose_press(head, ("OD",), clock, colours=colours_of_lamp(spec, ("red",)))
        pipeline = plan_pipeline(head, clock, tmp_path)
        assert pipeline.colours is not None
        green_steps = pipeline.reconstructor.steps(press.lit[0].counts, simulated=True)
        others = {colour: [frame.counts] for colour, frame in press.colours.items()}
        *_, made = pipeline.colours.steps(green_steps, others, simulated=True, missing=press.missing)
    finally:
        head.close()
    assert isinstance(made, ColourReconstruction)
    assert [(channel.name, channel.predicted) for channel in made.report.channels] == [
        ("green", False),
        ("amber", False),
        ("blue", True),
    ]
    assert float(made.colour[..., 0].max()) > 0
