"""The values that travel through the instrument: frozen, their arrays read-only, checked at birth."""

import hashlib
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError, PsfError, SettingError

Counts = NDArray[np.uint16]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

Colour = Literal["red", "green", "blue"]
Eye = Literal["OD", "OS"]
EYES: tuple[Eye, ...] = ("OD", "OS")


def _freeze(owner: object, *names: str) -> None:
    """Replace arrays of a frozen value by read-only views, so that the lender of a buffer may use it again."""
    for name in names:
        array = getattr(owner, name)
        if array is not None:
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(owner, name, view)


@dataclass(frozen=True)
class Glow:
    """What the lamp is asked to show: one colour, at a level from just above 0 to 1 (full drive)."""

    colour: Colour
    level: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.level <= 1:
            raise SettingError(f"a lamp level of {self.level} is not between 0 and 1")


@dataclass(frozen=True)
class Charge:
    """A battery's state: how full it is, 0 to 1, and its voltage."""

    fraction: float
    volts: float


@dataclass(frozen=True)
class Identity:
    """Who an optical head is: its serial number, and the content hash of its calibration."""

    serial: str
    calibration_id: str


@dataclass(frozen=True)
class Shot:
    """One exposure asked of the camera."""

    exposure_s: float

    def __post_init__(self) -> None:
        if not 0 < self.exposure_s <= 10:
            raise SettingError(f"an exposure of {self.exposure_s} s is not between 0 and 10 s")


@dataclass(frozen=True)
class Frame:
    """What the sensor gave: counts (rows, cols) or (rows, cols, 3), uint16, in DN, and how they came to be.

    `glow` is what the lamp showed (None: dark); `simulated` says that no retina was there, and must never get lost.
    """

    counts: Counts
    exposure_s: float
    number: int
    glow: Glow | None
    simulated: bool

    def __post_init__(self) -> None:
        check_image_shape(self.counts.shape)
        if self.counts.dtype != np.uint16:
            raise FrameError(f"a frame holds uint16 counts, not {self.counts.dtype}")
        _freeze(self, "counts")


def check_image_shape(shape: tuple[int, ...]) -> None:
    """Refuse what is not (rows, cols) or (rows, cols, 3) with at least one pixel."""
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3) or min(shape) < 1:
        raise FrameError(f"an image has rows and columns, and three channels or none; this has the shape {shape}")


@dataclass(frozen=True)
class Psf:
    """The point spread function: what one retinal point becomes on the sensor.

    float32 (rows, cols), sum 1, centre at (rows//2, cols//2).

    Paper, section "Algorithm": the h of y = h * x. A shift of it shifts the picture and changes nothing else.
    `colour` is the light that it was measured in; None: it stands for every colour.
    """

    pixels: Image
    name: str = "psf"
    colour: Colour | None = None

    def __post_init__(self) -> None:
        pixels = self.pixels
        if pixels.ndim != 2 or pixels.size == 0:
            raise PsfError(f"a PSF has rows and columns; {self.name} has the shape {pixels.shape}")
        if not np.isfinite(pixels).all():
            bad = int(pixels.size - np.isfinite(pixels).sum())
            raise PsfError(f"{self.name} holds {bad} values that are not numbers (NaN or infinite)")
        total = float(pixels.sum(dtype=np.float64))
        if not total > 0:
            raise PsfError(f"{self.name} sums to {total:g}; light that arrives is a positive sum")
        if pixels.dtype != np.float32 or not np.isclose(total, 1, rtol=1e-4):
            object.__setattr__(self, "pixels", (pixels / total).astype(np.float32))
        _freeze(self, "pixels")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        rows, cols = self.pixels.shape
        return rows, cols


@dataclass(frozen=True)
class Sensor:
    """What the numbers of a frame mean: counts are `black_dn` + s (1 + `bend_per_dn` s), s = electrons / gain.

    The gain is `gain_e_per_dn`; what has reached `white_dn` is full.
    """

    black_dn: float = 0.0
    gain_e_per_dn: float | None = None
    read_noise_e: float | None = None
    white_dn: float = 65535.0
    bend_per_dn: float = 0.0


