"""One TOML file describes one head; this turns it into a checked, frozen value or says which line is wrong."""

import difflib
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from device.errors import SpecError
from device.radiometry import RadiometrySpec
from device.scene import SimSpec
from device.sensors import SENSORS
from device.tables import Table, load_toml
from device.values import Geometry

_NAMES = f"known are {', '.join(sorted(SENSORS))}"


class CameraSpec(Table):
    """The sensor: which driver answers for it, its pixels, and what its counts mean.

    `sensor` names a profile of `device/sensors.py`, which fills in what this table does not say itself.
    """

    backend: Literal["sim", "replay", "picamera2", "v4l2"]
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
    device: str = Field(default="/dev/video0", min_length=1)  # for v4l2 only
    row_us: float = Field(default=30.0, gt=0, le=1000)
    upright: bool = (
        False  # somebody checked that its pictures stand upright and are not mirrored (hardware/assembly.md)
    )

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


class ChainSpec(Table):
    """A matrix of APA102 LEDs on SPI, and which of them are the ring; by default SparkFun's LuMini 8 x 8.

    `axis` is where the light path goes through it, (row, column) from the bottom left, LEDs facing you; by default its
    middle. `leds` names the ring's LEDs where geometry does not; `trims` dims each of them to the weakest.
    """

    device: str = Field(default="/dev/spidev0.0", pattern=r"^/dev/spidev\d+\.\d+$")
    rows: int = Field(default=8, ge=1, le=16)
    cols: int = Field(default=8, ge=1, le=16)
    pitch_mm: float = Field(default=3.175, gt=0, le=20)
    axis: tuple[float, float] | None = None
    ring_mm: float = Field(default=10.04, gt=0, le=100)
    tolerance_mm: float = Field(default=0.2, gt=0, le=10)
    leds: tuple[int, ...] | None = Field(default=None, min_length=1)
    trims: tuple[float, ...] | None = None
    most_lit: int = Field(default=16, ge=1)  # at 20 mA each: what the head's supply was built for

    @model_validator(mode="after")
    def _the_ring_is_on_the_matrix(self) -> "ChainSpec":
        if self.leds is not None:
            if max(self.leds) >= self.rows * self.cols or min(self.leds) < 0 or len(set(self.leds)) < len(self.leds):
                raise ValueError(f"leds are different numbers from 0 to {self.rows * self.cols - 1}")
            if len(self.leds) > self.most_lit:
                raise ValueError(f"{len(self.leds)} leds are more than most_lit = {self.most_lit}")
        if self.trims is not None and (self.leds is None or len(self.trims) != len(self.leds)):
            raise ValueError("trims are as many as leds")
        if self.trims is not None and not all(0 < trim <= 1 for trim in self.trims):
            raise ValueError("trims are above 0 and at most 1")
        return self


class LightSpec(Table):
    """The LED ring: colours for the picture and for aiming, and how long the guard lets it shine at once."""

    backend: Literal["sim", "replay", "apa102"]
    chain: ChainSpec | None = None
    pupil_mm: float | None = Field(default=None, gt=0, le=10)  # chooses the chain's widest ring that fits into it
    colour: Literal["red", "green", "blue"] = "green"
    preview_colour: Literal["red", "green"] = "red"
    max_on_s: float = Field(default=1.0, gt=0, le=30)
    radiometry: RadiometrySpec | None = None


class BusSpec(Table):
    """The chips on I2C, by address; what is not named is not there. Beyond the limits no picture is taken."""

    backend: Literal["sim", "smbus"]
    device: str = Field(default="/dev/i2c-1", pattern=r"^/dev/i2c-\d+$")
    thermometer: int | None = Field(default=None, ge=0x08, le=0x77)  # TMP117
    battery: int | None = Field(default=None, ge=0x08, le=0x77)  # MAX17048
    memory: int | None = Field(default=None, ge=0x08, le=0x77)  # 24LC32
    warmest_c: float = Field(default=55.0, gt=0, le=100)
    emptiest: float = Field(default=0.05, ge=0, lt=1)


class GpioSpec(Table):
    """Lines of the header: the heartbeat of the lamp's gate (hardware/dead-man.md), and the shutter's button."""

    backend: Literal["sim", "gpiod"]
    chip: str = Field(default="/dev/gpiochip0", pattern=r"^/dev/gpiochip\d+$")
    heartbeat: int | None = Field(default=None, ge=0, le=63)
    button: int | None = Field(default=None, ge=0, le=63)


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


class CalibrationTable(Table):
    """Where calibrations are kept (`diffuscope calibrate`), relative to the head file; the one in force is used.

    `imported` lets the head use a PSF that others measured (`diffuscope calibrations import-psf`).
    """

    archive: Path
    imported: bool = False

    @field_validator("archive")
    @classmethod
    def _from_the_head_file(cls, archive: Path, info: ValidationInfo) -> Path:
        return archive if info.context is None else Path(info.context["folder"]) / archive


class InstrumentSpec(Table):
    """A whole head. `sim` and `replay` hold what only that backend needs."""

    name: str = Field(min_length=1)
    camera: CameraSpec
    light: LightSpec
    optics: OpticsSpec | None = None
    bus: BusSpec | None = None
    gpio: GpioSpec | None = None
    calibration: CalibrationTable | None = None
    sim: SimSpec | None = None
    replay: ReplaySpec | None = None


def load_head(path: Path) -> InstrumentSpec:
    """Read a head TOML (`hardware/heads/*.toml`); a missing table that its backends need is refused."""
    spec = load_toml(path, InstrumentSpec)
    if spec.light.backend == "apa102" and spec.camera.backend != "replay" and spec.optics is None:
        raise SpecError(f"{path}: a head needs the table [optics]")
    if "sim" in (spec.camera.backend, spec.light.backend) and (spec.sim is None or spec.optics is None):
        raise SpecError(f"{path}: a simulated head needs the tables [optics] and [sim]")
    if spec.light.backend == "apa102" and spec.light.chain is None:
        raise SpecError(f"{path}: a ring of APA102 LEDs needs the table [light.chain]")
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
