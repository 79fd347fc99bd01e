"""Optical budget of a head: the numbers that its light path, sensor and eye give, by closed formulas."""

from dataclasses import dataclass, replace
from math import pi, radians, tan

from device.config.head_file import ChainSpec, InstrumentSpec, OpticsSpec
from device.config.radiometry import BeamSpec, RadiometrySpec
from device.config.sensors import SensorProfile
from device.errors import SpecError
from device.optics import field_extent
from device.optics.eye import Relay, reflex_free_mm, size_mm
from device.optics.illumination import (
    LED,
    MEAN_OVER_PEAK,
    TRANSMISSION_TO_EYE,
    Led,
    PhotonBudget,
    half_period_deg,
    photon_budget,
    within_simulated_range,
)
from device.optics.led_cap import LedCap, axis_mw_per_sr, highest_mw_per_cm2
from device.optics.light_path import LightPath, led_cap, relay_of
from device.optics.matrix import (
    EMITTER_MM,
    Lamp,
    geometry_of,
    inner_ring_at_pupil_mm,
    lamps_of,
    ring,
    ring_at_pupil_mm,
    share_in_pupil,
)
from device.values import Colour


@dataclass(frozen=True)
class Design:
    """Input of a budget: light path, LED ring, sensor, eye (focal length and pupil), colour and exposure time.

    `radiometry` is the head file's; where it has the design's colour, `led.power_mw` is what gives the measured light.
    """

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
    led: Led = LED["green"]
    emitter_mm: float = EMITTER_MM
    read_noise_e: float = 0.0
    radiometry: RadiometrySpec | None = None

    @property
    def measured(self) -> BeamSpec | None:
        """Measured light of the ring in this colour; None if it was not measured."""
        return None if self.radiometry is None else self.radiometry.beam(self.colour)

    @property
    def share_in_pupil(self) -> float:
        """Share of the ring's light that passes the eye's pupil, 0 to 1."""
        return share_in_pupil(self.chain, self.relay.angular_magnification, self.emitter_mm, self.pupil_mm)

    @property
    def cap(self) -> LedCap:
        """Hole before each LED, as long as makes the cone of the field."""
        return led_cap(self.path, self.optics, self.emitter_mm)

    @property
    def axis_mw_per_sr(self) -> float:
        """Intensity of the whole ring on the axis behind the pupil at full drive, mW/sr."""
        ring_mw = len(ring(self.chain)) * self.led.power_mw
        return axis_mw_per_sr(ring_mw, self.relay.angular_magnification, TRANSMISSION_TO_EYE)

    @property
    def highest_mw_per_cm2(self) -> float:
        """Highest local irradiance of the retina of the light path's eye at full drive, mW/cm2."""
        return highest_mw_per_cm2(self.axis_mw_per_sr, self.path.eye.focal_mm)

    @property
    def relay(self) -> Relay:
        """Relay with this design's magnification, iris and diffuser distance."""
        return relay_of(self.path, self.optics)

    @property
    def sides_mm(self) -> tuple[float, float]:
        """(long, short) side of the light-sensitive area, mm."""
        sides = self.cols * self.pitch_um / 1000, self.rows * self.pitch_um / 1000
        return max(sides), min(sides)


@dataclass(frozen=True)
class Side:
    """One side of the sensor: length, field of which it captures all (or half) of the edge's light, captured share."""

    sensor_mm: float
    strict_field_deg: float
    half_caught_field_deg: float
    captured: float


@dataclass(frozen=True)
class OpticalBudget:
    """Numbers of a design; fields are full angles at the eye, `long` and `short` are the sensor's sides.

    Of `light`, the power at the cornea is that of the whole ring, the rest that of the share in the pupil.
    """

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
    light: PhotonBudget
    electrons_per_px: float
    half_period_deg: float
    half_period_um: float
    within_simulated_range: bool


