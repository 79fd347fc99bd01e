"""Rows of the grid: the defect of each frame, the messages that are true of the frame, and the explained losses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from device.config.head_file import CameraSpec
from device.values import Counts, Mask
from tests.hard import defects
from tests.hard.frames import Eye, Floats, HardFrame, above_dark, crescent_dark
from tests.paper.bench import with_changes

Build = Callable[[Eye], HardFrame]


@dataclass(frozen=True)
class Case:
    """One row: key, group (kind of defect, one block of rows), builder of the frame, true messages, explained losses.

    `true` holds the kinds of messages that are true of the frame (`judgement.KINDS`). `explained` gives, per method or
    for "all", the reason for a worse picture without a message.
    """

    key: str
    group: str
    build: Build
    true: frozenset[str] = frozenset()
    explained: Mapping[str, str] = field(default_factory=dict)


NO_GAPS = {"tikhonov": "The paper's form has no model of a gap: a masked pixel reads zero, and rings."}
MISSING = {
    "tikhonov": NO_GAPS["tikhonov"],
    "gradient": "A linear filter: a masked sample is filled from the smooth fit only.",
}
DIM = {"all": "Shot noise: with so few electrons no method has the detail; the resolution figure says so."}
BLURRED = {"all": "The blur of the motion is in the object: one frame cannot tell it from a smooth eye."}
BANDS = dict.fromkeys(
    ("tikhonov", "gradient", "evidence"),
    "A closed form has no residual that would tell bands of the lamp from lines of the object: it only reports them.",
)
NO_RESIDUAL = dict.fromkeys(
    ("tikhonov", "gradient", "evidence"), "A closed form has no residual, in which light that is no image would stand."
)
UNEVEN = {
    "gradient": "This closed form has no background: uneven stray light becomes structure.",
    "evidence": "A closed form has no residual, and on a sensor that the disc fills only its edge shows the gradient.",
    "tikhonov": "The paper's form has no constant for light from everywhere: it becomes structure.",
}
CUT_PUPIL = dict.fromkeys(
    ("tikhonov", "gradient", "evidence"), "A closed form has no residual, and is not solved again behind the pupil."
)
PATTERN = dict.fromkeys(
    ("tikhonov", "gradient", "evidence"),
    "A closed form takes gain and offset of each pixel as calibrated, not as seen.",
)
NO_TEST = dict.fromkeys(("tikhonov", "gradient"), "This closed form has no test of the PSF; the default has one.")
PEDESTAL = {"tikhonov": "The paper's form has no constant for light from everywhere: it becomes structure."}
HALF_LIGHT = {"all": "Half the electrons for the same counts: the shot noise is larger by the root of 2."}
EVEN = {"gradient": "This closed form has no constant for stray light: an even frame gives an even picture."}
CUT = {"gradient": "This closed form fits no shading: the dark part of the field is taken from its brightness."}
OTHER_EYE = {
    "tikhonov": "The paper's form uses the stored PSF: the blur circle of the other eye stays.",
}


def saturated(share: float) -> Build:
    """Return the builder of a frame with `share` (0 to 1) of the pixels saturated, by more light."""

    def build(eye: Eye) -> HardFrame:
        full = float(np.quantile(eye.expected_e, 1 - share))
        return eye.frame({"sim.peak_e": eye.peak_e * eye.spec.camera.full_well_e / full})

    return build


def undeclared(where: Callable[[tuple[int, int]], Mask]) -> Build:
    """Return the builder of a frame with dead pixels (count 0, mask by `where`) that no file declares."""
    return lambda eye: eye.clean.with_raw(defects.read_as(eye.clean.raw, where(_shape(eye)), 0))


def declared(where: Callable[[tuple[int, int]], Mask]) -> Build:
    """Return the builder of a frame with dead pixels (count 0) and a flat frame with NaN there."""

    def build(eye: Eye) -> HardFrame:
        mask = where(_shape(eye))
        return eye.clean.with_raw(defects.read_as(eye.clean.raw, mask, 0), flat=defects.declared(mask))

    return build


def warm(share: float, more: float) -> Build:
    """Return the builder of a frame with warm pixels and no matching dark frame.

    A `share` of the pixels is raised by `more` times the white level.
    """
    return lambda eye: eye.clean.with_raw(defects.warm(eye.clean.raw, eye.spec.camera, share, more))


def offset(more_dn: float) -> Build:
    """Return the builder of a frame with a black level `more_dn` (12-bit counts) above that of the head file."""

    def build(eye: Eye) -> HardFrame:
        camera = eye.spec.camera
        return eye.clean.with_raw(defects.offset(eye.clean.raw, camera, more_dn * 2.0 ** (camera.bit_depth - 12)))

    return build


def flicker(share: float) -> Build:
    """Return the builder of a frame under a lamp that flickers with relative amplitude `share`.

    The flicker is sinusoidal (100 Hz), and the rows are read in 32 ms.
    """
    return lambda eye: eye.clean.with_raw(defects.flicker(eye.clean.raw, eye.spec.camera, share))


def bands(share: float) -> Build:
    """Return the builder of a frame with bands of +- `share` (rolling shutter, LEDs dimmed by pulses at 400 Hz)."""
    return lambda eye: eye.frame(
        {
            "camera.exposure_s": defects.banded_exposure_s(share),
            "sim.light.pwm_hz": defects.PWM_HZ,
            "sim.sensor.line_s": defects.READ_S / eye.spec.camera.rows,
        }
    )


def changed(**keys: float) -> Build:
    """Return the builder of a frame with other values of the scene, `eye__KEY`, `light__KEY` and `sensor__KEY`."""
    return lambda eye: eye.frame({f"sim.{key.replace('__', '.')}": value for key, value in keys.items()})


def columns(spread_e: float) -> Build:
    """Return the builder of a frame whose columns of unmerged pixels have offsets of `spread_e` electrons."""
    return lambda eye: eye.frame({"sim.sensor.column_noise_e": spread_e * eye.merged**1.5})


def lines(of: Callable[[Counts, CameraSpec, float], Counts], share: float) -> Build:
    """Return the builder of a dim frame (250 electrons at the peak) with noise `of` its rows or columns."""

    def build(eye: Eye) -> HardFrame:
        dim = peak(250)(eye)
        return dim.with_raw(of(dim.raw, eye.spec.camera, share))

    return build


def order_of_rows(of: Callable[[Counts, float], Counts], share: float) -> Build:
    """Return the builder of a frame in which `share` of the rows is repeated or missing."""
    return lambda eye: eye.clean.with_raw(of(eye.clean.raw, share))


def gain(factor: float) -> Build:
    """Return the builder of a frame whose true gain (e-/DN) is `factor` times the gain in the head file.

    The mean counts are unchanged; the noise in DN differs.
    """

    def build(eye: Eye) -> HardFrame:
        well_e = eye.spec.camera.full_well_e * factor
        return eye.frame({"camera.full_well_e": well_e, "sim.peak_e": eye.peak_e * factor})

    return build


def of_eye(more_dpt: float) -> Build:
    """Return the builder of a frame with `more_dpt` added to the eye's mean sphere (positive: myopia), same PSF."""

    def build(eye: Eye) -> HardFrame:
        sim = eye.spec.sim
        assert sim is not None
        return eye.frame({"sim.eye.m_dpt": sim.eye.m_dpt + more_dpt})

    return build


