"""Light path of the instrument, `hardware/optics.toml`: the single source for heads, simulator and drawings."""

from math import inf, isclose, radians, tan
from pathlib import Path

from pydantic import Field, model_validator

from device.config.head_file import ChainSpec, OpticsSpec
from device.config.toml_file import Table, load_toml
from device.optics.eye import Relay
from device.optics.glass import Glass
from device.optics.led_cap import LedCap, cap_height_mm
from device.optics.lens_data import LayoutSpec, LensSpec

Place = tuple[float, float]


class RelaySpec(Table):
    """Relay: focal lengths and diameter of its two lens groups; diameter and place of the LEDs' beam splitter."""

    first_mm: float = Field(gt=0)
    second_mm: float = Field(gt=0)
    lens_mm: float = Field(gt=0)
    splitter_mm: float = Field(gt=0)
    splitter_to_iris_mm: float = Field(gt=0)


class EyeSpec(Table):
    """Default eye: focal length, and diameter of the pupil."""

    focal_mm: float = Field(ge=5, le=35)
    pupil_mm: float = Field(gt=0, le=10)


class CapSpec(Table):
    """Cap of the LEDs: width of the hole before each; its length follows from the field."""

    hole_mm: float = Field(gt=0, le=20)


class LightPath(Table):
    """Components from the eye to the sensor, and the ring of LEDs with its cap.

    `layout`, `lens` and `glass` are the real lenses of the ray trace (`traced_relay.py`); a file may leave them out.
    """

    name: str = Field(min_length=1)
    optics: OpticsSpec
    relay: RelaySpec
    ring: ChainSpec
    cap: CapSpec
    eye: EyeSpec
    layout: LayoutSpec | None = None
    lens: dict[str, LensSpec] = Field(default_factory=dict)
    glass: dict[str, Glass] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_magnification(self) -> "LightPath":
        """Raise ValueError if the magnification is not first_mm / second_mm, or the splitter not behind the lenses."""
        stated = self.optics.angular_magnification
        lenses = self.relay.first_mm / self.relay.second_mm
        if not isclose(stated, lenses, rel_tol=1e-6):
            raise ValueError(f"optics.angular_magnification = {stated:g}, but the relay's lenses give {lenses:g}")
        if self.relay.splitter_to_iris_mm >= self.relay.second_mm:
            raise ValueError("relay.splitter_to_iris_mm: the plate stands between the second lens and the iris")
        return self


def load_light_path(path: Path) -> LightPath:
    """Return the light path in `hardware/optics.toml` or a file like it; SpecError names the line of an error."""
    return load_toml(path, LightPath)


def relay_of(path: LightPath, optics: OpticsSpec) -> Relay:
    """Return the relay of a head: the path's first lens, and the second lens that gives the head's magnification."""
    return Relay(
        first_mm=path.relay.first_mm,
        second_mm=path.relay.first_mm / optics.angular_magnification,
        iris_mm=optics.iris_um / 1000,
        diffuser_to_sensor_mm=optics.diffuser_to_sensor_um / 1000,
    )


def led_cap(path: LightPath, optics: OpticsSpec, emitter_mm: float) -> LedCap:
    """Return the hole before an LED with a die of that width, as long as makes the cone of the head's field."""
    hole_mm = path.cap.hole_mm
    half_deg = relay_of(path, optics).led_cone_deg(optics.field_deg) / 2
    return LedCap(hole_mm, cap_height_mm(hole_mm, half_deg), emitter_mm)


def planes_mm(relay: Relay) -> tuple[float, float, float, float]:
    """Return the positions of first lens, second lens, iris and sensor on the axis, from the eye's pupil, mm."""
    second = 2 * relay.first_mm + relay.second_mm
    iris = second + relay.second_mm
    return relay.first_mm, second, iris, iris + relay.diffuser_to_sensor_mm


def ray_mm(relay: Relay, eye_mm: float, height_mm: float, angle_deg: float) -> list[Place]:
    """Return the points (along the axis, off the axis), mm, of a ray from retina to sensor, without diffuser.

    The points are on retina, pupil (0, `height_mm`), both ideal thin lenses, iris and sensor. The ray leaves the pupil
    at `angle_deg` to the axis.
    """
    slope = tan(radians(angle_deg))
    planes = planes_mm(relay)
    at = 0.0
    places = [(-eye_mm, -eye_mm * slope), (0.0, height_mm)]
    for plane, focal_mm in zip(planes, (relay.first_mm, relay.second_mm, inf, inf), strict=True):
        height_mm += slope * (plane - at)
        slope = slope - height_mm / focal_mm
        at = plane
        places.append((plane, height_mm))
    return places


def led_ray_mm(path: LightPath, relay: Relay, led_mm: float, angle_deg: float) -> list[Place]:
    """Return the points (along the axis, off the axis), mm, of a ray of an LED: LED, splitter, both lenses, pupil.

    The LED is `led_mm` off the ring's axis and the ray at `angle_deg` to it. The ring is as far beside the axis as the
    iris is behind the splitter, which mirrors one into the other.
    """
    first, second, iris, _ = planes_mm(relay)
    plate = iris - path.relay.splitter_to_iris_mm
    slope = tan(radians(angle_deg))
    along = (iris - plate - led_mm) / (1 - slope)  # from the iris to the plate, where height = place - plate
    met = (iris - along, led_mm - slope * along)
    at_second = led_mm - slope * relay.second_mm
    back = led_mm / relay.second_mm  # all rays of one LED are parallel between the lenses
    at_first = at_second - back * (second - first)
    return [
        (plate + led_mm, path.relay.splitter_to_iris_mm),
        met,
        (second, at_second),
        (first, at_first),
        (0.0, -led_mm / relay.pupil_magnification),
    ]
