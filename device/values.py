"""Frozen value types of the instrument: validated on construction, arrays read-only."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError, PsfError, SettingError

Counts = NDArray[np.uint16]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

Colour = Literal["red", "green", "blue", "amber"]
Eye = Literal["OD", "OS"]
RefractionZero = Literal["trial lens", "point source", "relative"]
EYES: tuple[Eye, ...] = ("OD", "OS")


@dataclass(frozen=True)
class _JsonType:
    """Marker of a number or truth value of a record, for pydantic: read from JSON as it is, never converted.

    A whole number stays whole, a text or a truth value is no number; numpy scalars become plain numbers.
    """

    name: Literal["number", "integer", "boolean"]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        kinds = {float: int | float}
        inner = handler.generate_schema(kinds.get(source, source))
        for one in inner.get("choices", [inner]):
            one["strict"] = True
        return {"type": "function-before", "function": {"type": "no-info", "function": _plain_scalar}, "schema": inner}

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> Any:
        return {"type": self.name}


def _plain_scalar(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


Number = Annotated[float, _JsonType("number")]
Whole = Annotated[int, _JsonType("integer")]
Flag = Annotated[bool, _JsonType("boolean")]


def _is_empty(value: object) -> bool:
    return value is None or value == ()


OMITTED_IF_EMPTY = {"exclude_if": _is_empty}  # metadata of an entry that the record of a capture has only with a value


# Configuration of a record for pydantic: the text below a field describes its key, and every key is written.
DESCRIBED = {"use_attribute_docstrings": True, "json_schema_serialization_defaults_required": True}


class SimulatedCounts(np.ndarray[tuple[int, ...], np.dtype[np.uint16]]):
    """Counts of the simulator, uint16: views, copies and results of arithmetic keep the type, and thus the mark."""


def _freeze(owner: object, *names: str) -> None:
    """Replace the named arrays of a frozen value by read-only views; data are not copied, and None is skipped."""
    for name in names:
        array = getattr(owner, name)
        if array is not None:
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(owner, name, view)


@dataclass(frozen=True)
class Illumination:
    """Illumination by the lamp: one colour at a level above 0 and up to 1 (full drive), else SettingError."""

    colour: Colour
    level: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.level <= 1:
            raise SettingError(f"a lamp level of {self.level} is not between 0 and 1")


@dataclass(frozen=True)
class BatteryState:
    """State of the battery: charge as a fraction, 0 to 1, and voltage."""

    fraction: float
    volts: float


@dataclass(frozen=True)
class HeadIdentity:
    """Identity of an optical head: serial number, and content hash of its calibration."""

    serial: str
    calibration_id: str


@dataclass(frozen=True)
class ExposureSettings:
    """Settings of one exposure: the exposure time, above 0 and up to 10 s, else SettingError."""

    exposure_s: float

    def __post_init__(self) -> None:
        if not 0 < self.exposure_s <= 10:
            raise SettingError(f"an exposure of {self.exposure_s} s is not between 0 and 10 s")


@dataclass(frozen=True)
class SimulatedEffects:
    """Effects that the simulator put into a picture."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    names: tuple[str, ...]
    """Names of these effects, in the order of the light path."""

    known: Whole
    """Number of effects that the simulator knows: the others would have changed nothing that can be seen."""


@dataclass(frozen=True)
class Frame:
    """Raw sensor frame: uint16 counts, (rows, cols) or (rows, cols, 3), in DN, with its exposure time and number.

    `illumination` is the light during the exposure (None: not lit throughout). `simulated` marks a frame that shows no
    real eye; it must be copied to every result. `effects`: what the simulator put into it. FrameError for other counts.
    """

    counts: Counts
    exposure_s: float
    number: int
    illumination: Illumination | None
    simulated: bool
    effects: SimulatedEffects | None = None

    def __post_init__(self) -> None:
        check_image_shape(self.counts.shape)
        if self.counts.dtype != np.uint16:
            raise FrameError(f"a frame holds uint16 counts, not {self.counts.dtype}")
        _freeze(self, "counts")


def check_image_shape(shape: tuple[int, ...]) -> None:
    """Raise FrameError unless the shape is (rows, cols) or (rows, cols, 3) with at least one pixel."""
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3) or min(shape) < 1:
        raise FrameError(f"an image has rows and columns, and three channels or none; this has the shape {shape}")


