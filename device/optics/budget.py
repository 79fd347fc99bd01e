"""The optical budget of one head: what its light path, its sensor and an eye give, in numbers, before it is built."""

from dataclasses import dataclass
from math import radians

from device.errors import SpecError
from device.optics.eye import Relay, reflex_free_mm, size_mm
from device.optics.illumination import Budget, half_period_deg, photon_budget, tried
from device.optics.light_path import LightPath, relay_of
from device.optics.matrix import chain_of, inner_ring_at_pupil_mm, ring, ring_at_pupil_mm
from device.sensors import SensorProfile
from device.spec import ChainSpec, InstrumentSpec, OpticsSpec
from device.values import Colour


@dataclass(frozen=True)
class Design:
    """What a budget is made for: a light path, a ring, a sensor's pixels, and an eye."""

    title: str
    path: LightPath
    optics: OpticsSpec
    chain: ChainSpec
    rows: int
    cols: int
    pitch_um: float
    eye_mm: float
    pupil_mm: float
    colour: Colour = "green"
    exposure_s: float = 0.1

    @property
    def relay(self) -> Relay:
        """Its relay, iris and distance."""
        return relay_of(self.path, self.optics)

    @property
    def sides_mm(self) -> tuple[float, float]:
        """(long, short) side of the light-sensitive area."""
        sides = self.cols * self.pitch_um / 1000, self.rows * self.pitch_um / 1000
        return max(sides), min(sides)


@dataclass(frozen=True)
class Side:
    """One side of the sensor: the widest field by the paper's rule, and what it catches of this one."""

    sensor_mm: float
    strict_field_deg: float
    half_caught_field_deg: float
    captured: float


@dataclass(frozen=True)
class OpticalBudget:
    """The numbers of a design; fields are full angles at the eye, `long` and `short` the sensor's sides."""

    field_deg: float
    retina_mm: float
    half_shift_mm: float
    extent_mm: float
    extent_tan_mm: float
    long: Side
    short: Side
    px_per_deg: float
    retina_um_per_px: float
    iris_at_eye_mm: float
    pupil_margin_mm: float
    filled_field_deg: float
    led_cone_deg: float
    leds: int
    ring_at_pupil_mm: float
    inner_ring_at_pupil_mm: float
    reflex_free_mm: float
    first_lens_mm: float
    splitter_mm: float
    light: Budget
    electrons_per_px: float
    half_period_deg: float
    half_period_um: float
    tried: bool


def design_of_head(path: LightPath, spec: InstrumentSpec) -> Design:
    """A head's own numbers; a ring or pupil that it does not name is the path's. SpecError for one without optics."""
    if spec.optics is None:
        raise SpecError(f"{spec.name}: no table [optics], so nothing is known of its light path")
    chain, camera, pupil_mm = chain_of(spec) or path.ring, spec.camera, spec.light.pupil_mm or path.eye.pupil_mm
    return Design(
        spec.name, path, spec.optics, chain, camera.rows, camera.cols, camera.pitch_um, path.eye.focal_mm, pupil_mm,
        spec.light.colour, camera.exposure_s,
    )  # fmt: skip


def design_of_sensor(path: LightPath, sensor: SensorProfile) -> Design:
    """The shared light path in front of a sensor at full resolution."""
    return Design(
        sensor.title, path, path.optics, path.ring, sensor.rows, sensor.cols, sensor.pitch_um,
        path.eye.focal_mm, path.eye.pupil_mm,
    )  # fmt: skip


def optical_budget(design: Design) -> OpticalBudget:
    """Every number of a design, each by its formula in `eye.py`, `matrix.py` or `illumination.py`."""
    relay, field, pitch_um = design.relay, design.optics.field_deg, design.pitch_um
    leds = len(ring(design.chain))
    light = photon_budget(design.colour, pitch_um, field, design.eye_mm, relay, leds)
    electrons = light.electrons_per_px_s * design.exposure_s
    finest_deg = half_period_deg(electrons, pitch_um)
    long, short = (_side(relay, field, side_mm) for side_mm in design.sides_mm)
    return OpticalBudget(
        field_deg=field,
        retina_mm=size_mm(field, design.eye_mm),
        half_shift_mm=relay.half_shift_mm(field),
        extent_mm=relay.extent_mm(field),
        extent_tan_mm=relay.iris_mm + 2 * relay.half_shift_tan_mm(field),
        long=long,
        short=short,
        px_per_deg=relay.px_per_deg(pitch_um),
        retina_um_per_px=relay.retina_um_per_px(pitch_um, design.eye_mm),
        iris_at_eye_mm=relay.iris_at_eye_mm,
        pupil_margin_mm=relay.pupil_margin_mm(design.pupil_mm),
        filled_field_deg=relay.filled_field_deg(design.pupil_mm),
        led_cone_deg=relay.led_cone_deg(field),
        leds=leds,
        ring_at_pupil_mm=ring_at_pupil_mm(design.chain, relay.angular_magnification),
        inner_ring_at_pupil_mm=inner_ring_at_pupil_mm(design.chain, relay.angular_magnification),
        reflex_free_mm=reflex_free_mm(field / 2),
        first_lens_mm=relay.clear_at_first_mm(field),
        splitter_mm=relay.clear_before_iris_mm(field, design.path.relay.splitter_to_iris_mm),
        light=light,
        electrons_per_px=electrons,
        half_period_deg=finest_deg,
        half_period_um=radians(finest_deg) * design.eye_mm * 1000,
        tried=tried(electrons, pitch_um),
    )


def _side(relay: Relay, field_deg: float, sensor_mm: float) -> Side:
    return Side(
        sensor_mm,
        relay.strict_field_deg(sensor_mm),
        relay.half_caught_field_deg(sensor_mm),
        relay.captured(field_deg, sensor_mm),
    )
