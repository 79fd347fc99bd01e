"""Head file: specification of one optical head and its parts in TOML, validated and frozen."""

from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from device.config.element import ElementSpec
from device.config.radiometry import RadiometrySpec
from device.config.scene import SimSpec
from device.config.sensors import sensor_profile
from device.config.shipped_heads import head_path
from device.config.toml_file import Table, load_toml
from device.errors import SpecError
from device.values import Colour, Geometry


class CameraSpec(Table):
    """Sensor: driver backend, pixels, and conversion of counts.

    `sensor` names a preset of `device/config/sensor_presets`, or a TOML file beside the head file, which supplies the
    keys that this table omits, but for `bayer`, which the file of a real camera states itself where the sensor is usual
    with colour filters; the value is then the file's name without `.toml`. `row_us` is the row time; `black_dn`
    the count of a pixel without light.
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
    bayer: bool = False  # colour filters before the pixels: frames only; never taken from `sensor`
    upright: bool = False  # checked by hand: pictures are upright and not mirrored (hardware/assembly.md)

    @model_validator(mode="before")
    @classmethod
    def _with_sensor_profile(cls, values: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        """Add the values of the sensor preset for keys that the table omits; ValueError for an unknown or invalid one.

        The path of a preset is relative to the head file's folder, if the validation context names it.
        """
        name = values.get("sensor")
        if name is None:
            return values
        folder = Path() if info.context is None else Path(info.context["folder"])
        profile = sensor_profile(str(name), folder)
        if profile.bayer and "bayer" not in values and values.get("backend") in ("picamera2", "v4l2"):
            raise ValueError(
                f"{name} is usual with colour filters: write bayer = false for its monochrome version, or bayer = true "
                "for a bench whose frames are reconstructed with --bayer"
            )
        supplied = {
            key: value for key, value in profile.model_dump(exclude={"bayer"}).items() if key in cls.model_fields
        }
        return {**supplied, **values, "sensor": Path(str(name)).name.removesuffix(".toml")}

    @property
    def white_dn(self) -> int:
        """Highest count of the converter."""
        return int(2**self.bit_depth) - 1

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per count if the full well reaches the highest count."""
        return self.full_well_e / (self.white_dn - self.black_dn)


