"""The one world that the simulated camera and lamp share: retina, eye, diffuser, and what the lamp does now."""

from functools import cached_property

import numpy as np
from scipy import fft

from device.clock import Clock
from device.errors import SettingError, SpecError
from device.optics.diffuser import EMMETROPIA, Refraction, caustic
from device.sim.fundus import Fundus, fundus
from device.sim.photo import photograph
from device.sim.sensor import SensorModel
from device.spec import InstrumentSpec, OpticsSpec, SimSpec
from device.values import Colour, Eye, Geometry, Glow, Image

FAULTS = frozenset({"camera.missing", "camera.stalled", "light.fault"})

# Peak electrons at full drive, relative to green: the ring's currents are trimmed so that a red aiming picture of half
# the exposure is bright, and a red one of the full exposure does not saturate (23 ke- well, 15 ke- green).
TRIM: dict[Colour, float] = {"red": 1.5, "green": 1.0, "blue": 0.9}
ROUNDOFF = 1e-6  # of the peak: darker than this is the rounding of a single-precision FFT, not light
LED_UM: dict[Colour, float] = {"red": 0.622, "green": 0.522, "blue": 0.467}  # optics.md 2.2


class World:
    """A retina behind an eye behind the diffuser, and the state of the lamp.

    `eye` and `refraction` are those of the eye being looked at (a photograph is shown as it is);
    `ambient_e_per_s` is light that comes without the lamp.
    `faults` holds what is broken now: "camera.missing", "camera.stalled", "light.fault".
    """

    def __init__(
        self,
        spec: InstrumentSpec,
        clock: Clock,
        *,
        eye: Eye = "OD",
        refraction: Refraction = EMMETROPIA,
        ambient_e_per_s: float = 0.0,
    ) -> None:
        if spec.optics is None or spec.sim is None:
            raise SpecError("a simulated head needs the tables [optics] and [sim]")
        self.spec = spec
        self.clock = clock
        self.optics: OpticsSpec = spec.optics
        self.sim: SimSpec = spec.sim
        self.seed = spec.sim.seed % 2**32
        self.eye: Eye = eye
        self.refraction = refraction
        self.ambient_e_per_s = ambient_e_per_s
        self.sensor = SensorModel.of(spec.camera)
        self.glow: Glow | None = None
        self.faults: set[str] = set()
        self.frames = 0
        self._psfs: dict[tuple[Colour, Refraction], Image] = {}
        self._rates: dict[Colour, Image] = {}

    def broken(self, part: str) -> bool:
        """Whether a part has its fault now; SettingError if `faults` names one that does not exist."""
        if strange := self.faults - FAULTS:
            raise SettingError(
                f"no fault is called {sorted(strange)[0]!r}", f"Choose from {', '.join(sorted(FAULTS))}."
            )
        return part in self.faults

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.spec.camera.rows, self.spec.camera.cols

    @property
    def geometry(self) -> Geometry:
        """How degrees at the eye become pixels of this sensor."""
        optics = self.optics
        return Geometry(self.spec.camera.pitch_um, optics.diffuser_to_sensor_um, optics.angular_magnification)

    @cached_property
    def retina(self) -> Fundus:
        """The whole retina in the field, on a square as wide as the field: it may be larger than the sensor.

        Rows and columns are even or odd as the sensor's are, so that their middles fall together.
        """
        geometry, sim = self.geometry, self.sim
        wide = int(np.ceil(geometry.px_per_deg * self.optics.field_deg)) + 4
        shape = (wide + (wide - self.shape[0]) % 2, wide + (wide - self.shape[1]) % 2)
        if sim.object.image is not None:
            return photograph(sim.object.image, shape, geometry.px_per_deg, self.optics.field_deg)
        return fundus(
            shape,
            geometry.px_per_deg,
            self.optics.field_deg,
            self.seed,
            eye=self.eye,
            haemorrhages=sim.object.haemorrhages,
            microaneurysms=sim.object.microaneurysms,
            exudates=sim.object.exudates,
        )

    def truth(self, colour: Colour) -> Image:
        """The object on the sensor grid: reflectance, float32 (rows, cols), zero outside the field."""
        return fitted(self.retina.reflectance[colour], self.shape)

    def psf(self, colour: Colour, refraction: Refraction | None = None) -> Image:
        """The noise-free caustic of a colour at the sensor's pitch, (n, n), sum 1; by default of this world's eye."""
        key = (colour, self.refraction if refraction is None else refraction)
        if key not in self._psfs:
            optics = self.optics
            if colour != self.spec.light.colour:  # [optics] describes the colour of the picture
                optics = optics.model_copy(update={"wavelength_um": LED_UM[colour]})
            self._psfs[key] = caustic(optics, self.geometry.pitch_um, self.seed, key[1])
        return self._psfs[key]

    def electrons_per_s(self, colour: Colour) -> Image:
        """Electrons per second at full drive of one colour, float32 (rows, cols): without noise, computed once.

        The green peak reaches `sim.peak_e` in `camera.exposure_s`.
        """
        if colour not in self._rates:
            arriving = blurred(self.retina.reflectance[colour], self.psf(colour), self.shape)
            peak_e_per_s = TRIM[colour] * self.sim.peak_e / self.spec.camera.exposure_s
            arriving *= np.float32(peak_e_per_s / max(float(arriving.max()), 1e-30))
            self._rates[colour] = arriving
        return self._rates[colour]

    def electrons(self, exposure_s: float) -> Image:
        """The electrons that are expected in an exposure under the lamp as it is now; float32 (rows, cols)."""
        ambient_e = np.float32(self.ambient_e_per_s * exposure_s)
        glow = self.glow  # once: a guard may darken the lamp at any moment
        if glow is None:
            return np.full(self.shape, ambient_e, np.float32)
        return self.electrons_per_s(glow.colour) * np.float32(glow.level * exposure_s) + ambient_e


def blurred(scene: Image, psf: Image, shape: tuple[int, int]) -> Image:
    """The light on a sensor of `shape` from a scene around its middle: the full linear convolution, then the crop.

    Nothing wraps round, and light from beyond the sensor's edge arrives on it. Not the solver's operator.
    """
    full = (scene.shape[0] + psf.shape[0] - 1, scene.shape[1] + psf.shape[1] - 1)
    grid = [fft.next_fast_len(n, real=True) for n in full]
    spectrum = fft.rfft2(scene, grid)
    spectrum *= fft.rfft2(psf, grid)
    whole = fft.irfft2(spectrum, grid, overwrite_x=True)[: full[0], : full[1]]
    rows, cols = (p // 2 + s // 2 for s, p in zip(scene.shape, psf.shape, strict=True))
    arriving = fitted(whole, shape, (rows, cols))
    arriving[arriving < ROUNDOFF * float(whole.max())] = 0
    return arriving


def fitted(image: Image, shape: tuple[int, int], middle: tuple[int, int] | None = None) -> Image:
    """A copy on `shape`, cropped or zero-filled, with `middle` (default rows//2, cols//2) brought to the middle."""
    out = np.zeros(shape, np.float32)
    into, of = [], []
    for size, have, centre in zip(
        shape, image.shape, middle or (image.shape[0] // 2, image.shape[1] // 2), strict=True
    ):
        first = size // 2 - centre  # where the image's first row would come to lie
        into.append(slice(max(first, 0), max(min(first + have, size), 0)))
        of.append(slice(max(-first, 0), max(min(size - first, have), 0)))
    out[tuple(into)] = image[tuple(of)]
    return out
