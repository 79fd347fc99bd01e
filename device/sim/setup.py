"""One exposure as data: what every part of the light's way does. As made it is ideal; effects change it.

    Scene    a head with its [optics] and [sim], in one colour: the input of every effect's size
    Size     an effect's answer: how much it would change the picture
    Setup    the way of the light from the object to the counts: effects change it, `render` follows it

What no effect has touched costs nothing.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import sqrt
from typing import NamedTuple

from device.clock import SystemClock
from device.errors import SpecError
from device.optics.diffuser import EMMETROPIA, Refraction
from device.scene import SimSpec
from device.sim.fundus import Fundus
from device.sim.sensor import SensorModel
from device.spec import InstrumentSpec, OpticsSpec
from device.values import Colour, Eye, Geometry, Image

# Peak electrons at full drive, relative to green: the ring's currents are trimmed so that a red aiming picture of half
# the exposure is bright, and a red one of the full exposure does not saturate (23 ke- well, 15 ke- green).
TRIM: dict[Colour, float] = {"red": 1.5, "green": 1.0, "blue": 0.9}
LED_UM: dict[Colour, float] = {"red": 0.622, "green": 0.522, "blue": 0.467}  # optics.md 2.2
TABLE_E, TABLE_PITCH_UM = 20000.0, 5.04  # the light at which etas are tabulated: peak electrons, and of which pixels
LIT_SHARE = 0.37  # of the peak: the mean of the lit pixels of a retina behind this diffuser
SENSOR_SHARE = 0.15  # of the peak: the mean of the paper's whole sensor

Place = tuple[float, float]  # on the retina, as the eye sees it: degrees to the right of the axis, and down


@dataclass(frozen=True)
class Scene:
    """What every effect is asked about: a head with its [optics] and [sim], seen in one colour."""

    spec: InstrumentSpec
    colour: Colour
    eye: Eye = "OD"

    def __post_init__(self) -> None:
        if self.spec.optics is None or self.spec.sim is None:
            raise SpecError("a simulated head needs the tables [optics] and [sim]")

    @property
    def sim(self) -> SimSpec:
        """What is looked at, by which eye, in which light, with which flaws."""
        assert self.spec.sim is not None
        return self.spec.sim

    @property
    def optics(self) -> OpticsSpec:
        """The optics as this colour meets them: [optics] describes the colour of the picture."""
        assert self.spec.optics is not None
        if self.colour == self.spec.light.colour:
            return self.spec.optics
        return self.spec.optics.model_copy(update={"wavelength_um": LED_UM[self.colour]})

    @property
    def geometry(self) -> Geometry:
        """How degrees at the eye become pixels of this sensor."""
        return self.optics.geometry(self.spec.camera.pitch_um)

    @property
    def seed(self) -> int:
        """Seed of this head's random numbers."""
        return self.sim.seed % 2**32

    @property
    def half_field_deg(self) -> float:
        """From the axis to the edge of the illuminated field."""
        return self.optics.field_deg / 2

    @property
    def peak_e(self) -> float:
        """What the brightest pixel collects in one exposure of the picture."""
        return TRIM[self.colour] * self.sim.peak_e

    @property
    def lit_e(self) -> float:
        """The mean of the lit pixels, which shares of the signal refer to."""
        return LIT_SHARE * self.peak_e

    @property
    def noise_e(self) -> float:
        """The noise of a pixel, shot and read noise in the mean over the paper's sensor; electrons."""
        return sqrt(SENSOR_SHARE * self.peak_e + self.spec.camera.read_noise_e**2)

    @property
    def weight(self) -> float:
        """How a deterministic effect weighs here against the table's light.

        eta ~ sqrt(electrons), optics.md 3.0; but in less light the prior filters more, and the noise falls with it.
        Electrons of one and the same area: smaller pixels collect less each, and are more.
        """
        light = self.peak_e / TABLE_E * (TABLE_PITCH_UM / self.spec.camera.pitch_um) ** 2
        return float(light ** (0.5 if light > 1 else 0.15))

    @property
    def refraction(self) -> Refraction:
        """Of the eye in front of the instrument."""
        eye = self.sim.eye
        return Refraction(eye.m_dpt, eye.j0_dpt, eye.j45_dpt)


class Size(NamedTuple):
    """How much an effect would change a reconstruction, over the reconstruction's noise; and the number behind that.

    An eta of exactly zero says that it changes nothing at all here. optics.md 3.0.
    """

    eta: float
    why: str


@dataclass
class Setup:
    """The light's way, ideal as made: a green object through one wavelength, onto a sensor without noise or flaws.

    `object` is the radiance on a square as wide as the field; `aberrations` and `beams` say, for a place in the field,
    what is added to the refraction, and how far the beam's middle is from the iris's, in um; `drift_px` is how far the
    image moves in an exposure (right, down) and `lag_px` how far to the right between two rows; `veils` are added in
    shares of the mean signal, `lit_e_per_s` once it is known; `response` multiplies each pixel's light. Each local part
    carries its effect's name.
    """

    scene: Scene
    subject: Fundus
    sensor: SensorModel
    object: Image = field(init=False)
    optics: OpticsSpec = field(init=False)
    lines: int = 1
    refraction: Refraction = EMMETROPIA
    aberrations: dict[str, Callable[[Place], Refraction]] = field(default_factory=dict)
    beams: dict[str, Callable[[Place], tuple[float, float]]] = field(default_factory=dict)
    drift_px: tuple[float, float] = (0.0, 0.0)
    lag_px: float = 0.0
    veils: dict[str, Image | float] = field(default_factory=dict)
    ambient: float = 0.0
    response: Image | None = None
    dark_e_per_s: float = 0.0
    source_um: float = 0.0
    lit_e_per_s: float = 0.0
    spent_ms: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.object = self.subject.reflectance["green"]
        self.optics = self.scene.optics

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.scene.spec.camera.rows, self.scene.spec.camera.cols

    def respond(self, factor: Image) -> None:
        """Multiply the pixels' response."""
        self.response = factor if self.response is None else self.response * factor

    @contextmanager
    def timed(self, *names: str) -> Iterator[None]:
        """Book what is done here, and not booked inside, as the cost of these effects, in equal parts."""
        clock, booked_ms = SystemClock(), sum(self.spent_ms.values())
        begin_s = clock.now_s()
        yield
        inside_ms = sum(self.spent_ms.values()) - booked_ms
        share_ms = (1000 * (clock.now_s() - begin_s) - inside_ms) / max(len(names), 1)
        for name in names:
            self.spent_ms[name] = self.spent_ms.get(name, 0.0) + share_ms
