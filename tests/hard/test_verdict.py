"""The verdict on raw frames, against simulated scenes: how often it hits, and how often it cries wolf.

What must be called good are ordinary eyes: bright and dim, short- and long-sighted, with stray light, held as people
hold. What must not are the mistakes that happen. What one frame cannot tell is pinned here too, as what is missed.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from device.clock import VirtualClock
from device.recon.aim import Aimer, moved_samples
from device.recon.verdict import Gate, Reading, Verdict, after, judge
from device.sim import stage
from device.sim.calibrate import simulated_calibration
from device.sim.world import World
from device.spec import InstrumentSpec, load_head
from device.values import Calibration, Counts, Image
from tests import scenes
from tests.simulated import SCENES, coarse, exposed, having

K = 4  # pixels of the paper's sensor that are one here, k x k: the gate bins to the same samples


@cache
def scene(name: str) -> InstrumentSpec:
    return coarse(load_head(SCENES / f"{name}.toml"), K)


@cache
def gate(name: str) -> tuple[Gate, Calibration]:
    spec = scene(name)
    calibration = simulated_calibration(World(spec, VirtualClock()))
    return Gate(calibration, (spec.camera.rows, spec.camera.cols), scenes.PLANNER), calibration


@cache
def frames(name: str, keys: str = "{}", times: float = 1.0) -> tuple[Counts, Counts]:
    """A lit frame and a dark one of a scene with other keys, `times` as bright as it should be."""
    spec = scene(name)
    changed = having(spec, peak_e=spec.sim.peak_e * times, **eval(keys))
    world = World(changed, VirtualClock())
    world.electrons_per_s("green")
    return exposed(world), exposed(world, lit=False)


def verdict(name: str, keys: dict[str, Any] | None = None, times: float = 1.0) -> Verdict:
    lit, dark = frames(name, repr(keys or {}), times)
    return judge(gate(name)[0](lit, dark))


def eye(**keys: Any) -> dict[str, Any]:
    return {"eye": keys}


GOOD: list[tuple[str, dict[str, Any], float]] = [
    *((name, {}, 1.0) for name in (
        "calm", "dim", "healthy", "diabetic", "short_sighted", "small_pupil", "stray_light", "worn_sensor",
        "drifting_eye",
    )),
    *((name, eye(m_dpt=m_dpt), 1.0) for name in ("calm", "dim") for m_dpt in (-8.0, -4.0, -1.5, 1.5, 4.0, 8.0)),
    *((name, {"eye": {"gaze_deg": gaze}}, 1.0) for name in ("calm", "dim") for gaze in ((5.0, 0.0), (0.0, -5.0))),
    *(("calm", eye(drift_deg_per_s=speed), 1.0) for speed in (1.0, 3.0, 5.0)),
    ("calm", eye(pupil_um=2500.0), 1.0), ("calm", eye(axial_um=4000.0), 1.0), ("calm", eye(axial_um=-4000.0), 1.0),
    ("calm", {"light": {"polariser_leak": 0.01, "ring_um": 4500.0}}, 1.0), ("calm", {}, 0.2), ("calm", {}, 1.3),
    ("dim", {}, 0.3), ("dim", {}, 3.0),
]  # fmt: skip
BAD: dict[str, list[tuple[str, dict[str, Any], float]]] = {
    "shot.saturated": [("calm", {}, times) for times in (1.8, 2.5, 4.0, 8.0, 16.0)],
    "shot.dark": [(name, {}, times) for name, times in (("dim", 0.1), ("dim", 0.03), ("dim", 0.01), ("calm", 0.003))],
    "shot.edge": [
        (name, eye(pupil_um=float(pupil), decentred_um=float(off)), 1.0) for name in ("calm", "dim")
        for pupil, off in ((4000, 1500), (4000, 2500), (6000, 3500), (3000, 2000))
    ],
    "shot.pupil": [
        (name, eye(pupil_um=float(pupil)), 1.0) for name in ("calm", "dim") for pupil in (1000, 1500, 2000)
    ],
    "shot.halo": [
        ("calm", {"light": {"polariser_leak": leak, "ring_um": ring}}, 1.0)
        for leak, ring in ((0.1, 3500.0), (0.1, 4500.0), (0.15, 3500.0), (0.2, 4500.0), (0.3, 3500.0))
    ],
    "shot.moved": [("calm", eye(drift_deg_per_s=speed), 1.0) for speed in (10.0, 20.0, 30.0, 40.0)],
}  # fmt: skip


def test_no_ordinary_eye_is_called_bad() -> None:
    """False alarms: none of 36, from a thirtieth of the paper's light to eyes of eight dioptres either way."""
    alarms = {(name, repr(keys), times): told.code for name, keys, times in GOOD
              if (told := verdict(name, keys, times)).word != "good"}  # fmt: skip
    assert len(GOOD) == 36
    assert alarms == {}


