"""Frame quality and aiming guidance on simulated scenes: detection rates and false alarms.

Good frames are ordinary eyes: bright and dim, short- and long-sighted, with stray light, held by hand. Bad frames are
the mistakes that happen in practice. Causes that one frame cannot show are listed in
`test_causes_that_one_frame_cannot_show_are_not_reported`.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.recon.assessment.aiming import AimingGuide, moved_samples
from device.recon.assessment.frame_quality import FrameFigures, FrameQualityGate, assess, assess_picture
from device.sim import calibration_targets
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Counts, Image, Verdict
from tests import scenes
from tests.simulated import SCENES, coarse, exposed_counts, with_keys

K = 4  # k x k pixels of the paper's sensor per pixel; the coarse solution has the same samples


@cache
def scene(name: str) -> InstrumentSpec:
    return coarse(load_head(SCENES / f"{name}.toml"), K)


@cache
def quality_gate(name: str) -> tuple[FrameQualityGate, Calibration]:
    spec = scene(name)
    calibration = simulated_calibration(World(spec, VirtualClock()))
    return FrameQualityGate(calibration, (spec.camera.rows, spec.camera.cols), scenes.PLANNER), calibration


@cache
def frames(name: str, keys: str = "{}", times: float = 1.0) -> tuple[Counts, Counts]:
    """Return a lit frame and a dark one of a scene with other keys, at `times` its brightness."""
    spec = scene(name)
    changed = with_keys(spec, peak_e=spec.sim.peak_e * times, **eval(keys))
    world = World(changed, VirtualClock())
    world.electrons_per_s("green")
    return exposed_counts(world), exposed_counts(world, lit=False)


def verdict(name: str, keys: dict[str, Any] | None = None, times: float = 1.0) -> Verdict:
    lit, dark = frames(name, repr(keys or {}), times)
    return assess(quality_gate(name)[0](lit, dark))


def eye(**keys: Any) -> dict[str, Any]:
    return {"eye": keys}


GOOD: list[tuple[str, dict[str, Any], float]] = [
    *(
        (name, {}, 1.0)
        for name in (
            "calm",
            "dim",
            "healthy",
            "diabetic",
            "short_sighted",
            "small_pupil",
            "stray_light",
            "worn_sensor",
            "drifting_eye",
        )
    ),
    *((name, eye(m_dpt=m_dpt), 1.0) for name in ("calm", "dim") for m_dpt in (-8.0, -4.0, -1.5, 1.5, 4.0, 8.0)),
    *((name, {"eye": {"gaze_deg": gaze}}, 1.0) for name in ("calm", "dim") for gaze in ((5.0, 0.0), (0.0, -5.0))),
    *(("calm", eye(drift_deg_per_s=speed), 1.0) for speed in (1.0, 3.0, 5.0)),
    ("calm", eye(pupil_um=2500.0), 1.0),
    ("calm", eye(axial_um=4000.0), 1.0),
    ("calm", eye(axial_um=-4000.0), 1.0),
    ("calm", {"light": {"polariser_leak": 0.01, "ring_um": 4500.0}}, 1.0),
    ("calm", {}, 0.2),
    ("calm", {}, 1.3),
    ("dim", {}, 0.3),
    ("dim", {}, 3.0),
]
BAD: dict[str, list[tuple[str, dict[str, Any], float]]] = {
    "shot.saturated": [("calm", {}, times) for times in (1.8, 2.5, 4.0, 8.0, 16.0)],
    "shot.dark": [(name, {}, times) for name, times in (("dim", 0.1), ("dim", 0.03), ("dim", 0.01), ("calm", 0.003))],
    "shot.edge": [
        (name, eye(pupil_um=float(pupil), decentred_um=float(off)), 1.0)
        for name in ("calm", "dim")
        for pupil, off in ((4000, 1500), (4000, 2500), (6000, 3500), (3000, 2000))
    ],
    "shot.pupil": [(name, eye(pupil_um=float(pupil)), 1.0) for name in ("calm", "dim") for pupil in (1000, 1500, 2000)],
    "shot.halo": [
        ("calm", {"light": {"polariser_leak": leak, "ring_um": ring}}, 1.0)
        for leak, ring in ((0.1, 3500.0), (0.1, 4500.0), (0.15, 3500.0), (0.2, 4500.0), (0.3, 3500.0))
    ],
    "shot.moved": [("calm", eye(drift_deg_per_s=speed), 1.0) for speed in (10.0, 20.0, 30.0, 40.0)],
}


def test_no_ordinary_eye_is_rejected() -> None:
    """False alarms: none of 36, from a thirtieth of the paper's light to eyes of eight dioptres of either sign."""
    alarms = {
        (name, repr(keys), times): found.code
        for name, keys, times in GOOD
        if (found := verdict(name, keys, times)).word != "good"
    }
    assert len(GOOD) == 36
    assert alarms == {}