@dataclass(frozen=True, eq=False)
class Psf:
    """Point spread function (PSF): image of one retinal point on the sensor.

    float32 (rows, cols), sum 1, centre at (rows//2, cols//2). Paper, section "Algorithm": the h of y = h * x. A shifted
    PSF shifts the picture and changes nothing else. `colour` is the light of the measurement; None: any colour. The
    constructor normalises the sum. PsfError for an empty image, values that are not finite, or a sum <= 0.
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
        """(rows, cols) of the PSF image."""
        rows, cols = self.pixels.shape
        return rows, cols


@dataclass(frozen=True)
class Sensor:
    """Sensor response: counts are `black_dn` + s (1 + `bend_per_dn` s), s = electrons / gain.

    The gain is `gain_e_per_dn`; a pixel of `white_dn` or more is saturated.
    """

    black_dn: float = 0.0
    gain_e_per_dn: float | None = None
    read_noise_e: float | None = None
    white_dn: float = 65535.0
    bend_per_dn: float = 0.0


LENS_RINGS = 3  # of the mean over a field; a tenth of them


@dataclass(frozen=True)
class Geometry:
    """Scale between degrees at the eye and pixels; paper, section "Optical design", first-order optics.

    `measured_scale_per_dpt` is the measured value of this head, from a moved point source (`calibration/dioptres.py`);
    None if not measured. `lens_focus_dpt` is the mean sphere of the eye for which its lenslets are in focus by the
    drawings, None: no lenslets; `lens_index` is the index of their plate, None: they have a flat field.
    """

    pitch_um: float
    diffuser_to_sensor_um: float
    angular_magnification: float
    measured_scale_per_dpt: float | None = None
    lens_focus_dpt: float | None = field(default=None, repr=False)  # a calibration without it keeps its identity
    lens_index: float | None = field(default=None, repr=False)

    @property
    def has_spots(self) -> bool:
        """Whether lenslets stand in the diffuser's place, so that the PSF is one spot for each."""
        return self.lens_focus_dpt is not None

    @property
    def px_per_deg(self) -> float:
        """Sensor pixels per degree of field at the eye (small angle, as in the paper's s = a f_d theta / 2)."""
        return self.angular_magnification * self.diffuser_to_sensor_um * float(np.pi) / 180 / self.pitch_um

    @property
    def scale_per_dpt(self) -> float:
        """Relative shrinking of the caustic per dioptre of myopia: measured, else nominal."""
        measured = self.measured_scale_per_dpt
        return self.nominal_scale_per_dpt if measured is None else measured

    def lens_excess_dpt(self, field_deg: float) -> NDArray[np.float64]:
        """Return the excess M, J0, J45 in dpt of lenslets at places that stand for a field of view, (places, 3).

        OPTICS.md 2.9: grows with the square of the tangent; places of equal area in LENS_RINGS rings.
        """
        if self.lens_index is None or self.lens_focus_dpt is None or field_deg == 0:
            return np.zeros((1, 3))
        squared = np.tan(np.deg2rad(self.angular_magnification * field_deg / 2)) ** 2
        power_dpt = 1e6 / (self.diffuser_to_sensor_um * self.angular_magnification**2) - self.lens_focus_dpt
        edge_dpt = squared / 2 * power_dpt * (2 + 1 / self.lens_index)
        rings = (np.arange(LENS_RINGS) + 0.5) / LENS_RINGS
        return np.stack([rings * edge_dpt, 0 * rings, 0 * rings], axis=1)

    @property
    def nominal_scale_per_dpt(self) -> float:
        """Relative shrinking of the caustic per dioptre of myopia by the drawings: z a^2 (Fresnel scaling)."""
        return self.diffuser_to_sensor_um * 1e-6 * self.angular_magnification**2


@dataclass(frozen=True)
class RefractionOffset:
    """Refraction that the head reports of an eye without any, as correcting lens, with standard deviations, dpt.

    Measured with trial lenses (`calibration/trial_lenses.py`); subtracted from every reported refraction.
    """

    m_dpt: float
    j0_dpt: float
    j45_dpt: float
    m_sd_dpt: float
    j0_sd_dpt: float
    j45_sd_dpt: float


@dataclass(frozen=True)
class WhiteReference:
    """Light of a white card before the head, in each colour of the ring at full drive, in DN per second.

    The mean over the sensor above the dark frame (`calibration/white_card.py`). It sets the hue of colour pictures.
    """

    dn_per_s: tuple[tuple[Colour, float], ...]