@pytest.mark.parametrize("code", BAD)
def test_a_mistake_is_named_by_its_own_cause(code: str) -> None:
    told = [verdict(*case).code for case in BAD[code]]
    assert told == [code] * len(told)


@pytest.mark.parametrize("level", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("name", ["calm", "dim"])
def test_light_that_did_not_come_through_a_pupil_is_no_eye_or_a_closed_one(name: str, level: float) -> None:
    """A lid and a wall look alike: it is called a blink only where an eye was seen just before."""
    reader, calibration = gate(name)
    lit, dark = frames(name)
    gain = calibration.sensor.gain_e_per_dn
    assert gain is not None
    spec = scene(name)
    world = World(spec, VirtualClock())
    mean_e_per_s = (float(lit.mean()) - float(dark.mean())) * gain / spec.camera.exposure_s
    world.stage = stage.screen(world, mean_e_per_s * level)
    reading = reader(exposed(world), dark)
    assert judge(reading).code == "shot.noeye"
    assert judge(reading, eye_before=True).code == "shot.blink"


def test_a_frame_without_any_light_is_dark() -> None:
    reader, _ = gate("calm")
    _, dark = frames("calm")
    assert judge(reader(dark, dark)).code == "shot.dark"


def test_what_one_frame_cannot_tell_is_missed() -> None:
    """So that nobody believes otherwise: a smear in little light or of eight degrees, a reflex without saturation."""
    missed = [("dim", eye(drift_deg_per_s=20.0)), ("calm", eye(drift_deg_per_s=80.0)),
              ("calm", {"light": {"polariser_leak": 0.05, "ring_um": 4500.0}})]  # fmt: skip
    assert [verdict(*case).code for case in missed] == [None] * 3


def test_the_last_word_after_the_retakes_is_that_it_is_not_clear() -> None:
    bad, good = Verdict("again", "shot.edge", {}), Verdict("good", None, {})
    assert [after(bad, 1.0, 1.0, tries, 2).code for tries in range(4)] == ["shot.edge"] * 2 + ["shot.poor"] * 2
    assert after(good, 1.0, 1.0, 5, 2).word == "good"
    assert after(good, 1.0, 0.5, 0, 2).code == "shot.edge"
    assert after(good, None, None, 0, 2).word == "good"
    assert after(bad, 1.23456, None, 0, 2).numbers == {"residual": 1.235}


def test_colours_and_unknown_heads_are_read_as_far_as_they_can_be() -> None:
    _, calibration = gate("calm")
    lit, dark = frames("calm")
    three = np.stack([lit // 4, lit, lit // 2], axis=2)
    alone = Gate(calibration, lit.shape, scenes.PLANNER)
    assert alone(three, np.stack([dark] * 3, axis=2)) == alone(lit, dark)
    unknown = Gate(scenes.calibration(scenes.speckle((64, 64))), (64, 64), scenes.PLANNER)
    plain = unknown(np.full((64, 64), 700, np.uint16))
    assert plain == Reading(saturated=0.0)
    assert judge(plain).word == "good"
    assert judge(unknown(np.full((64, 64), 65535, np.uint16))).code == "shot.saturated"


# Aiming

Look = Callable[..., tuple[Reading, Image]]


@pytest.fixture(params=["calm", "dim"])
def look(request: pytest.FixtureRequest) -> tuple[str, Look]:
    """Read one live frame of a scene with other keys; the picture is a copy."""

    def read(**keys: Any) -> tuple[Reading, Image]:
        reader, _ = gate(request.param)
        world = World(having(scene(request.param), **keys), VirtualClock())
        world.electrons_per_s("green")
        world.frames = keys.pop("number", 0)
        reading = reader(exposed(world))
        assert reader.picture is not None
        return reading, reader.picture.copy()

    return request.param, read


def aimed(look: Look, **keys: Any) -> str:
    return Aimer(0.1, 0.5)(*look(**keys), 1.0).code


def test_the_word_says_where_the_camera_must_go(look: tuple[str, Look]) -> None:
    name, read = look
    assert aimed(read) == "ready"
    assert aimed(read, eye={"pupil_um": 4000.0, "decentred_um": 1500.0}) == "right"
    if name == "calm":  # a beam for every place of the field takes seconds to trace
        far, near = {"axial_um": 10000.0}, {"axial_um": -10000.0}
        assert (aimed(read, eye=far), aimed(read, eye=near)) == ("closer", "back")
        assert aimed(read, peak_e=scene(name).sim.peak_e * 3) == "bright"


@pytest.mark.parametrize(
    ("off", "word"), [((0.3, 0.1), "right"), ((-0.3, 0.1), "left"), ((0.1, 0.3), "down"), ((0.1, -0.3), "up")]
)
def test_directions_are_those_of_the_picture(off: tuple[float, float], word: str) -> None:
    reading = Reading(0.0, 5.0, 1.0, 0.8, *off)
    assert Aimer(0.1, 0.5)(reading, None, 1.0).code == word


def test_no_eye_comes_before_everything_and_fills_nothing() -> None:
    nothing = Aimer(0.1, 0.5)(Reading(0.0, 5.0, 0.02, 0.4, 0.3, 0.3), None, 1.0)
    assert (nothing.code, nothing.fill) == ("noeye", 0.0)
    assert Aimer(0.1, 0.5)(Reading(0.0, 0.01, 0.9, 0.98, 0.0, 0.0), None, 1.0).code == "dark"


def test_a_word_stays_long_enough_to_be_read() -> None:
    """At most one change in 700 ms, on whatever clock the frames carry."""
    aimer, changes, before = Aimer(0.1, 0.5), [], "noeye"
    for tick in range(100):
        now_s = tick * 0.05
        off = 0.3 if tick % 2 else -0.3
        code = aimer(Reading(0.0, 5.0, 1.0, 0.98, off, 0.0), None, now_s).code
        if code != before:
            changes.append(now_s)
            before = code
    assert len(changes) >= 5
    assert min(np.diff(changes)) >= 0.7 - 1e-9


def test_a_picture_that_moves_is_told_to_be_still(look: tuple[str, Look]) -> None:
    _, read = look
    here, there = read(), read(eye={"gaze_deg": (0.0, 3.0)})
    still, moving = Aimer(0.1, 0.5), Aimer(0.1, 0.5)
    still(*here, 1.0)
    assert still(*here, 2.9).code == "ready"
    moving(*here, 1.0)
    assert moving(*there, 1.75).code == "still" if moved_samples(here[1], there[1]) * 0.5 / 0.75 > 5 else "ready"
    assert moved_samples(here[1], here[1]) == 0
    assert moved_samples(here[1], there[1]) == pytest.approx(6, abs=1.5)  # three degrees, at half a degree each


def test_an_eye_that_was_seen_is_remembered_for_a_second(look: tuple[str, Look]) -> None:
    _, read = look
    aimer = Aimer(0.1, 0.5)
    assert not aimer.saw_an_eye(0.0)
    aimer(*read(), 1.0)
    assert aimer.saw_an_eye(1.5)
    assert not aimer.saw_an_eye(2.5)
