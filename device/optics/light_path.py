"""The light path as a file, `hardware/optics.toml`: the one truth that heads, the simulator and drawings share."""

from math import inf, isclose, radians, tan
from pathlib import Path

from pydantic import Field, model_validator

from device.optics.eye import Relay
from device.spec import ChainSpec, OpticsSpec
from device.tables import Table, load_toml

Place = tuple[float, float]


class RelaySpec(Table):
    """The two lens groups and the plate that lets the LEDs' light in between them and the diffuser."""

    first_mm: float = Field(gt=0)
    second_mm: float = Field(gt=0)
    lens_mm: float = Field(gt=0)
    splitter_mm: float = Field(gt=0)
    splitter_to_iris_mm: float = Field(gt=0)


class EyeSpec(Table):
    """The eye that is looked into, if nobody says another one: its focal length and its pupil."""

    focal_mm: float = Field(ge=5, le=35)
    pupil_mm: float = Field(gt=0, le=10)


class LightPath(Table):
    """Everything between the eye and the sensor, and the ring of LEDs."""

    name: str = Field(min_length=1)
    optics: OpticsSpec
    relay: RelaySpec
    ring: ChainSpec
    eye: EyeSpec

    @model_validator(mode="after")
    def _one_magnification(self) -> "LightPath":
        said, lenses = self.optics.angular_magnification, self.relay.first_mm / self.relay.second_mm
        if not isclose(said, lenses, rel_tol=1e-6):
            raise ValueError(f"optics.angular_magnification = {said:g}, but the relay's lenses give {lenses:g}")
        if self.relay.splitter_to_iris_mm >= self.relay.second_mm:
            raise ValueError("relay.splitter_to_iris_mm: the plate stands between the second lens and the iris")
        return self


def load_light_path(path: Path) -> LightPath:
    """Read `hardware/optics.toml`, or another file like it; SpecError names the line of a mistake."""
    return load_toml(path, LightPath)


def relay_of(path: LightPath, optics: OpticsSpec) -> Relay:
    """The relay of a head: the path's first lens, and the second that gives the head's own magnification."""
    return Relay(
        first_mm=path.relay.first_mm,
        second_mm=path.relay.first_mm / optics.angular_magnification,
        iris_mm=optics.iris_um / 1000,
        diffuser_to_sensor_mm=optics.diffuser_to_sensor_um / 1000,
    )


def planes_mm(relay: Relay) -> tuple[float, float, float, float]:
    """Where first lens, second lens, iris and sensor stand on the axis, counted from the eye's pupil."""
    second = 2 * relay.first_mm + relay.second_mm
    iris = second + relay.second_mm
    return relay.first_mm, second, iris, iris + relay.diffuser_to_sensor_mm


def ray_mm(relay: Relay, eye_mm: float, height_mm: float, angle_deg: float) -> list[Place]:
    """(along, off the axis) of a ray from the retina to the sensor, through ideal thin lenses and no diffuser.

    It leaves the pupil at `height_mm`, at `angle_deg` to the axis.
    """
    slope, planes = tan(radians(angle_deg)), planes_mm(relay)
    at, places = 0.0, [(-eye_mm, -eye_mm * slope), (0.0, height_mm)]
    for plane, focal_mm in zip(planes, (relay.first_mm, relay.second_mm, inf, inf), strict=True):
        height_mm += slope * (plane - at)
        slope, at = slope - height_mm / focal_mm, plane
        places.append((plane, height_mm))
    return places


def led_ray_mm(path: LightPath, relay: Relay, led_mm: float, angle_deg: float) -> list[Place]:
    """A ray of an LED `led_mm` off the ring's axis: up to the plate, back through both lenses, into the pupil.

    The ring stands as far beside the axis as the iris stands behind the plate: the plate mirrors one into the other.
    """
    first, second, iris, _ = planes_mm(relay)
    plate, slope = iris - path.relay.splitter_to_iris_mm, tan(radians(angle_deg))
    along = (iris - plate - led_mm) / (1 - slope)  # from the iris to the plate, where height = place - plate
    met = (iris - along, led_mm - slope * along)
    at_second = led_mm - slope * relay.second_mm
    back = led_mm / relay.second_mm  # all rays of one LED are parallel between the lenses
    at_first = at_second - back * (second - first)
    return [
        (plate + led_mm, path.relay.splitter_to_iris_mm), met, (second, at_second), (first, at_first),
        (0.0, -led_mm / relay.pupil_magnification),
    ]  # fmt: skip