@dataclass(frozen=True)
class Geometry:
    """How degrees at the eye become pixels: paper, section "Optical design"; optics first-order numbers.

    `measured_scale_per_dpt` is what a moved point source said of this one head (`calibration/dioptres.py`), if asked.
    """

    pitch_um: float
    diffuser_to_sensor_um: float
    angular_magnification: float
    measured_scale_per_dpt: float | None = None

    @property
    def px_per_deg(self) -> float:
        """Sensor pixels per degree of field at the eye (small angle, as in the paper's s = a f_d theta / 2)."""
        return self.angular_magnification * self.diffuser_to_sensor_um * float(np.pi) / 180 / self.pitch_um

    @property
    def scale_per_dpt(self) -> float:
        """Relative shrinking of the caustic per dioptre of myopia: as measured, else as the drawings say."""
        measured = self.measured_scale_per_dpt
        return self.nominal_scale_per_dpt if measured is None else measured

    @property
    def nominal_scale_per_dpt(self) -> float:
        """The same by the drawings: z a^2 (Fresnel scaling)."""
        return self.diffuser_to_sensor_um * 1e-6 * self.angular_magnification**2


@dataclass(frozen=True)
class Calibration:
    """What the factory measured about one head, once.

    `psfs` has one entry, or a stack over depth, for every colour or for each (`seen_in`); `dark_dn` and `flat` are
    (rows, cols) or None; `bad` marks pixels not to be believed; `field_deg` is the illuminated disc around the centre
    (None: not known).
    """

    psfs: tuple[Psf, ...]
    sensor: Sensor
    geometry: Geometry | None = None
    field_deg: float | None = None
    dark_dn: Image | None = None
    flat: Image | None = None
    bad: Mask | None = None
    simulated: bool = False

    def __post_init__(self) -> None:
        if not self.psfs:
            raise PsfError("a calibration without a PSF cannot reconstruct anything")
        if len({psf.shape for psf in self.psfs}) > 1:
            raise PsfError("the PSFs of one stack must all have the same rows and columns")
        _freeze(self, "dark_dn", "flat", "bad")

    def seen_in(self, colour: Colour) -> Self:
        """The same with the PSFs of one colour only; a colour that nobody measured is seen through the first PSF.

        What is left is one PSF, or a stack over depth: which of these explains a frame is asked of the frame.
        """
        own = tuple(psf for psf in self.psfs if psf.colour == colour)
        every = tuple(psf for psf in self.psfs if psf.colour is None)
        return replace(self, psfs=own or every or self.psfs[:1])

    @property
    def id(self) -> str:
        """Sixteen hexadecimal digits that change whenever anything that was measured changes."""
        colours = tuple(psf.colour for psf in self.psfs)
        digest = hashlib.sha256(repr((self.sensor, self.geometry, self.field_deg, colours)).encode())
        for array in (*(psf.pixels for psf in self.psfs), self.dark_dn, self.flat, self.bad):
            digest.update(b"-" if array is None else repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class Report:
    """How a picture was made; its fields are the keys of `report.json`."""

    method: str
    bin: int = 1
    rounds: int = 1
    stopped: str = "done"
    seconds: dict[str, float] = field(default_factory=dict)
    psf_index: int = 0
    psf_scale: float = 1.0
    refraction_dpt: dict[str, float] | None = None
    regularisation: dict[str, Any] = field(default_factory=dict)
    noise_dn: float | None = None
    residual: float | None = None
    quality: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reconstruction:
    """A picture of the retina: linear float32, rows x cols (x 3) of the sensor, and the report of its making."""

    picture: Image
    report: Report
    simulated: bool

    def __post_init__(self) -> None:
        check_image_shape(self.picture.shape)
        _freeze(self, "picture")


@dataclass(frozen=True)
class Capture:
    """One kept press: its name, eye, moment, the report, and the SHA-256 of each kept file by file name."""

    id: str
    eye: Eye
    taken_at: datetime
    simulated: bool
    calibration_id: str
    report: dict[str, Any]
    files: dict[str, str]

    @classmethod
    def named(cls, taken_at: datetime, eye: Eye, token: str) -> str:
        """The name of a capture: sorts by time, says the eye, and never repeats."""
        return f"{taken_at:%Y%m%dT%H%M%S}-{eye}-{token}"

    def with_files(self, files: dict[str, str]) -> Self:
        """The same capture with the digests of its files."""
        return type(self)(self.id, self.eye, self.taken_at, self.simulated, self.calibration_id, self.report, files)