def psf_of_eye(more_dpt: float) -> Build:
    """Return the builder of a frame with a PSF measured through a model eye of mean sphere `more_dpt` instead of 0."""
    return lambda eye: eye.frame({"sim.calibration.m_dpt": more_dpt})


def peak(peak_e: float) -> Build:
    """Return the builder of a frame whose brightest unmerged pixel collects `peak_e` electrons."""
    return lambda eye: eye.frame({"sim.peak_e": peak_e * eye.merged**2})


def stray(share: float) -> Build:
    """Return the builder of a frame with uniform stray light; `share` is its ratio to the mean signal."""
    return lambda eye: eye.frame({"sim.light.stray": share})


def motion(way_deg: float) -> Build:
    """Return the builder of a frame with eye motion at constant speed, `way_deg` degrees in the field per exposure."""
    return lambda eye: eye.frame({"sim.eye.drift_deg_per_s": way_deg / eye.spec.camera.exposure_s})


def given_field(field_deg: float) -> Build:
    """Return the builder of a frame whose head file states a lit disc of `field_deg` degrees."""
    return lambda eye: replace(eye.clean, head=with_changes(eye.clean.head, {"optics.field_deg": field_deg}))


def foreign_psf(eye: Eye) -> HardFrame:
    """Return a frame with the PSF of another diffuser of the same kind, or of another layout of lenslets."""
    sim = eye.spec.sim
    assert sim is not None
    head = "imx296_hexagonal" if eye.head == "imx296_lenslets" else eye.head
    other = replace(eye, head=head, changes=dict(eye.changes) | {"sim.seed": sim.seed + 100}).clean
    return replace(eye.clean, psf=other.psf, sphere_dpt=None)