class ChainSpec(Table):
    """Matrix of APA102 LEDs on SPI and its ring; by default SparkFun's LuMini 8 x 8.

    `axis` is where the light path crosses the matrix, (row, column) from the bottom left, seen from the LED side;
    default: its middle. `ring_mm` +- `tolerance_mm` is the ring's diameter. `leds` lists the ring's LEDs instead;
    `trims` are their relative levels, above 0 and up to 1, which equalise them.
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
    most_lit: int = Field(default=16, ge=1)  # at 20 mA each: limit of the head's supply

    @model_validator(mode="after")
    def _check_ring(self) -> "ChainSpec":
        """Raise ValueError if LED numbers or trims do not fit the matrix, `most_lit` or each other."""
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


OUTPUTS = 12  # of one TLC5971
OUTPUT_MA = 60.0  # largest current of one output, TI SBVS146D


class SinkLedSpec(Table):
    """LEDs of one colour of a constant-current ring.

    `places` are their places on the grid, numbered as in `ChainSpec`; `outputs` lists for each LED the outputs that
    sink its current, several in parallel. `power_mw` is the radiant power of one LED at full drive, `wavelength_um` its
    peak, `emitter_mm` the width of what shines.
    """

    part: str = Field(min_length=1)
    places: tuple[int, ...] = Field(min_length=1)
    outputs: tuple[tuple[int, ...], ...] = Field(min_length=1)
    wavelength_um: float = Field(ge=0.4, le=0.7)
    power_mw: float = Field(gt=0, le=2000)
    emitter_mm: float = Field(gt=0, le=5)
    trims: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _check_counts(self) -> "SinkLedSpec":
        """Raise ValueError if outputs or trims are not as many as places, or a trim is not above 0 and at most 1."""
        if len(self.outputs) != len(self.places) or not all(self.outputs):
            raise ValueError("outputs has one list of at least one output for each of places")
        if self.trims is not None and (len(self.trims) != len(self.places) or not all(0 < t <= 1 for t in self.trims)):
            raise ValueError("trims are as many as places, above 0 and at most 1")
        return self


class SinkSpec(Table):
    """Ring of high-power LEDs behind TLC5971 constant-current sinks on SPI, up to three colours.

    `output_ma` is the current of one output, set by the resistor at IREF; `most_ma` the limit of the load switch, which
    no colour may exceed. The grid of places is that of SparkFun's LuMini, so that the LED cap fits both.
    """

    device: str = Field(default="/dev/spidev0.0", pattern=r"^/dev/spidev\d+\.\d+$")
    chips: int = Field(default=1, ge=1, le=4)
    output_ma: float = Field(default=OUTPUT_MA, gt=0, le=OUTPUT_MA)
    most_ma: float = Field(default=500.0, gt=0, le=1000)
    rows: int = Field(default=8, ge=1, le=16)
    cols: int = Field(default=8, ge=1, le=16)
    pitch_mm: float = Field(default=3.175, gt=0, le=20)
    green: SinkLedSpec
    amber: SinkLedSpec | None = None
    red: SinkLedSpec | None = None

    @property
    def colours(self) -> "dict[Colour, SinkLedSpec]":
        """LEDs by colour, without the colours that this ring has not."""
        named: dict[Colour, SinkLedSpec | None] = {"green": self.green, "amber": self.amber, "red": self.red}
        return {colour: leds for colour, leds in named.items() if leds is not None}

    @model_validator(mode="after")
    def _check_outputs(self) -> "SinkSpec":
        """Raise ValueError if an output or place is used twice or is not there, or a colour draws too much current."""
        leds = self.colours.values()
        outputs = [output for led in leds for several in led.outputs for output in several]
        if len(set(outputs)) < len(outputs) or not all(0 <= output < OUTPUTS * self.chips for output in outputs):
            raise ValueError(f"outputs are different numbers from 0 to {OUTPUTS * self.chips - 1}")
        places = [place for led in leds for place in led.places]
        if len(set(places)) < len(places) or not all(0 <= place < self.rows * self.cols for place in places):
            raise ValueError(f"places are different numbers from 0 to {self.rows * self.cols - 1}")
        for colour, driven in self.colours.items():
            if (drawn_ma := self.output_ma * sum(map(len, driven.outputs))) > self.most_ma:
                raise ValueError(f"{colour} draws {drawn_ma:g} mA, more than most_ma = {self.most_ma:g}")
        return self


class LightSpec(Table):
    """LED ring: colours for the picture and for aiming, and `max_on_s`, the longest time the guard leaves it on.

    `chain` is a matrix of APA102 LEDs, `sinks` a ring of high-power LEDs with TLC5971 drivers; a real head has one.
    `head` names a shipped head, or a TOML file beside this one, whose [light] supplies the keys that this table omits;
    the value is then the file's name without `.toml`.
    """

    backend: Literal["sim", "replay", "none", "apa102", "tlc5971"]
    head: str | None = None
    chain: ChainSpec | None = None
    sinks: SinkSpec | None = None
    pupil_mm: float | None = Field(default=None, gt=0, le=10)  # selects the chain's widest ring that fits into it
    colour: Colour = "green"
    preview_colour: Literal["red", "green", "amber"] = "red"
    max_on_s: float = Field(default=1.0, gt=0, le=30)
    radiometry: RadiometrySpec | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_light_of_head(cls, values: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        """Add the keys of the named head's [light] that the table omits; ValueError for an unknown or dark head.

        Nothing is read for a table that has every key, as of a specification that was loaded before.
        """
        name = values.get("head")
        if name is None or set(cls.model_fields) <= set(values):
            return values
        light = _light_of(head_path(str(name), Path() if info.context is None else Path(info.context["folder"])))
        return {**light.model_dump(), **values, "head": Path(str(name)).name.removesuffix(".toml")}


class BusSpec(Table):
    """I2C addresses of the chips, None if absent; limits for a picture: highest temperature, least battery fraction."""

    backend: Literal["sim", "smbus"]
    device: str = Field(default="/dev/i2c-1", pattern=r"^/dev/i2c-\d+$")
    thermometer: int | None = Field(default=None, ge=0x08, le=0x77)  # TMP117
    battery: int | None = Field(default=None, ge=0x08, le=0x77)  # MAX17048
    memory: int | None = Field(default=None, ge=0x08, le=0x77)  # 24LC32
    warmest_c: float = Field(default=55.0, gt=0, le=100)
    emptiest: float = Field(default=0.05, ge=0, lt=1)


class GpioSpec(Table):
    """GPIO lines: heartbeat of the lamp's gate (hardware/dead-man.md), and shutter button."""

    backend: Literal["sim", "gpiod"]
    chip: str = Field(default="/dev/gpiochip0", pattern=r"^/dev/gpiochip\d+$")
    heartbeat: int | None = Field(default=None, ge=0, le=63)
    button: int | None = Field(default=None, ge=0, le=63)


