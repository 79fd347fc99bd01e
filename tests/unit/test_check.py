"""A calibration that fits is not doubted, one that does not is; what cannot be noticed is said with its figure."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import product

import numpy as np
import pytest

from device.calibration import admission, check
from device.calibration.archive import Provenance
from device.calibration.check import Exposures, Sight, look
from device.calibration.finding import Finding
from device.clock import VirtualClock
from device.errors import Busy, CalibrationOld, CalibrationOtherMode, CalibrationStale
from device.recon.refraction import Refractor
from device.recon.witness import Statement, Witness
from device.sim.calibrate import simulated_calibration
from device.sim.world import World
from device.spec import CameraSpec, load_head
from device.values import Calibration, Counts, Geometry, Psf, Sensor
from tests import misfits
from tests.misfits import calibrated, dark, lit, point
from tests.scenes import PLANNER
from tests.simulated import SCENES, coarse, exposed

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
FIGURES = (("dark_e_per_s", 0.0), ("pattern_e", 0.0))
KNOWN = Provenance("D-1", NOW - timedelta(weeks=2), "a technician", "0.1.0", figures=FIGURES)
RETINAS, SPHERES_DPT, LIGHTS = (1, 2, 3), (-8.0, 0.0, 8.0), (1.0, 0.05)


@cache
def witness() -> Witness:
    return Witness(Refractor(calibrated(), misfits.world().shape, PLANNER, 0))


def told(frame: Counts) -> Statement:
    found = witness()(frame, dark())
    assert found is not None
    return found


def sight(frame: Counts, darkness: Counts | None = None, at: int = 0) -> Sight:
    exposed = Exposures(NOW + timedelta(minutes=at), frame, dark() if darkness is None else darkness, 0.1)
    return look(calibrated(), KNOWN, witness(), exposed)


def found(*sights: Sight) -> dict[str, Finding]:
    return {one.name: one for one in check.check(calibrated(), KNOWN, sights, (), NOW)}


def of_darks(make: Callable[[int], Counts]) -> dict[str, Finding]:
    nothing = np.empty((0, 0), np.uint16)
    darks = (Exposures(NOW + timedelta(minutes=n), nothing, make(n), 0.1) for n in range(3))
    return found(*(look(calibrated(), KNOWN, None, one) for one in darks))


@pytest.mark.parametrize(("retina", "m_dpt"), list(product(RETINAS, SPHERES_DPT)))
def test_a_good_head_is_not_doubted_by_any_eye(retina: int, m_dpt: float, record_property: Callable[..., None]) -> None:
    """Of 210 frames (`python -m tests.bench fitness`) none is; the scores are 0.84 to 1.24."""
    seen = [sight(lit(point(m_dpt), retina, light)) for light in LIGHTS]
    scores = [one.statement.score for one in seen if one.statement is not None]
    record_property("scores", scores)
    assert 0.8 < min(scores) < max(scores) < 1.3
    findings = found(*seen)
    assert set(findings) == {"age", "psf", "shift", "width", "hot pixels", "black level", "dark noise"}
    assert all(one.ok and not one.remedy for one in findings.values())
    assert seen[0].statement is not None
    assert seen[0].statement.sphere_dpt == pytest.approx(m_dpt, abs=0.4)


RETINA_SCENES = (
    "calm", "colour_sensor", "crowded_imx296", "diabetic", "dim", "drifting_eye", "paper_heine", "short_sighted",
    "small_pupil", "stray_light", "worn_sensor",
)  # fmt: skip


@pytest.mark.parametrize("name", RETINA_SCENES)
def test_no_scene_with_a_retina_refuses_anybody(name: str, record_property: Callable[..., None]) -> None:
    """Small pupils, dim light, moving eyes, stray light, another sensor: the psf is at 0.80 of 1 or more."""
    spec = coarse(load_head(SCENES / f"{name}.toml"), misfits.K)
    world = World(spec, VirtualClock())
    calibration = simulated_calibration(world)
    asked = Witness(Refractor(calibration, world.shape, PLANNER, 0))
    seen = Exposures(NOW, exposed(world), exposed(world, lit=False), spec.camera.exposure_s)
    findings = check.check(calibration, None, [look(calibration, None, asked, seen)], (), NOW)
    record_property("findings", [(one.name, one.value) for one in findings])
    assert {one.name for one in findings if not one.ok} <= {"black level"}  # where the room is lit, or the sensor warm
    assert not any(one.fails for one in findings)
    assert next(one.value for one in findings if one.name == "psf") > 0.7


@pytest.mark.parametrize("diffuser", [5, 6, 7])
def test_another_diffuser_explains_nothing(diffuser: int) -> None:
    assert abs(told(lit(point(diffuser=diffuser))).score) < 0.15


def test_a_turned_diffuser_is_noticed_from_three_quarters_of_a_degree() -> None:
    """0.5 deg costs half a decibel and is not noticed, 0.75 deg costs one; at 2 deg nothing of the score is left."""
    scores = [told(lit(point(turned_deg=deg))).score for deg in (0.0, 0.25, 0.5, 1.0, 2.0)]
    assert scores == sorted(scores, reverse=True)
    assert scores[2] > check.LEAST_SCORE + 0.1
    assert scores[3] < check.LEAST_SCORE - 0.1
    assert abs(scores[4]) < 0.1


@pytest.mark.parametrize("by_um", [-100.0, 100.0])
def test_an_axial_move_leaves_the_psf_as_it_was_and_is_seen_by_the_size_of_the_field(by_um: float) -> None:
    frame = misfits.farther(by_um)
    findings = found(sight(frame))
    assert findings["psf"].ok
    assert findings["psf"].value > 0.95
    assert findings["width"].hint
    assert told(frame).wider == pytest.approx(by_um / 6000, abs=0.008)


@pytest.mark.parametrize(("by_um", "ok"), [(20.0, True), (50.0, False), (200.0, False)])
def test_a_diffuser_pushed_aside_behind_its_iris_is_seen_by_where_the_picture_lies(by_um: float, ok: bool) -> None:
    """Fifteen sixteenths of its surface are the same at 200 um: the PSF is not blamed. 0.0127 deg to a micrometre."""
    frame = lit(misfits.slid(by_um))
    assert told(frame).score > 0.9
    assert told(frame).off_deg == pytest.approx((0.0, -by_um * 0.01273), abs=0.15)
    assert found(sight(frame))["shift"].ok is ok


@pytest.mark.parametrize("by_deg", [0.25, 1.0, 2.0])
def test_a_field_that_has_moved_is_measured_and_the_psf_is_not_blamed(by_deg: float) -> None:
    frame = misfits.aside(by_deg)
    assert told(frame).score > 1.0
    assert told(frame).off_deg == pytest.approx((0.0, by_deg), abs=0.06)
    assert abs(told(frame).wider) < 0.002
    assert found(sight(frame))["shift"].hint is (by_deg > check.OFF_DEG)


def test_one_strange_picture_is_a_hint_two_of_three_refuse_and_new_good_ones_forgive() -> None:
    good, strange = (lit(one) for one in (point(), point(turned_deg=2)))
    first = [sight(good, at=0), sight(good, at=1), sight(strange, at=2)]
    assert found(*first)["psf"].hint
    check.refuse(tuple(found(*first).values()))
    second = [*first, sight(strange, at=3)]
    assert found(*second)["psf"].fails
    with pytest.raises(CalibrationStale, match="psf"):
        check.refuse(tuple(found(*second).values()))
    assert found(*second, sight(good, at=4), sight(good, at=5))["psf"].ok


def test_a_frame_that_shows_nothing_says_nothing_about_the_psf() -> None:
    even = misfits.world().sensor.read(np.full(misfits.world().shape, 4000, np.float32), 3)  # never met the diffuser
    for frame in (dark(noise=5), even, lit(point(), light=1e-4)):
        assert "psf" not in found(sight(frame))


def test_a_press_ends_a_look_at_once() -> None:
    def pressed() -> None:
        raise Busy("somebody presses")

    exposed = Exposures(NOW, lit(point()), dark(), 0.1)
    with pytest.raises(Busy):
        look(calibrated(), KNOWN, witness(), exposed, pressed)
    assert told(lit(point())).score > 0.8


# The dark


def test_new_hot_pixels_are_counted_and_known_ones_are_not() -> None:
    share = float((dark(hot=5e-4) != dark()).mean())
    findings = of_darks(lambda n: dark(hot=5e-4, noise=n))
    assert findings["hot pixels"].value == pytest.approx(100 * share, rel=0.02)
    assert findings["hot pixels"].hint
    assert of_darks(lambda n: dark(hot=2e-3, noise=n))["hot pixels"].fails
    bad = dark(hot=5e-4) > 1000
    marked = Calibration(calibrated().psfs, calibrated().sensor, bad=bad)
    assert look(marked, KNOWN, None, Exposures(NOW, dark(), dark(hot=5e-4), 0.1)).dark.hot.size == 0


def test_a_cosmic_ray_is_not_a_hot_pixel() -> None:
    def hit(n: int) -> Counts:
        counts = dark(noise=n)
        counts.ravel()[np.random.default_rng(n).integers(0, counts.size, 100)] = 4000
        return counts

    assert of_darks(hit)["hot pixels"].value == 0


@pytest.mark.parametrize(("off_dn", "ok"), [(0.0, True), (1.0, True), (3.0, False), (-3.0, False)])
def test_a_black_level_that_moved_is_a_hint(off_dn: float, ok: bool) -> None:
    black = of_darks(lambda n: dark(off_dn, noise=n))["black level"]
    assert black.value == pytest.approx(abs(off_dn), abs=0.05)
    assert black.ok is ok
    assert not black.fails


def test_a_lit_room_raises_hints_and_refuses_nobody() -> None:
    """Without a dark row nobody can tell an even room from a black level; a lamp in it is no field of hot pixels."""

    def in_a_room(n: int) -> Counts:
        rows, cols = np.ogrid[-135:135, -240:240]
        room_e = np.float32(1000) + np.float32(2e5) * np.exp(-(rows**2 + cols**2) / 400, dtype=np.float32)
        return misfits.world().sensor.read(room_e, (8, n))

    findings = of_darks(in_a_room)
    assert findings["black level"].hint
    assert findings["dark noise"].hint
    assert findings["hot pixels"].value < 0.01
    assert not any(one.fails for one in findings.values())


# What all eyes have in common


def test_the_scale_is_asked_of_many_people_and_not_of_one() -> None:
    def scale(spheres_dpt: np.ndarray, minutes: int) -> Finding | None:
        spheres = [(NOW + timedelta(minutes=minutes * n), float(one)) for n, one in enumerate(spheres_dpt)]
        found = check.check(calibrated(), KNOWN, (), spheres, NOW)
        return next((one for one in found if one.name == "scale"), None)

    people = np.random.default_rng(1).normal(-0.5, 2.5, 40)
    assert scale(people, 60).ok  # type: ignore[union-attr]
    moved = scale(people + 4, 60)
    assert moved is not None
    assert moved.hint
    assert scale(people + 4, 1) is None  # one sitting: one person, who may well be long-sighted


# Age and mode


def test_age_is_a_hint_after_half_a_year_and_refused_after_a_missed_service() -> None:
    def at(weeks: float) -> Finding:
        return admission.age(KNOWN, KNOWN.made_at + timedelta(weeks=weeks))

    assert at(25.9).ok
    assert at(26).hint
    assert at(60.9).hint
    assert at(61).fails
    assert at(-1).hint  # a clock that lost the date must not stop anybody
    assert "clock" in at(-1).remedy
    with pytest.raises(CalibrationOld, match="61 weeks"):
        admission.refuse_old(KNOWN, KNOWN.made_at + timedelta(weeks=61))
    with pytest.raises(CalibrationOld):
        check.refuse((at(61),))


CAMERA = CameraSpec(
    backend="sim", rows=20, cols=30, pitch_um=5.04, bit_depth=12, black_dn=64, full_well_e=23000, read_noise_e=1
)


def measured(**sensor: float) -> Calibration:
    levels = {"black_dn": 63.0, "gain_e_per_dn": 5.7, "white_dn": 4080.0} | sensor
    flat = np.full((20, 30), 63.0, np.float32)
    return Calibration((Psf(flat),), Sensor(**levels), Geometry(5.04, 6000, 0.75), dark_dn=flat)


@pytest.mark.parametrize(
    ("calibration", "camera", "words"),
    [
        (measured(), {"rows": 10}, "pixels"),
        (measured(), {"pitch_um": 10.08}, "um"),
        (measured(), {"bit_depth": 10}, "full at"),
        (measured(), {"bit_depth": 14}, "full at"),
        (measured(), {"black_dn": 256}, "black at"),
        (measured(black_dn=250.0), {}, "black at"),
        (measured(black_dn=55.0), {}, "another exposure"),
    ],
)
def test_a_calibration_of_another_mode_is_refused_with_both_numbers(
    calibration: Calibration, camera: dict[str, float], words: str
) -> None:
    admission.refuse_other_mode(measured(), KNOWN, CAMERA)
    with pytest.raises(CalibrationOtherMode, match=words):
        admission.refuse_other_mode(calibration, KNOWN, CAMERA.model_copy(update=camera))


def test_what_an_imported_psf_does_not_know_is_not_held_against_it() -> None:
    imported = Calibration((Psf(np.ones((20, 30), np.float32)),), Sensor())
    admission.refuse_other_mode(imported, KNOWN, CAMERA)