def measured_psf(peak_e: float, changed: Callable[[Floats], Floats] = lambda psf_dn: psf_dn) -> Build:
    """Return the builder of a frame with a PSF as the camera takes it.

    Its brightest unmerged pixel has `peak_e` electrons; its counts without the black level are `changed`.
    """

    def build(eye: Eye) -> HardFrame:
        camera = eye.spec.camera
        psf_dn = defects.psf_counts(eye.clean.psf, camera, peak_e * eye.merged**2).astype(np.float64) - camera.black_dn
        counts = np.clip(np.rint(changed(psf_dn) + camera.black_dn), 0, camera.white_dn)
        return replace(eye.clean, psf=counts.astype(np.uint16))

    return build


def turned_psf(eye: Eye) -> HardFrame:
    """Return a frame with the head's PSF rotated by 180 degrees."""
    return replace(eye.clean, psf=np.ascontiguousarray(eye.clean.psf[::-1, ::-1]), sphere_dpt=None)


def no_light(eye: Eye) -> HardFrame:
    """Return a frame of zero counts."""
    return eye.clean.with_raw(np.zeros_like(eye.clean.raw), sphere_dpt=None)


def constant(eye: Eye) -> HardFrame:
    """Return a constant frame at a third of the converter's range."""
    raw = np.full_like(eye.clean.raw, eye.spec.camera.white_dn // 3)
    return eye.clean.with_raw(raw, sphere_dpt=None)


def not_numbers(share: float) -> Build:
    """Return the builder of a float frame with NaN in `share` of its pixels."""
    return lambda eye: eye.clean.with_raw(defects.missing(eye.clean.raw, share))


def _shape(eye: Eye) -> tuple[int, int]:
    return eye.spec.camera.rows, eye.spec.camera.cols


def _case(key: str, group: str, build: Build, true: str = "", explained: Mapping[str, str] | None = None) -> Case:
    return Case(key, group, build, frozenset(true.split()), explained or {})


CLEAN = _case("clean", "clean", lambda eye: eye.clean)
CASES: tuple[Case, ...] = (
    CLEAN,
    *(
        _case(f"{share:.1%} saturated", "too bright", saturated(share), "bright pixels", MISSING)
        for share in (0.001, 0.01, 0.04, 0.1)
    ),
    _case(
        "glare, 0.3 % clipped",
        "too bright",
        lambda eye: eye.clean.with_raw(defects.glare(eye.clean.raw, eye.spec.camera, 0.003)),
        "bright pixels",
        MISSING,
    ),
    *(
        _case(f"{name}, {kind}", "dead pixels", build(where), "pixels", MISSING)
        for name, where in (
            ("dead columns", defects.dead_columns),
            ("dead rows", defects.dead_rows),
            ("dead blob", defects.blob),
        )
        for kind, build in (("declared", declared), ("0 DN", undeclared))
    ),
    *(
        _case(
            f"warm, {share:.2%} + {more_dn} DN", "unknown warm pixels", warm(share, more_dn / 4095), "pixels", MISSING
        )
        for share, more_dn in ((0.0001, 1500), (0.001, 1500), (0.01, 300))
    ),
    *(_case(f"{peak_e} e- peak", "little light", peak(peak_e), "dim", DIM) for peak_e in (50, 100, 250, 500)),
    *(
        _case(f"eye off by {more_dpt:+g} dpt", "wrong PSF", of_eye(more_dpt), "", OTHER_EYE)
        for more_dpt in (0.5, -1, 2, -4)
    ),
    *(
        _case(f"eye off by {more_dpt:+g} dpt", "wrong PSF", of_eye(more_dpt), "far", OTHER_EYE)
        for more_dpt in (15, -15)
    ),
    _case("PSF off by 2 dpt", "wrong PSF", psf_of_eye(2.0), "", OTHER_EYE),
    _case("PSF of another head", "wrong PSF", foreign_psf, "psf far", NO_TEST),
    _case("PSF turned by 180 deg", "wrong PSF", turned_psf, "psf far", NO_TEST),
    _case("PSF of 30 e-", "wrong PSF", measured_psf(30), "psf misfit"),
    *(
        _case(f"PSF with {name}", "wrong PSF", measured_psf(15000, changed), "psf misfit")
        for name, changed in (
            ("stray gradient 10 %", lambda psf_dn: psf_dn + 0.1 * psf_dn.max() * np.linspace(0, 1, psf_dn.shape[1])),
            ("black level 100 DN too high", lambda psf_dn: np.maximum(psf_dn - 100, 0)),
            ("black level 100 DN too low", lambda psf_dn: psf_dn + 100),
            ("its peaks clipped at 10 %", lambda psf_dn: np.minimum(psf_dn, 0.1 * psf_dn.max())),
        )
    ),
    *(_case(f"field given as {deg:g} deg", "parts of the field", given_field(deg), "lit") for deg in (28, 31, 40)),
    _case("dark border", "parts of the field", lambda eye: eye.frame(shade=crescent_dark(0.0, 15.5)), "lit"),
    _case("rim cut", "parts of the field", lambda eye: eye.frame(shade=crescent_dark(5.0, 16.7)), "lit", CUT),
    _case(
        "half a lid",
        "parts of the field",
        lambda eye: eye.frame({"sim.light.stray": 0.5}, above_dark(0.0)),
        "lit eye misfit",
        PEDESTAL,
    ),
    *(_case(f"stray light {share:.0%}", "light", stray(share), "eye bright", PEDESTAL) for share in (0.2, 1.0)),
    *(_case(f"motion {deg:g} deg", "light", motion(deg), "", BLURRED) for deg in (0.5, 1.5)),
    *(_case(f"flicker {100 * share:g} %", "light", flicker(share), "misfit", BANDS) for share in (0.02, 0.1)),
    *(_case(f"LED bands {100 * share:g} %", "light", bands(share), "misfit", BANDS) for share in (0.015, 0.05)),
    *(_case(f"gain step {step:.0%}", "sensor", changed(sensor__gain_step=step), "step") for step in (0.01, 0.03)),
    _case(
        "reflex, not clipped",
        "light",
        lambda eye: eye.clean.with_raw(defects.reflex(eye.clean.raw, eye.spec.camera)),
        "misfit",
        NO_RESIDUAL,
    ),
    *(
        _case(
            f"vignetting {share:.0%}",
            "light",
            lambda eye, share=share: eye.clean.with_raw(defects.vignetting(eye.clean.raw, eye.spec.camera, share)),
            "falloff misfit",
            NO_RESIDUAL,
        )
        for share in (0.2, 0.4)
    ),
    _case(
        "stray corner",
        "light",
        lambda eye: eye.clean.with_raw(defects.leak(eye.clean.raw, eye.spec.camera, 0.5)),
        "leak misfit",
        NO_RESIDUAL,
    ),
    *(
        _case(
            name,
            "light",
            changed(eye__pupil_um=pupil_um, eye__decentred_um=off_um),
            "pupil",
            CUT_PUPIL,
        )
        for name, pupil_um, off_um in (
            ("cut pupil 18 %", 7700.0, 3260.0),
            ("small pupil off centre", 4000.0, 900.0),
        )
    ),
    _case("dust", "light", changed(sensor__dust_spots=14), "spots", NO_RESIDUAL),
    *(_case(f"ghost {share:.0%}", "light", changed(light__ghost=share), "ghost", NO_RESIDUAL) for share in (0.1, 0.3)),
    _case("stray gradient 30 %", "light", changed(light__stray_gradient=0.3), "eye bright misfit leak", UNEVEN),
    _case("column noise, 16 e-", "rows and columns", columns(16.0), "", PATTERN),
    *(
        _case(f"{name}, {100 * share:g} %", "rows and columns", lines(of, share), true, DIM)
        for name, of, share, true in (
            ("row noise", defects.row_noise, 0.027, "dim misfit"),
            ("column gain", defects.column_gain, 0.01, "dim"),
        )
    ),
    *(
        _case(f"{100 * share:g} % of the rows {name}", "rows and columns", order_of_rows(of, share))
        for name, of in (
            ("repeated in a block", defects.repeated_block),
            ("repeated, spread", defects.repeated_rows),
            ("lost", defects.lost_rows),
        )
        for share in (0.011, 0.022, 0.05)
    ),
    _case("1 % NaN", "what is no frame", not_numbers(0.01), "pixels", MISSING),
    _case("all NaN", "what is no frame", not_numbers(1.01), "pixels"),
    _case("all zeros", "what is no frame", no_light, "signal eye"),
    _case("constant", "what is no frame", constant, "eye signal misfit", EVEN),
    _case(
        "8 bit",
        "wrong counts",
        lambda eye: eye.clean.with_raw(defects.eight_bits(eye.clean.raw, eye.spec.camera)),
        "counts",
    ),
    *(
        _case(name, "wrong counts", lambda eye, change=change: eye.clean.with_raw(change(eye)), "counts misfit lit eye")
        for name, change in (
            ("8 bit, gamma 2.2", lambda eye: defects.gamma(eye.clean.raw, eye.spec.camera)),
            ("8 bit, JPEG", lambda eye: defects.jpeg(defects.eight_bits(eye.clean.raw, eye.spec.camera))),
        )
    ),
    *(_case(f"black level off by {dn} DN", "wrong counts", offset(dn), "counts") for dn in (1, 5, 20)),
    _case("gain off by 2", "wrong counts", gain(2.0), "counts"),
    _case("gain off by 0.5", "wrong counts", gain(0.5), "counts", HALF_LIGHT),
)
NAMED = {case.key: case for case in CASES}
