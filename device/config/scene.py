"""Scene of a simulated head: table [sim] with object, eye, light, sensor and calibration.

Every default is the absence of an effect, so a scene file holds only its effects.
"""

from math import hypot
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from device import plugins
from device.config.toml_file import Table, check_table

WIDEST_GAZE_DEG = 30.0
STEEPEST_RETINA_DEG = 30.0
FARTHEST_RETINA_UM = 3000.0
MAX_PEAK_E = 1e7
T = TypeVar("T", bound=Table)


class ObjectSpec(Table):
    """Object of a scene. Lengths on a screen or print are measured on its surface, at the eye's focal length.

    `retina` is drawn from the scene's seed with these numbers of lesions and these pigments (OPTICS.md 4.8); `image` is
    a photograph; `dots` are a lattice of discs; `ruler` has a tick every `ticks_um`, bright on dark (positive) or dark
    on bright (negative); `point` is one disc of `dot_um`; `chart` is the printed retina of the model eye
    (device/optics/retina_chart.py), which the field crops. All are moved by `at_deg` (right, down). `size_deg` is the
    width of a drawn retina or photograph; None: as wide as the field needs. `cut_deg` (right, down) cuts a retina or
    photograph to a rectangle in the middle of the field, as a photograph whose disc is cut at top and bottom; a
    photograph then keeps its shape and has the rectangle's width, else its central square fills the field.
    """

    kind: Literal["retina", "image", "dots", "ruler", "point", "chart"] = "retina"
    haemorrhages: int = Field(default=0, ge=0, le=1000)
    microaneurysms: int = Field(default=0, ge=0, le=1000)
    exudates: int = Field(default=0, ge=0, le=1000)
    melanin: float = Field(default=0.0, ge=-3, le=3)  # standard deviations of a population above its mean
    macular_pigment: float = Field(default=1.0, ge=0, le=3)  # relative to the mean eye
    haemoglobin: float = Field(default=1.0, ge=0, le=3)  # of the blood, relative to the mean eye
    image: Path | None = None
    dot_um: float = Field(default=275.0, gt=0, le=5000)
    dots_apart_um: float = Field(default=2000.0, gt=0, le=20000)
    half_size_um: tuple[float, float] = (12000.0, 6000.0)  # of the lattice: right, down
    polarity: Literal["positive", "negative"] = "positive"
    length_um: float = Field(default=15000.0, gt=0, le=50000)
    ticks_um: float = Field(default=1000.0, gt=0, le=10000)
    stroke_um: float = Field(default=220.0, gt=0, le=5000)
    at_deg: tuple[float, float] = (0.0, 0.0)
    size_deg: float | None = Field(default=None, gt=0, lt=120)
    cut_deg: tuple[float, float] | None = None

    @field_validator("cut_deg")
    @classmethod
    def _check_cut(cls, cut_deg: tuple[float, float] | None) -> tuple[float, float] | None:
        """Return the cut unchanged; ValueError unless both sides are above 0 and below 120 degrees."""
        if cut_deg is not None and not all(0 < side < 120 for side in cut_deg):
            raise ValueError(f"sides above 0 and below 120 degrees, not {cut_deg}")
        return cut_deg

    @field_validator("image")
    @classmethod
    def _relative_to_scene_file(cls, image: Path | None, info: ValidationInfo) -> Path | None:
        """Return the path resolved relative to the scene file; ValueError if there is no such file."""
        path = image if image is None or info.context is None else info.context["folder"] / image
        if path is not None and not path.is_file():
            raise ValueError(f"there is no image {path}; give the path of a photograph")
        return path

    @model_validator(mode="after")
    def _check_image(self) -> "ObjectSpec":
        """Raise ValueError unless the key `image` is given for kind "image", and only for it."""
        if self.kind == "image" and self.image is None:
            raise ValueError('kind = "image" needs the key image, the path of a photograph')
        if self.kind not in ("image", "retina") and self.cut_deg is not None:
            raise ValueError(f'the key cut_deg goes with kind = "retina" or "image", not with "{self.kind}"')
        if self.kind != "image" and self.image is not None:
            raise ValueError(f'the key image goes with kind = "image", not with "{self.kind}"')
        return self


