"""Optical setup of one exposure as data: ideal when built, then changed by effects.

    Scene           a head with its [optics] and [sim], in one colour: the input of every effect's size
    Size            eta of an effect: the change of the reconstruction over the reconstruction's noise
    OpticalSetup    the light path from the object to the counts: effects change it, `render` computes it

A part that no effect has changed costs no computing time.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from math import sqrt
from typing import NamedTuple

from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, OpticsSpec
from device.config.scene import SimSpec
from device.errors import SpecError
from device.optics.diffuser import EMMETROPIA, Refraction
from device.optics.illumination import MEAN_OVER_PEAK, PEAK_UM
from device.optics.led_cap import LedCap, dark_deg
from device.optics.lenslets import IDEAL, LensState
from device.optics.lit_angle import cap_of
from device.sim.fundus import Fundus
from device.sim.head_light import HeadLight, head_light
from device.sim.sensor import SensorModel
from device.values import Colour, Eye, Geometry, Image

# Peak electrons at full drive, relative to green: the ring's currents are trimmed so that a red aiming picture of half
# the exposure is bright and a red picture of the full exposure does not saturate (23 ke- well, 15 ke- green).
TRIM: dict[Colour, float] = {"red": 1.5, "green": 1.0, "blue": 0.9, "amber": 1.2}
TABLE_E, TABLE_PITCH_UM = 20000.0, 5.04  # reference light of the tabulated etas: peak electrons and pixel pitch
LIT_SHARE = 0.37  # of the peak: the mean of the lit pixels of a retina behind this diffuser
SENSOR_SHARE = 0.15  # of the peak: the mean of the paper's whole sensor

Place = tuple[float, float]  # on the retina, in the eye's view: degrees to the right of the axis, and down


@dataclass(frozen=True)
class Scene:
    """Head with its tables [optics] and [sim], in one colour of light; SpecError if one of the tables is missing.

    `turn_deg` is the eye's turn to a fixation target, in addition to its gaze, degrees right and down in the picture.
    """

    spec: InstrumentSpec
    colour: Colour
    eye: Eye = "OD"
    turn_deg: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.spec.optics is None or self.spec.sim is None:
            raise SpecError("a simulated head needs the tables [optics] and [sim]")

    @property
    def sim(self) -> SimSpec:
        """Table [sim]: object, eye, light and sensor flaws."""
        assert self.spec.sim is not None
        return self.spec.sim

    @property
    def optics(self) -> OpticsSpec:
        """Table [optics]; for another colour than the picture's, with the wavelength of that colour's LED."""
        assert self.spec.optics is not None
        if self.colour == self.spec.light.colour:
            return self.spec.optics
        return self.spec.optics.model_copy(update={"wavelength_um": PEAK_UM[self.colour]})

    @property
    def geometry(self) -> Geometry:
        """Scale between degrees at the eye and pixels of this sensor."""
        return self.optics.geometry(self.spec.camera.pitch_um)

    @property
    def seed(self) -> int:
        """Seed of this head's random numbers: `sim.seed` modulo 2^32."""
        return self.sim.seed % 2**32

    @property
    def half_field_deg(self) -> float:
        """Angle from the axis to the edge of the illuminated field, degrees."""
        return self.optics.field_deg / 2

    @cached_property
    def cap(self) -> LedCap | None:
        """Hole before each LED of a ring whose dies have a width; else None."""
        return cap_of(self.spec, self.colour)

    @property
    def lit_deg(self) -> float:
        """Full angle beyond which no light arrives, degrees: the field's, wider with the penumbra of the dies."""
        if self.cap is None:
            return self.optics.field_deg
        return max(self.optics.field_deg, dark_deg(self.cap, self.optics.angular_magnification))

    @cached_property
    def budget(self) -> HeadLight | None:
        """Light by the budget of the head's LEDs, for `peak_e = "budget"`; None where the scene gives a number."""
        return head_light(self.spec, self.colour) if self.sim.peak_e == "budget" else None

    @cached_property
    def peak_e(self) -> float:
        """Electrons of the brightest pixel in one exposure of a picture in this colour, before stray light.

        By a budget an estimate from the mean of the lit disc; the frame itself has the mean of the budget.
        """
        budget = self.budget
        peak_e = self.sim.peak_e
        if budget is not None:
            return budget.mean_e / MEAN_OVER_PEAK
        assert peak_e != "budget"
        return TRIM[self.colour] * peak_e

    @property
    def lit_e(self) -> float:
        """Estimated mean of the lit pixels, electrons: 0.37 of the peak; reference of all shares of the signal."""
        return LIT_SHARE * self.peak_e

    @property
    def noise_e(self) -> float:
        """Shot and read noise of a pixel at the mean signal of the whole sensor (0.15 of the peak), electrons."""
        return sqrt(SENSOR_SHARE * self.peak_e + self.spec.camera.read_noise_e**2)

    @property
    def weight(self) -> float:
        """Weight of a deterministic effect relative to the tabulated light.

        eta ~ sqrt(electrons), OPTICS.md 3.1. In less light than the table's, the prior filters more and the noise falls
        with it: exponent 0.15. Light is compared as electrons per sensor area, so that the pixel size has no effect.
        """
        light = self.peak_e / TABLE_E * (TABLE_PITCH_UM / self.spec.camera.pitch_um) ** 2
        return float(light ** (0.5 if light > 1 else 0.15))

    @property
    def axis_deg(self) -> Place:
        """Place of the eye's own axis in the picture: its gaze and its turn, degrees right and down."""
        gaze = self.sim.eye.gaze_deg
        return gaze[0] + self.turn_deg[0], gaze[1] + self.turn_deg[1]

    @property
    def refraction(self) -> Refraction:
        """Refraction of the scene's eye, dpt: M, J0, J45."""
        eye = self.sim.eye
        return Refraction(eye.m_dpt, eye.j0_dpt, eye.j45_dpt)