class OpticsSpec(Table):
    """Light path from the eye to the sensor, by default the paper's: "Optical design" and "Hardware design"."""

    iris_um: float = Field(default=3200.0, gt=0)
    diffuser_to_sensor_um: float = Field(default=6000.0, gt=0)
    angular_magnification: float = Field(default=0.75, gt=0)
    field_deg: float = Field(default=33.4, gt=0, le=90)  # beyond, a degree is no longer a number of pixels (Geometry)
    wavelength_um: float = Field(default=0.55, gt=0.3, lt=1.2)
    bandwidth_um: float = Field(default=0.04, ge=0, lt=0.2)
    element: ElementSpec = ElementSpec()

    @model_validator(mode="after")
    def _check_element(self) -> "OpticsSpec":
        """Raise ValueError for lenses that do not fit the iris or the plate."""
        self.element.check_iris(self.iris_um)
        return self

    def geometry(self, pitch_um: float) -> Geometry:
        """Return the scale between degrees at the eye and pixels of a sensor with that pixel pitch."""
        powers = [1 / self.diffuser_to_sensor_um - 1 / focal_um for *_, focal_um in self.element.lenses]
        focus_dpt = 1e6 * sum(powers) / len(powers) / self.angular_magnification**2 if powers else None
        scales = pitch_um, self.diffuser_to_sensor_um, self.angular_magnification
        return Geometry(
            *scales,
            lens_focus_dpt=focus_dpt,
            lens_index=None if not powers or self.element.flat_field else self.element.index,
        )


class ReplaySpec(Table):
    """Files of a replayed head: raws in turn, one PSF or a stack, dark and flat frame; paths relative to the TOML."""

    raws: tuple[Path, ...] = Field(min_length=1)
    psfs: tuple[Path, ...] = Field(min_length=1)
    black_dn: float = 0.0
    dark: Path | None = None
    flat: Path | None = None


class CalibrationTable(Table):
    """Archive of the calibrations (`diffuscope calibrate`), relative to the head file; the active one is used.

    `imported` permits a PSF that was not measured on this head (`diffuscope calibrations import-psf`).
    """

    archive: Path
    imported: bool = False

    @field_validator("archive")
    @classmethod
    def _relative_to_head_file(cls, archive: Path, info: ValidationInfo) -> Path:
        """Return the path resolved relative to the head file's folder, if the validation context names it."""
        return archive if info.context is None else Path(info.context["folder"]) / archive


