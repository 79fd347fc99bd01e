"""What a simulated head looks at, and with what flaws: the table [sim] of a head, which makes it a scene.

Every default is the absence of an effect, so a scene says only what it is about.
"""

from math import hypot
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from device.tables import Table

WIDEST_GAZE_DEG = 30.0


class ObjectSpec(Table):
    """What is looked at. Lengths on a screen or print count at its surface, behind the eye's focal length.

    `retina` is drawn from the scene's seed with so many lesions; `image` is a photograph of one; `dots` are a lattice
    on a screen, `ruler` has a tick every `ticks_um`, bright on dark (positive) or dark on bright (negative); `point` is
    one disc. All are moved to `at_deg` (right, down). `size_deg` is how wide a retina is drawn or a photograph shown;
    None: as wide as the field needs.
    """

    kind: Literal["retina", "image", "dots", "ruler", "point"] = "retina"
    haemorrhages: int = Field(default=0, ge=0, le=1000)
    microaneurysms: int = Field(default=0, ge=0, le=1000)
    exudates: int = Field(default=0, ge=0, le=1000)
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

    @field_validator("image")
    @classmethod
    def _from_the_scene_file(cls, image: Path | None, info: ValidationInfo) -> Path | None:
        path = image if image is None or info.context is None else info.context["folder"] / image
        if path is not None and not path.is_file():
            raise ValueError(f"there is no image {path}; give the path of a photograph")
        return path

    @model_validator(mode="after")
    def _image_is_given(self) -> "ObjectSpec":
        if self.kind == "image" and self.image is None:
            raise ValueError('kind = "image" needs the key image, the path of a photograph')
        if self.kind != "image" and self.image is not None:
            raise ValueError(f'the key image goes with kind = "image", not with "{self.kind}"')
        return self


class EyeSpec(Table):
    """The eye in front of the instrument, and how its background is shown.

    `screen` shines by itself; `print` is paper lit by the ring; `model eye` and `human eye` have a lit fundus.
    Refraction as wavefront, positive M is myopia. A `flat` surface is the paper's screen, a `curved` one follows the
    eye's focus. `axial_um` is how far the pupil is from the relay's focus, `decentred_um` how far off its axis.
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
    walks: bool = False  # whether the beam walks over the iris at wide angles, as the paper measured (optics.md 1.4)
    gaze_deg: tuple[float, float] = (0.0, 0.0)  # right, down
    drift_deg_per_s: float = Field(default=0.0, ge=0, le=200)

    @field_validator("gaze_deg")
    @classmethod
    def _can_be_held(cls, gaze_deg: tuple[float, float]) -> tuple[float, float]:
        if hypot(*gaze_deg) > WIDEST_GAZE_DEG:
            raise ValueError(f"a gaze of {gaze_deg} is {hypot(*gaze_deg):.1f} deg off; allowed: {WIDEST_GAZE_DEG:g}")
        return gaze_deg


class LightFlaws(Table):
    """What the light does besides its work, each as a share: of the mean signal, or of one LED's drive."""

    ambient: float = Field(default=0.0, ge=0, le=10)  # light without the lamp, share of the mean signal
    stray: float = Field(default=0.0, ge=0, le=10)  # even light with the lamp, share of the mean signal
    polariser_leak: float = Field(default=0.0, ge=0, le=1)  # of the corneal reflex, through crossed polarisers
    ring_um: float = Field(default=9500.0, gt=0, le=20000)  # diameter of the LED ring, before the relay
    led_spread: float = Field(default=0.0, ge=0, le=1)  # from one LED of the ring to the next
    ring_offset_um: float = Field(default=0.0, ge=-50000, le=50000)  # of the ring from the pupil's conjugate plane
    dead_led: int | None = Field(default=None, ge=0, le=255)  # this LED of the ring stays dark
    falloff: bool = False  # Lambert and the eye's cos^3 towards the field's edge (optics.md 3.5)
    vignette_deg: float | None = Field(default=None, gt=0, le=180)  # where exp(-1) of the light is left beside that


class SensorFlaws(Table):
    """What is wrong with the pixels."""

    prnu: float = Field(default=0.0, ge=0, le=0.2)  # spread of the pixels' response
    dsnu_e: float = Field(default=0.0, ge=0, le=1000)
    dark_e_per_s: float = Field(default=0.0, ge=0, le=1e5)  # at 25 C
    dark_doubling_c: float = Field(default=7.0, gt=0, le=100)
    hot_pixels: float = Field(default=0.0, ge=0, le=0.05)  # their share
    nonlinearity: float = Field(default=0.0, ge=-0.2, le=0.2)  # quadratic, at full well
    line_s: float = Field(default=0.0, ge=0, le=1e-3)  # from one row to the next, of a rolling shutter
    bayer: bool = False  # a colour sensor under one colour of light


class CalibrationSpec(Table):
    """How the stored PSF was taken, where that differs from the head: with which eye, through which dot, how far."""

    m_dpt: float = Field(default=0.0, ge=-20, le=20)
    j0_dpt: float = Field(default=0.0, ge=-6, le=6)
    j45_dpt: float = Field(default=0.0, ge=-6, le=6)
    source_um: float = Field(default=0.0, ge=0, le=2000)  # of the dot, on the screen
    diffuser_to_sensor_um: float | None = Field(default=None, gt=0)


class SimSpec(Table):
    """A scene: what is looked at, by which eye, in which light, with which sensor, against which calibration.

    `peak_e` is what the brightest green pixel collects in one exposure.
    """

    seed: int = 1
    peak_e: float = Field(default=15000.0, gt=0, le=1e7)
    object: ObjectSpec = ObjectSpec()
    eye: EyeSpec = EyeSpec()
    light: LightFlaws = LightFlaws()
    sensor: SensorFlaws = SensorFlaws()
    calibration: CalibrationSpec = CalibrationSpec()