class Size(NamedTuple):
    """Size of an effect: eta, the change of the reconstruction over the reconstruction's noise, and its explanation.

    An eta of exactly zero means no change at all; OPTICS.md 3.1. `shared`: the quantity that the effect changes, where
    other effects change the same one, so that their etas add up; "" for a change that is independent of the others'.
    """

    eta: float
    why: str
    shared: str = ""


MEAN_SPHERE, CONSTANT_LIGHT, LIGHT_OVER_FIELD = "mean sphere", "constant light", "light over the field"


@dataclass
class AddedLight:
    """Light in a frame that is not an image of the object: `veils` by effect name, lit by the lamp, and `ambient`.

    Both are shares of `lit_e_per_s`, the mean signal of the lit pixels, which is known after rendering.
    """

    veils: dict[str, Image | float] = field(default_factory=dict)
    ambient: float = 0.0
    lit_e_per_s: float = 0.0


class Ghost(NamedTuple):
    """Second image: its share of the light, and its displacement in pixels."""

    share: float
    right_px: int
    down_px: int


@dataclass
class CalibrationDifference:
    """Difference between calibration and exposure: the calibration has a source of `source_um`, and none of the others.

    `source_um` is the diameter of its point source. `ghost` is a second image. `light_of_rows` gives the light of the
    rows over the mean, (rows, 1), for the beginning of an exposure and its length, s; None: it is even. `response`
    multiplies that of the pixels in the flat frame, (rows, cols).
    """

    source_um: float = 0.0
    ghost: Ghost | None = None
    light_of_rows: Callable[[float, float], Image] | None = None
    response: Image | None = None

    def multiply_response(self, factor: Image) -> None:
        """Multiply the response of the pixels since the flat frame by `factor`, (rows, cols)."""
        self.response = factor if self.response is None else self.response * factor


@dataclass
class OpticalSetup:  # size: one attribute for each thing that an effect changes
    """Light path, ideal when built: a green object, one wavelength, a sensor without noise or flaws.

    `object` is the radiance on a square as wide as the light. `aberrations` and `beams` map a place in the field to the
    additional refraction, and to the shift of the beam's centre against the iris's, um. `lines` is the number of
    wavelengths. `drift_px` is the movement of the image in one exposure (right, down), `lag_px` that to the right
    between two rows. `response` multiplies each pixel's light as in the flat frame. `spent_ms` is the computing time.
    Keys of the dicts are names of effects.
    """

    scene: Scene
    subject: Fundus
    sensor: SensorModel
    object: Image = field(init=False)
    optics: OpticsSpec = field(init=False)
    lenses: LensState = IDEAL
    lines: int = 1
    refraction: Refraction = EMMETROPIA
    aberrations: dict[str, Callable[[Place], Refraction]] = field(default_factory=dict)
    beams: dict[str, Callable[[Place], tuple[float, float]]] = field(default_factory=dict)
    drift_px: tuple[float, float] = (0.0, 0.0)
    lag_px: float = 0.0
    added_light: AddedLight = field(default_factory=AddedLight)
    response: Image | None = None
    dark_e_per_s: float = 0.0
    calibrated: CalibrationDifference = field(default_factory=CalibrationDifference)
    spent_ms: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.object = self.subject.reflectance["green"]
        self.optics = self.scene.optics

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.scene.spec.camera.rows, self.scene.spec.camera.cols

    @property
    def whole_response(self) -> Image | None:
        """Response of the pixels in an exposure, (rows, cols): that of the flat frame times its change since."""
        parts = [part for part in (self.response, self.calibrated.response) if part is not None]
        return None if not parts else parts[0] if len(parts) == 1 else parts[0] * parts[1]

    def multiply_response(self, factor: Image) -> None:
        """Multiply the relative response of the pixels by `factor`, (rows, cols); the flat frame contains it."""
        self.response = factor if self.response is None else self.response * factor

    @contextmanager
    def timed(self, *names: str) -> Iterator[None]:
        """Add the computing time of the context, without nested contexts, to `spent_ms` of `names` in equal parts."""
        clock = SystemClock()
        booked_ms = sum(self.spent_ms.values())
        begin_s = clock.now_s()
        yield
        inside_ms = sum(self.spent_ms.values()) - booked_ms
        share_ms = (1000 * (clock.now_s() - begin_s) - inside_ms) / max(len(names), 1)
        for name in names:
            self.spent_ms[name] = self.spent_ms.get(name, 0.0) + share_ms
