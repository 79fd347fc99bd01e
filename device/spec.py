"""One TOML file describes one head; this turns it into a checked, frozen value or says which line is wrong."""

import difflib
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from device.errors import SpecError
from device.scene import SimSpec
from device.sensors import SENSORS
from device.tables import Table, load_toml
from device.values import Colour, Geometry

_NAMES = f"known are {', '.join(sorted(SENSORS))}"


class CameraSpec(Table):
    """The sensor: which driver answers for it, its pixels, and what its counts mean.

    `sensor` names a profile of `device/sensors.py`, which fills in what this table does not say itself.
    """

    backend: Literal["sim", "replay"]
    sensor: str | None = None
    rows: int = Field(ge=1, le=8192)
    cols: int = Field(ge=1, le=8192)
    pitch_um: float = Field(gt=0, le=100)
    bit_depth: int = Field(default=12, ge=8, le=16)
    black_dn: float = Field(default=64.0, ge=0)
    full_well_e: float = Field(gt=0)
    read_noise_e: float = Field(ge=0)
    exposure_s: float = Field(default=0.1, gt=0, le=10)
    preview_exposure_s: float = Field(default=0.05, gt=0, le=10)

    @model_validator(mode="before")
    @classmethod
    def _what_the_profile_says(cls, said: dict[str, Any]) -> dict[str, Any]:
        name = said.get("sensor")
        if name is None:
            return said
        if name not in SENSORS:
            near = difflib.get_close_matches(str(name), SENSORS, n=1)
            raise ValueError(f"no sensor is called {name!r}; " + (f"did you mean {near[0]!r}?" if near else _NAMES))
        return {key: value for key, value in SENSORS[name]._asdict().items() if key in cls.model_fields} | said

    @property
    def white_dn(self) -> int:
        """The count at which the converter ends."""
        return int(2**self.bit_depth) - 1

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per count, when a full well reaches the converter's end."""
        return self.full_well_e / (self.white_dn - self.black_dn)


class LightSpec(Table):
    """The LED ring: which driver answers for it, its colours, its place on the board, how long it may shine.

    The ring is that of `ring_mm`, or the widest that passes a pupil of `pupil_mm` through the relay.
    `led_output` says how bright each LED of the board is beside the others: the driver evens them out.
    """

    backend: Literal["sim", "replay", "apa102"]
    colour: Literal["red", "green", "blue"] = "green"
    preview_colour: Literal["red", "green"] = "red"
    max_on_s: float = Field(default=1.0, gt=0, le=30)
    spi_device: str = "/dev/spidev0.0"
    rows: int = Field(default=8, ge=1, le=32)
    cols: int = Field(default=8, ge=1, le=32)
    pitch_mm: float = Field(default=3.175, gt=0, le=50)
    led_mm: float = Field(default=2.0, gt=0, le=50)
    centre: tuple[float, float] | None = None  # (row, col) where the axis meets the board, from LED 0; None: its middle
    ring_mm: float = Field(default=10.04, gt=0, le=200)
    ring_tolerance_mm: float = Field(default=0.05, ge=0, le=10)
    pupil_mm: float | None = Field(default=None, gt=0, le=12)
    relay_magnification: float = Field(default=1.0, gt=0, le=10)
    led_output: tuple[float, ...] = ()
    red_um: float = Field(default=0.6225, gt=0.58, lt=0.7)  # the family's typical values: measure yours
    green_um: float = Field(default=0.5225, gt=0.49, lt=0.58)
    blue_um: float = Field(default=0.47, gt=0.4, lt=0.49)
    max_current_ma: float = Field(default=500.0, gt=0, le=4000)
    heartbeat_gpio: int | None = Field(default=None, ge=0, le=64)
    gpio_chip: str = "/dev/gpiochip0"

    @property
    def leds(self) -> int:
        """How many LEDs the chain has."""
        return self.rows * self.cols

    @property
    def axis(self) -> tuple[float, float]:
        """(row, col) where the axis meets the board, counted from LED 0."""
        return self.centre or ((self.rows - 1) / 2, (self.cols - 1) / 2)

    def peak_um(self, colour: Colour) -> float:
        """The wavelength at which a colour of the LEDs is brightest."""
        return {"red": self.red_um, "green": self.green_um, "blue": self.blue_um}[colour]

    def colour_near(self, wavelength_um: float) -> Colour:
        """The colour of the LEDs whose wavelength is nearest."""
        colours: tuple[Colour, ...] = ("red", "green", "blue")
        return min(colours, key=lambda colour: abs(self.peak_um(colour) - wavelength_um))

    @model_validator(mode="after")
    def _every_led_has_its_output(self) -> Self:
        if self.led_output and (len(self.led_output) != self.leds or min(self.led_output) <= 0):
            raise ValueError(f"led_output needs one number above 0 for each of the {self.leds} LEDs")
        return self