@dataclass(frozen=True)
class Calibration:
    """Measured or simulated calibration of one head.

    `psfs` has one entry or a stack over depth, for all colours or for each (`for_colour`); `dark_dn` (dark frame) and
    `flat` (flat frame) are (rows, cols) or None; `bad` marks defective pixels; `field_deg` is the diameter of the
    illuminated disc around the centre (None: not known); `soft_edge_deg` of a light that fades is the diameter at half
    of it, and the full width of the ramp (None: a sharp edge); `refraction_offset` is None if no trial lenses were
    shown, `white` if no white card was. `source_in_focus`: by its stated distance the point source stood in the focus
    of the model eye, and no earlier calibration contradicts (`calibration/procedure/refraction_zero.py`).
    PsfError without PSFs or for PSFs of different shapes.
    """

    psfs: tuple[Psf, ...]
    sensor: Sensor
    geometry: Geometry | None = None
    field_deg: float | None = None
    dark_dn: Image | None = None
    flat: Image | None = None
    bad: Mask | None = None
    simulated: bool = False
    refraction_offset: RefractionOffset | None = None
    white: WhiteReference | None = None
    source_in_focus: bool = False
    soft_edge_deg: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.psfs:
            raise PsfError("a calibration without a PSF cannot reconstruct anything")
        if len({psf.shape for psf in self.psfs}) > 1:
            raise PsfError("the PSFs of one stack must all have the same rows and columns")
        _freeze(self, "dark_dn", "flat", "bad")

    def for_colour(self, colour: Colour) -> Self:
        """Return the calibration with the PSFs of one colour only.

        Without PSFs of that colour, those that hold for any colour are kept, else the first PSF. The result has one PSF
        or a stack over depth; PSF selection chooses from a stack for each frame.
        """
        own = tuple(psf for psf in self.psfs if psf.colour == colour)
        every = tuple(psf for psf in self.psfs if psf.colour is None)
        return replace(self, psfs=own or every or self.psfs[:1])

    @property
    def has_spots(self) -> bool:
        """Whether the PSF is one spot for each of the lenslets; False without a geometry."""
        return self.geometry is not None and self.geometry.has_spots

    @property
    def refraction_zero(self) -> RefractionZero:
        """Origin of the zero of refractions: trial lenses, the point source, or "relative": nothing fixes it."""
        if self.refraction_offset is not None:
            return "trial lens"
        return "point source" if self.source_in_focus else "relative"

    @property
    def id(self) -> str:
        """Identity by content: the first sixteen hexadecimal digits of the SHA-256 of all values and arrays."""
        colours = tuple(psf.colour for psf in self.psfs)
        digest = hashlib.sha256(repr((self.sensor, self.geometry, self.field_deg, colours)).encode())
        for array in (*(psf.pixels for psf in self.psfs), self.dark_dn, self.flat, self.bad):
            digest.update(b"-" if array is None else repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        # A calibration without them keeps its identity.
        for later in (self.refraction_offset, self.white, self.soft_edge_deg):
            if later is not None:
                digest.update(repr(later).encode())
        if self.source_in_focus:
            digest.update(b"source in focus")
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class FrameUse:
    """What became of one frame of a burst."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    index: Whole
    """Place of the frame in the burst, from 0: file raw.tiff is the frame 0, raw-1.tiff the frame 1."""

    used: Flag
    """True if the picture has the light of this frame."""

    shift_px: tuple[Number, Number] | None
    """Rows and columns: what is at (r, c) of the reference, the first used frame of the channel, stands at (r, c) plus
    this in the frame, in pixels of the sensor. Null if the frame was not registered."""

    weight: Number
    """Share of the frame in the joined frame, 0 to 1."""

    reason: str | None = None
    """Reason why the frame is not used; null if it is."""


ONLY_FRAME = FrameUse(0, True, (0.0, 0.0), 1.0)  # a picture of one frame


@dataclass(frozen=True)
class ChannelUse:
    """What became of one colour of light; its raw frame in red is the file raw-red.tiff."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    name: Colour
    """Colour of the light."""

    shift_px: tuple[Number, Number] | None
    """Rows and columns: what is at (r, c) of the reference, green or else the first, stands at (r, c) plus this in this
    channel, in pixels of the raw. Null for a predicted or a missing channel."""

    predicted: Flag = False
    """True if the channel was computed from the others, not measured."""

    reason: str | None = None
    """Why the picture has not this colour; null for one that it has."""

    white_ratio: Number | None = field(default=None, metadata=OMITTED_IF_EMPTY)
    """Light of its frame over that of a white card in the same lamp light. Null without a white reference in the
    calibration: the hue is then neutral, that of an average retina."""

    code: str | None = field(default=None, metadata=OMITTED_IF_EMPTY)
    """Name of this reason for programs: the code of an error, colour.psf (no PSF of this colour) or colour.interrupted;
    null for a colour that the picture has."""


@dataclass(frozen=True)
class Verdict:
    """Verdict for the operator on a frame or a picture."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    word: str | None = None
    """"good" or "again"."""

    code: str | None = None
    """Cause of the verdict, for example shot.moved; null if good."""

    numbers: Mapping[str, Any] = field(default_factory=dict)
    """Known figures, to four significant digits."""

    @property
    def is_good(self) -> bool:
        """Return whether the picture is good."""
        return self.word == "good"


@dataclass(frozen=True)
class Report:
    """Report of a reconstruction, whose fields are the keys of `report.json`.

    Units are in the names; a name without a unit is a ratio. The keys inside of the mappings, and the JSON
    schema, are in `services/research/report_schema.py`, which takes the descriptions of the fields from
    here.
    """

    __pydantic_config__: ClassVar[Mapping[str, bool]] = DESCRIBED

    method: str
    """Method of the picture, as listed by `diffuscope methods`; "none" if no picture was made."""

    bin: Whole = 1
    """Side in sensor pixels of the square that was averaged to one sample before solving."""

    rounds: Whole = 1
    """Rounds of the iterative solver that the picture has; 1 for a closed form, 0 without a picture."""

    stopped: str = "done"
    """Reason of the end: "done", "deadline" (the next round did not fit into the time budget), or an error code."""

    seconds: dict[str, Number] = field(default_factory=dict)
    """Durations of the stages in s."""

    psf_index: Whole = 0
    """Index of the PSF that was used, in the order in which several PSFs were given; 0 for the first."""

    psf_scale: Number = 1.0
    """Isotropic scale of the stored PSF that explains the frame; 1: as calibrated."""

    psf_cylinder: dict[str, Number | None] | None = field(default=None, metadata=OMITTED_IF_EMPTY)
    """Cylinder by which the PSF was warped beside its scale, and the predicted gain of the picture; null without
    one."""

    refraction_dpt: dict[str, Number | str | None] | None = None
    """Refraction of the eye as correction at its pupil in dpt, negative for myopia; null without a known geometry."""

    refraction_scatter: dict[str, Number] | None = field(default=None, metadata=OMITTED_IF_EMPTY)
    """Scatter of the mean sphere between the frames of a burst; null for less than three frames."""

    regularisation: dict[str, Any] = field(default_factory=dict)
    """Parameters of the solver, most of them chosen from the frame; the keys depend on the method."""

    noise_dn: Number | None = None
    """Standard deviation of the noise of one sensor pixel, in DN, at the mean light of the frame; of a burst: of the
    average of its frames, in DN of one exposure."""

    residual: Number | None = None
    """Rms of frame minus forward model in units of the noise; 1: only noise is left. Null if not computed."""

    quality: dict[str, Any] = field(default_factory=dict)
    """Figures of frame and picture; null for a figure that is not valid for this frame."""

    warnings: tuple[str, ...] = ()
    """Sentences for the operator, in English, the most useful first; the wording is not stable."""

    frames: tuple[FrameUse, ...] = (ONLY_FRAME,)
    """What became of each frame of the burst, in its order; one entry for one frame."""

    channels: tuple[ChannelUse, ...] = field(default=(), metadata=OMITTED_IF_EMPTY)
    """Colours of light of a colour picture; empty for a grey one."""


@dataclass(frozen=True)
class Reconstruction:
    """Reconstructed picture of the retina, with its report.

    Attributes
    ----------
    picture
        Linear float32, (rows, cols) or (rows, cols, 3) of the sensor, in DN of one exposure; of a burst, in
        DN of its first used frame.
    report
        Figures of the reconstruction.
    simulated
        True for a picture that shows no real eye.
    """

    picture: Image
    report: Report
    simulated: bool

    def __post_init__(self) -> None:
        check_image_shape(self.picture.shape)
        _freeze(self, "picture")