@pytest.mark.parametrize("code", BAD)
def test_each_mistake_gets_its_own_cause(code: str) -> None:
    codes = [verdict(*case).code for case in BAD[code]]
    assert codes == [code] * len(codes)


@pytest.mark.parametrize("level", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("name", ["calm", "dim"])
def test_light_without_a_pupil_gives_no_eye_or_a_blink(name: str, level: float) -> None:
    """A lid and a wall give the same frame; the cause is a blink only if an eye was visible just before."""
    reader, calibration = quality_gate(name)
    lit, dark = frames(name)
    gain = calibration.sensor.gain_e_per_dn
    assert gain is not None
    spec = scene(name)
    world = World(spec, VirtualClock())
    mean_e_per_s = (float(lit.mean()) - float(dark.mean())) * gain / spec.camera.exposure_s
    world.target = calibration_targets.screen(world, mean_e_per_s * level)
    reading = reader(exposed_counts(world), dark)
    assert assess(reading).code == "shot.noeye"
    assert assess(reading, eye_before=True).code == "shot.blink"


def test_a_frame_without_light_is_dark() -> None:
    reader, _ = quality_gate("calm")
    _, dark = frames("calm")
    assert assess(reader(dark, dark)).code == "shot.dark"


def test_causes_that_one_frame_cannot_show_are_not_reported() -> None:
    """Known limits: motion blur in little light or of eight degrees, and a reflex without saturation."""
    missed = [
        ("dim", eye(drift_deg_per_s=20.0)),
        ("calm", eye(drift_deg_per_s=80.0)),
        ("calm", {"light": {"polariser_leak": 0.05, "ring_um": 4500.0}}),
    ]
    assert [verdict(*case).code for case in missed] == [None] * 3


@pytest.mark.parametrize("name", ["human_eye_imx296_power", "human_eye_imx296_power_lenslets"])
def test_soft_edge_of_the_high_power_ring_is_told_from_a_small_pupil(name: str) -> None:
    """Behind lenslets the dark edge of its light is seen: 0.78 of the field is lit, and 0.62 is expected."""
    spec = with_keys(scene(name), peak_e=38_000.0)
    shape = spec.camera.rows, spec.camera.cols
    calibration = simulated_calibration(World(spec, VirtualClock()))
    gate = FrameQualityGate(calibration, shape, scenes.PLANNER)
    codes = []
    for pupil_um in (7700.0, 1500.0):
        world = World(with_keys(spec, **eye(pupil_um=pupil_um)), VirtualClock())
        codes.append(assess(gate(exposed_counts(world), exposed_counts(world, lit=False))).code)
    assert codes[0] is None
    assert codes[1] in ("shot.pupil", "shot.edge")


def test_after_the_retakes_a_bad_verdict_is_poor() -> None:
    bad, good = Verdict("again", "shot.edge", {}), Verdict("good", None, {})
    assert [assess_picture(bad, 1.0, 1.0, tries, 2).code for tries in range(4)] == ["shot.edge"] * 2 + ["shot.poor"] * 2
    assert assess_picture(good, 1.0, 1.0, 5, 2).word == "good"
    assert assess_picture(good, 1.0, 0.5, 0, 2).code == "shot.edge"
    assert assess_picture(good, None, None, 0, 2).word == "good"
    assert assess_picture(bad, 1.23456, None, 0, 2).numbers == {"residual": 1.235}


def test_colour_frames_and_heads_without_a_field_are_assessed() -> None:
    _, calibration = quality_gate("calm")
    lit, dark = frames("calm")
    three = np.stack([lit // 4, lit, lit // 2], axis=2)
    colour_gate = FrameQualityGate(calibration, lit.shape, scenes.PLANNER)
    assert colour_gate(three, np.stack([dark] * 3, axis=2)) == colour_gate(lit, dark)
    gate_without_field = FrameQualityGate(scenes.calibration(scenes.speckle((64, 64))), (64, 64), scenes.PLANNER)
    plain = gate_without_field(np.full((64, 64), 700, np.uint16))
    assert plain == FrameFigures(saturated=0.0)
    assert assess(plain).word == "good"
    assert assess(gate_without_field(np.full((64, 64), 65535, np.uint16))).code == "shot.saturated"


# Aiming

ReadFrame = Callable[..., tuple[FrameFigures, Image]]


@pytest.fixture(params=["calm", "dim"])
def live_frame(request: pytest.FixtureRequest) -> tuple[str, ReadFrame]:
    """Read one live frame of a scene with other keys; the picture is a copy."""

    def read(**keys: Any) -> tuple[FrameFigures, Image]:
        reader, _ = quality_gate(request.param)
        world = World(with_keys(scene(request.param), **keys), VirtualClock())
        world.electrons_per_s("green")
        world.frames = keys.pop("number", 0)
        reading = reader(exposed_counts(world))
        assert reader.picture is not None
        return reading, reader.picture.copy()

    return request.param, read


def aim_code(live_frame: ReadFrame, **keys: Any) -> str:
    return AimingGuide(0.1, 0.5)(*live_frame(**keys), 1.0).code


def test_the_aiming_code_is_the_direction_of_the_camera(live_frame: tuple[str, ReadFrame]) -> None:
    name, read = live_frame
    assert aim_code(read) == "ready"
    assert aim_code(read, eye={"pupil_um": 4000.0, "decentred_um": 1500.0}) == "right"
    if name == "calm":  # tracing a beam for every position of the field takes seconds
        far, near = {"axial_um": 10000.0}, {"axial_um": -10000.0}
        assert (aim_code(read, eye=far), aim_code(read, eye=near)) == ("closer", "back")
        assert aim_code(read, peak_e=scene(name).sim.peak_e * 3) == "bright"


@pytest.mark.parametrize(
    ("off", "word"), [((0.3, 0.1), "right"), ((-0.3, 0.1), "left"), ((0.1, 0.3), "down"), ((0.1, -0.3), "up")]
)
def test_directions_are_those_of_the_picture(off: tuple[float, float], word: str) -> None:
    reading = FrameFigures(0.0, 5.0, 1.0, 0.8, *off)
    assert AimingGuide(0.1, 0.5)(reading, None, 1.0).code == word


def test_no_eye_precedes_all_other_codes_and_has_no_fill() -> None:
    without_eye = AimingGuide(0.1, 0.5)(FrameFigures(0.0, 5.0, 0.02, 0.4, 0.3, 0.3), None, 1.0)
    assert (without_eye.code, without_eye.fill) == ("noeye", 0.0)
    assert AimingGuide(0.1, 0.5)(FrameFigures(0.0, 0.01, 0.9, 0.98, 0.0, 0.0), None, 1.0).code == "dark"


def test_an_aiming_code_is_kept_long_enough_to_be_read() -> None:
    """At most one change in 700 ms, on the clock of the frames."""
    aimer, changes, before = AimingGuide(0.1, 0.5), [], "noeye"
    for tick in range(100):
        now_s = tick * 0.05
        off = 0.3 if tick % 2 else -0.3
        code = aimer(FrameFigures(0.0, 5.0, 1.0, 0.98, off, 0.0), None, now_s).code
        if code != before:
            changes.append(now_s)
            before = code
    assert len(changes) >= 5
    assert min(np.diff(changes)) >= 0.7 - 1e-9


def test_a_moving_picture_gives_the_code_still(live_frame: tuple[str, ReadFrame]) -> None:
    _, read = live_frame
    here, there = read(), read(eye={"gaze_deg": (0.0, 3.0)})
    still, moving = AimingGuide(0.1, 0.5), AimingGuide(0.1, 0.5)
    still(*here, 1.0)
    assert still(*here, 2.9).code == "ready"
    moving(*here, 1.0)
    assert moving(*there, 1.75).code == "still" if moved_samples(here[1], there[1]) * 0.5 / 0.75 > 5 else "ready"
    assert moved_samples(here[1], here[1]) == pytest.approx(0, abs=1e-4)  # rounding of single precision
    assert moved_samples(here[1], there[1]) == pytest.approx(6, abs=1.5)  # three degrees, at half a degree per sample


def test_a_visible_eye_is_remembered_for_a_second(live_frame: tuple[str, ReadFrame]) -> None:
    _, read = live_frame
    aimer = AimingGuide(0.1, 0.5)
    assert not aimer.eye_was_visible(0.0)
    aimer(*read(), 1.0)
    assert aimer.eye_was_visible(1.5)
    assert not aimer.eye_was_visible(2.5)