def design_of_head(path: LightPath, spec: InstrumentSpec) -> Design:
    """Return a head's design, with ring and pupil of `path` if the head names none; SpecError without [optics]."""
    if spec.optics is None:
        raise SpecError(f"{spec.name}: no table [optics], so nothing is known of its light path")
    chain = geometry_of(spec) or path.ring
    camera = spec.camera
    pupil_mm = spec.light.pupil_mm or path.eye.pupil_mm
    colour = spec.light.colour
    lamp = (lamps_of(spec) or {}).get(colour) or Lamp(LED[colour], len(ring(chain)))
    found = Design(
        spec.name,
        path,
        spec.optics,
        chain,
        camera.rows,
        camera.cols,
        camera.pitch_um,
        path.eye.focal_mm,
        pupil_mm,
        colour,
        camera.exposure_s,
        lamp.led,
        lamp.emitter_mm,
        camera.read_noise_e,
        spec.light.radiometry,
    )
    if found.measured is None:
        return found
    times = found.measured.retina_mw_per_cm2 / found.highest_mw_per_cm2
    return replace(found, led=replace(found.led, power_mw=times * found.led.power_mw))


def lit_area_cm2(field_deg: float, eye_mm: float = 17.0) -> float:
    """Return the lit area of a retina, cm2, for a full field angle and the eye's focal length."""
    return pi * (eye_mm / 10 * tan(radians(field_deg / 2))) ** 2


def _whole_light(design: Design) -> PhotonBudget:
    """Return the photon budget of the whole ring, whatever the eye's pupil."""
    return photon_budget(
        design.colour,
        design.pitch_um,
        design.optics.field_deg,
        design.eye_mm,
        design.relay,
        len(ring(design.chain)),
        design.led,
    )


def design_of_sensor(path: LightPath, sensor: SensorProfile) -> Design:
    """Return the design of the light path `path` with a sensor profile at full resolution, green light and 0.1 s."""
    return Design(
        sensor.title,
        path,
        path.optics,
        path.ring,
        sensor.rows,
        sensor.cols,
        sensor.pitch_um,
        path.eye.focal_mm,
        path.eye.pupil_mm,
    )


def optical_budget(design: Design) -> OpticalBudget:
    """Return all numbers of a design, by the formulas in `eye.py`, `matrix.py` and `illumination.py`."""
    relay = design.relay
    field = design.optics.field_deg
    pitch_um = design.pitch_um
    whole = _whole_light(design)
    inside = design.share_in_pupil
    light = PhotonBudget(
        whole.cornea_mw, inside * whole.retina_mw_per_cm2, inside * whole.image_nw, inside * whole.electrons_per_px_s
    )
    electrons = light.electrons_per_px_s * design.exposure_s
    peak_e = electrons / MEAN_OVER_PEAK
    finest_deg = half_period_deg(peak_e, pitch_um)
    long, short = (_side(relay, field, side_mm) for side_mm in design.sides_mm)
    return OpticalBudget(
        field_deg=field,
        retina_mm=size_mm(field, design.eye_mm),
        half_shift_mm=field_extent.half_shift_mm(relay, field),
        extent_mm=field_extent.extent_mm(relay, field),
        extent_tan_mm=relay.iris_mm + 2 * field_extent.half_shift_tan_mm(relay, field),
        long=long,
        short=short,
        px_per_deg=relay.px_per_deg(pitch_um),
        retina_um_per_px=relay.retina_um_per_px(pitch_um, design.eye_mm),
        iris_at_eye_mm=relay.iris_at_eye_mm,
        pupil_margin_mm=relay.pupil_margin_mm(design.pupil_mm),
        filled_field_deg=relay.filled_field_deg(design.pupil_mm),
        led_cone_deg=relay.led_cone_deg(field),
        leds=len(ring(design.chain)),
        ring_at_pupil_mm=ring_at_pupil_mm(design.chain, relay.angular_magnification),
        inner_ring_at_pupil_mm=inner_ring_at_pupil_mm(design.chain, relay.angular_magnification),
        reflex_free_mm=reflex_free_mm(field / 2),
        first_lens_mm=relay.first_lens_aperture_mm(field),
        splitter_mm=relay.beam_before_iris_mm(field, design.path.relay.splitter_to_iris_mm),
        light=light,
        electrons_per_px=electrons,
        half_period_deg=finest_deg,
        half_period_um=radians(finest_deg) * design.eye_mm * 1000,
        within_simulated_range=within_simulated_range(peak_e, pitch_um),
    )


def _side(relay: Relay, field_deg: float, sensor_mm: float) -> Side:
    """Return the numbers of one sensor side of `sensor_mm`, with the captured share for a field of `field_deg`."""
    return Side(
        sensor_mm,
        field_extent.strict_field_deg(relay, sensor_mm),
        field_extent.half_captured_field_deg(relay, sensor_mm),
        field_extent.captured_share(relay, field_deg, sensor_mm),
    )