class InstrumentSpec(Table):
    """Specification of a whole head, one field per table of its file; `sim` and `replay` are for these backends."""

    name: str = Field(min_length=1)
    camera: CameraSpec
    light: LightSpec
    optics: OpticsSpec | None = None
    bus: BusSpec | None = None
    gpio: GpioSpec | None = None
    calibration: CalibrationTable | None = None
    sim: SimSpec | None = None
    replay: ReplaySpec | None = None

    @property
    def px_per_deg(self) -> float | None:
        """Sensor pixels per degree of field at the eye; None without the table [optics]."""
        return None if self.optics is None else self.optics.geometry(self.camera.pitch_um).px_per_deg


class _LightTable(Table):
    """The table [light] of a head file as written, without its other tables."""

    model_config = ConfigDict(extra="ignore")
    light: dict[str, object]


def _light_of(path: Path) -> LightSpec:
    """Return the [light] of a head file; SpecError if it has no LEDs or is itself that of another head."""
    if "head" in load_toml(path, _LightTable).light:
        raise SpecError(f"{path} takes its light from another head; name that one")
    light = load_head(path).light
    if light.backend in ("none", "replay"):
        raise SpecError(f"{path} has no LEDs, so its light is not known; name a head with a lamp")
    return light


def load_head(path: Path) -> InstrumentSpec:
    """Return the head in a TOML file (`hardware/heads/*.toml`); SpecError for a missing table or an invalid value."""
    spec = load_toml(path, InstrumentSpec)
    if spec.light.backend in ("apa102", "tlc5971") and spec.camera.backend != "replay" and spec.optics is None:
        raise SpecError(f"{path}: a head needs the table [optics]")
    if "sim" in (spec.camera.backend, spec.light.backend) and (spec.sim is None or spec.optics is None):
        raise SpecError(f"{path}: a simulated head needs the tables [optics] and [sim]")
    if spec.light.backend == "apa102" and spec.light.chain is None:
        raise SpecError(f"{path}: a ring of APA102 LEDs needs the table [light.chain]")
    _refuse_unlit_colours(path, spec.light)
    if spec.camera.backend == "replay" and spec.replay is None:
        raise SpecError(f"{path}: a replayed head needs the table [replay]")
    for key in ("exposure_s", "preview_exposure_s"):
        if getattr(spec.camera, key) >= spec.light.max_on_s:
            raise SpecError(
                f"{path}: camera.{key} = {getattr(spec.camera, key):g} is not shorter than "
                f"light.max_on_s = {spec.light.max_on_s:g}, so the guard would end every exposure"
            )
    _refuse_pupil_beside_iris(path, spec)
    return spec


def _refuse_unlit_colours(path: Path, light: LightSpec) -> None:
    """Raise SpecError for a ring of TLC5971 without its table, and for a colour of which the ring has no LED."""
    if light.backend == "tlc5971" and light.sinks is None:
        raise SpecError(f"{path}: a ring of TLC5971 drivers needs the table [light.sinks]")
    known: set[Colour] = {"red", "green", "blue"} if light.sinks is None else set(light.sinks.colours)
    if light.backend in ("apa102", "tlc5971"):
        for key, colour in (("colour", light.colour), ("preview_colour", light.preview_colour)):
            if colour not in known:
                raise SpecError(f"{path}: light.{key} = {colour!r}: this ring has {', '.join(sorted(known))} LEDs only")


def _refuse_pupil_beside_iris(path: Path, spec: InstrumentSpec) -> None:
    """Raise SpecError for a simulated pupil so far off the axis that its image misses the iris and no light passes."""
    if spec.sim is None or spec.optics is None:
        return
    eye = spec.sim.eye
    iris_um = spec.optics.iris_um * spec.optics.angular_magnification
    most_um = (eye.pupil_um + iris_um) / 2
    if eye.decentred_um >= most_um:
        raise SpecError(
            f"{path}: sim.eye.decentred_um = {eye.decentred_um:g}: no light of a pupil of {eye.pupil_um:g} um meets "
            f"the iris; allowed: below {most_um:g}"
        )