class OpticsSpec(Table):
    """The light path from the eye to the sensor, by default the paper's: "Optical design" and "Hardware design"."""

    iris_um: float = Field(default=3200.0, gt=0)
    diffuser_to_sensor_um: float = Field(default=6000.0, gt=0)
    angular_magnification: float = Field(default=0.75, gt=0)
    field_deg: float = Field(default=33.4, gt=0, le=90)  # beyond, a degree is no longer a number of pixels (Geometry)
    wavelength_um: float = Field(default=0.55, gt=0.3, lt=1.2)
    bandwidth_um: float = Field(default=0.04, ge=0, lt=0.2)
    slope_fwhm_deg: float = Field(default=0.5, gt=0, lt=20)
    correlation_um: float = Field(default=70.0, gt=0)

    def geometry(self, pitch_um: float) -> Geometry:
        """How degrees become pixels on a sensor with that pitch."""
        return Geometry(pitch_um, self.diffuser_to_sensor_um, self.angular_magnification)


class ReplaySpec(Table):
    """Which recordings a replayed head plays: raws in turn, one PSF or a stack, relative to the file."""

    raws: tuple[Path, ...] = Field(min_length=1)
    psfs: tuple[Path, ...] = Field(min_length=1)
    black_dn: float = 0.0
    dark: Path | None = None
    flat: Path | None = None


class InstrumentSpec(Table):
    """A whole head. `sim` and `replay` hold what only that backend needs."""

    name: str = Field(min_length=1)
    camera: CameraSpec
    light: LightSpec
    optics: OpticsSpec | None = None
    sim: SimSpec | None = None
    replay: ReplaySpec | None = None


def load_head(path: Path) -> InstrumentSpec:
    """Read a head TOML (`hardware/heads/*.toml`); a missing table that its backends need is refused."""
    spec = load_toml(path, InstrumentSpec)
    if "sim" in (spec.camera.backend, spec.light.backend) and (spec.sim is None or spec.optics is None):
        raise SpecError(f"{path}: a simulated head needs the tables [optics] and [sim]")
    if spec.camera.backend == "replay" and spec.replay is None:
        raise SpecError(f"{path}: a replayed head needs the table [replay]")
    for key in ("exposure_s", "preview_exposure_s"):
        if getattr(spec.camera, key) >= spec.light.max_on_s:
            raise SpecError(
                f"{path}: camera.{key} = {getattr(spec.camera, key):g} is not shorter than "
                f"light.max_on_s = {spec.light.max_on_s:g}, so the guard would end every exposure"
            )
    _refuse_a_pupil_beside_the_iris(path, spec)
    return spec


def _refuse_a_pupil_beside_the_iris(path: Path, spec: InstrumentSpec) -> None:
    """No light passes if the pupil, as the relay images it, misses the iris."""
    if spec.sim is None or spec.optics is None:
        return
    eye, iris_um = spec.sim.eye, spec.optics.iris_um * spec.optics.angular_magnification
    most_um = (eye.pupil_um + iris_um) / 2
    if eye.decentred_um >= most_um:
        raise SpecError(
            f"{path}: sim.eye.decentred_um = {eye.decentred_um:g}: no light of a pupil of {eye.pupil_um:g} um meets "
            f"the iris; allowed: below {most_um:g}"
        )