class EyeSpec(Table):
    """Eye in front of the instrument, and the surface that it shows.

    `shown_by`: `screen` is self-luminous; `print` is paper lit by the ring; `model eye` and `human eye` have a lit
    fundus. Refraction (M, J0, J45) as wavefront: positive M is myopia. A `flat` surface is the paper's screen, a
    `curved` one follows the eye's focus. `axial_um` is the distance of the pupil from the relay's focus, `decentred_um`
    its distance from the axis. Oblique astigmatism, accommodation, tilted retina and tear film: OPTICS.md 3.10.
    """

    shown_by: Literal["screen", "print", "model eye", "human eye"] = "model eye"
    surface: Literal["curved", "flat"] = "curved"
    focal_length_um: float = Field(default=25000.0, ge=10000, le=60000)
    m_dpt: float = Field(default=0.0, ge=-20, le=20)
    j0_dpt: float = Field(default=0.0, ge=-6, le=6)
    j45_dpt: float = Field(default=0.0, ge=-6, le=6)
    pupil_um: float = Field(default=7700.0, ge=1000, le=9000)
    decentred_um: float = Field(default=0.0, ge=0, le=5000)
    axial_um: float = Field(default=0.0, ge=-20000, le=20000)
    walks: bool = False  # beam walk over the iris at wide angles, as the paper measured (OPTICS.md 1.4)
    gaze_deg: tuple[float, float] = (0.0, 0.0)  # right, down
    drift_deg_per_s: float = Field(default=0.0, ge=0, le=200)
    torsion_deg_per_s: float = Field(default=0.0, ge=-100, le=100)  # counter-clockwise in the picture
    blinks_per_min: float = Field(default=0.0, ge=0, le=120)  # of 0.25 s each
    oblique_dpt: float = Field(default=0.0, ge=0, le=10)  # tangential minus sagittal power, 30 degrees off the axis
    accommodation_slope: float = Field(default=0.0, ge=0, le=1.2)  # of the response over the demand; 0: cycloplegia
    accommodation_lead_dpt: float = Field(default=0.0, ge=0, le=3)  # response without demand
    accommodation_amplitude_dpt: float = Field(default=10.0, ge=0, le=15)  # largest response
    fixation_dpt: float = Field(default=0.0, ge=0, le=10)  # nearness of the fixation target, 1 / distance
    retina_tilt_deg: tuple[float, float] = (0.0, 0.0)  # positive: deeper to the right, and below
    retina_decentred_um: tuple[float, float] = (0.0, 0.0)  # centre of curvature, to the right and down
    tear_film_per_s: float = Field(default=0.0, ge=0, le=0.2)  # share of the light scattered, per second of break-up
    tear_film_deg: float = Field(default=0.3, ge=0.05, le=2)  # sigma of the scattered light at the eye
    breakup_s: float = Field(default=10.0, ge=0, le=60)  # from a blink to the break-up of the tear film
    since_blink_s: float = Field(default=0.0, ge=0, le=60)  # from the last blink to the exposure

    @field_validator("gaze_deg")
    @classmethod
    def _check_gaze(cls, gaze_deg: tuple[float, float]) -> tuple[float, float]:
        """Raise ValueError for a gaze of more than 30 degrees."""
        if hypot(*gaze_deg) > WIDEST_GAZE_DEG:
            raise ValueError(f"a gaze of {gaze_deg} is {hypot(*gaze_deg):.1f} deg off; allowed: {WIDEST_GAZE_DEG:g}")
        return gaze_deg

    @field_validator("retina_tilt_deg", "retina_decentred_um")
    @classmethod
    def _check_retina(cls, value: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        """Return a tilt of at most 30 degrees, or a decentration of at most 3 mm, unchanged; ValueError for more."""
        most, unit = (
            (STEEPEST_RETINA_DEG, "deg") if info.field_name == "retina_tilt_deg" else (FARTHEST_RETINA_UM, "um")
        )
        if not hypot(*value) <= most:
            raise ValueError(f"{value} is {hypot(*value):g} {unit}; allowed: {most:g}")
        return value


class LightFlaws(Table):
    """Flaws of the illumination: ambient and stray light, ghost, reflex, unequal or pulsed LEDs, falloff."""

    ambient: float = Field(default=0.0, ge=0, le=10)  # light without the lamp, share of the mean signal
    stray: float = Field(default=0.0, ge=0, le=10)  # even light with the lamp, share of the mean signal
    stray_gradient: float = Field(default=0.0, ge=0, le=10)  # of even light: from 0 at the left edge to this, right
    ghost: float = Field(default=0.0, ge=0, le=1)  # of the light, in a second image by the beam splitter
    ghost_deg: tuple[float, float] = (2.0, 1.0)  # displacement of the second image, right and down
    polariser_leak: float = Field(default=0.0, ge=0, le=1)  # of the corneal reflex, through crossed polarisers
    ring_um: float = Field(default=9500.0, gt=0, le=20000)  # diameter of the LED ring, before the relay
    led_spread: float = Field(default=0.0, ge=0, le=1)  # from one LED of the ring to the next
    pwm_hz: float = Field(default=0.0, ge=0, le=1e6)  # pulses that dim the LEDs; 0: a constant current
    pwm_duty: float = Field(default=0.5, gt=0, le=1)  # share of the time in which a pulsed LED is on
    ring_offset_um: float = Field(default=0.0, ge=-50000, le=50000)  # of the ring from the pupil's conjugate plane
    dead_led: int | None = Field(default=None, ge=0, le=255)  # this LED of the ring stays dark
    falloff: bool = False  # Lambert and the eye's cos^3 towards the field's edge (OPTICS.md 3.5)
    vignette_deg: float | None = Field(default=None, gt=0, le=180)  # angle of exp(-1), in addition to falloff


class SensorFlaws(Table):
    """Flaws of the sensor: fixed patterns, dust, dark current, hot pixels, nonlinearity, rolling shutter, mosaic."""

    prnu: float = Field(default=0.0, ge=0, le=0.2)  # spread of the pixels' response
    dsnu_e: float = Field(default=0.0, ge=0, le=1000)
    column_noise_e: float = Field(default=0.0, ge=0, le=1000)  # spread of the columns' offsets
    gain_step: float = Field(default=0.0, ge=-0.5, le=0.5)  # of the right half, since the flat frame
    dust_spots: int = Field(default=0, ge=0, le=1000)  # shadows, since the flat frame
    dust_um: float = Field(default=200.0, gt=0, le=5000)  # diameter of a shadow
    dust_shade: float = Field(default=0.35, ge=0, le=1)  # share of the light that a shadow takes
    dark_e_per_s: float = Field(default=0.0, ge=0, le=1e5)  # at 25 C
    dark_doubling_c: float = Field(default=7.0, gt=0, le=100)
    hot_pixels: float = Field(default=0.0, ge=0, le=0.05)  # their share
    nonlinearity: float = Field(default=0.0, ge=-0.2, le=0.2)  # quadratic, at full well
    line_s: float = Field(default=0.0, ge=0, le=1e-3)  # from one row to the next, of a rolling shutter
    bayer: bool = False  # a colour sensor under one colour of light


class ElementFlaws(Table):
    """Flaws of lenslets at the iris (OPTICS.md 2.9): as made, which a calibration sees, and changes since then."""

    focal_spread: float = Field(default=0.0, ge=0, le=0.3)  # standard deviation of the focal lengths, relative
    surface_waves: float = Field(default=0.0, ge=0, le=1)  # rms wavefront error of each lens, wavelengths
    centre_um: float = Field(default=0.0, ge=0, le=50)  # standard deviation of the centres along each axis
    moved_um: float = Field(default=0.0, ge=0, le=50)  # of the centres since the calibration
    dust_grains: int = Field(default=0, ge=0, le=100)  # opaque, on the lenses since the calibration
    dust_um: float = Field(default=150.0, gt=0, le=2000)  # diameter of a grain

    @property
    def since(self) -> dict[str, float]:
        """Values of the keys that state changes since the calibration."""
        return self.model_dump(include={"moved_um", "dust_grains", "dust_um"})


class CalibrationSpec(Table):
    """Conditions of the simulated PSF measurement: refraction of the eye, source size, diffuser distance (or None)."""

    m_dpt: float = Field(default=0.0, ge=-20, le=20)
    j0_dpt: float = Field(default=0.0, ge=-6, le=6)
    j45_dpt: float = Field(default=0.0, ge=-6, le=6)
    source_um: float = Field(default=0.0, ge=0, le=2000)  # of the dot, on the screen
    diffuser_to_sensor_um: float | None = Field(default=None, gt=0)


def _require_installed(effect: str) -> str:
    """Return the name of an effect of an installed package; ValueError if no package declares it. Nothing is loaded."""
    known = plugins.installed(plugins.EFFECTS)
    if effect not in known:
        raise ValueError(
            f"no installed package has the effect '{effect}' (installed: {', '.join(known) or 'none'}); install the "
            f"package that declares it under {plugins.EFFECTS}, or remove this table"
        )
    return effect


def _require_tables(effects: object) -> object:
    """Return the tables of effects unchanged; ValueError unless each is a table, which may be empty."""
    for name, table in effects.items() if isinstance(effects, dict) else [("NAME", effects)]:
        if not isinstance(table, dict):
            raise ValueError(f"an effect of a plug-in has a table [sim.effects.{name}], not {table!r}")
    return effects


def _check_peak(peak_e: object) -> object:
    """Return a peak unchanged; ValueError unless it is "budget" or a number above 0 and up to MAX_PEAK_E."""
    number = isinstance(peak_e, int | float) and not isinstance(peak_e, bool) and 0 < peak_e <= MAX_PEAK_E
    if peak_e != "budget" and not number:
        raise ValueError(
            f'{peak_e!r} is neither a number of electrons above 0 and up to {MAX_PEAK_E:g} nor "budget"; give the '
            'electrons of the brightest pixel, or "budget" for a human eye in the light of the head\'s LEDs'
        )
    return peak_e


EffectTables = Annotated[
    dict[Annotated[str, AfterValidator(_require_installed)], dict[str, object]], BeforeValidator(_require_tables)
]


class SimSpec(Table):
    """Scene: object, eye, light, sensor, flaws of lenslets, and calibration of a simulated head.

    `peak_e` is the charge of the brightest pixel in one exposure in green at full drive, electrons; "budget" takes the
    light of a human eye from the light budget of the head's LEDs, their measured light if the head file has it
    (OPTICS.md 4.7). `effects` has a table for each effect of a plug-in that the scene uses, [sim.effects.NAME]; the
    plug-in checks its keys.
    """

    seed: int = 1
    peak_e: Annotated[float | Literal["budget"], BeforeValidator(_check_peak)] = 15000.0
    object: ObjectSpec = ObjectSpec()
    eye: EyeSpec = EyeSpec()
    light: LightFlaws = LightFlaws()
    sensor: SensorFlaws = SensorFlaws()
    element: ElementFlaws = ElementFlaws()
    calibration: CalibrationSpec = CalibrationSpec()
    effects: EffectTables = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_budget(self) -> "SimSpec":
        """Raise ValueError for the light of a budget without a human eye: screens, prints and model eyes have none."""
        if self.peak_e == "budget" and self.eye.shown_by != "human eye":
            raise ValueError(
                f'peak_e = "budget" is the light of a human eye, not of a {self.eye.shown_by}; set shown_by = '
                '"human eye" in [sim.eye], or give peak_e as a number of electrons'
            )
        return self

    def __hash__(self) -> int:
        """Return the hash of all values as JSON: the tables of effects are mappings, which have none of their own."""
        return hash(self.model_dump_json())

    def effect_settings(self, name: str, kind: type[T]) -> T:
        """Return the table [sim.effects.NAME] as a `kind`, with its defaults if the scene has no such table.

        SpecError for an unknown key or a value out of its range.
        """
        return check_table(self.effects.get(name, {}), kind, f"sim.effects.{name}")
