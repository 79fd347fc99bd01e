"""Bursts and colour sequences of frames, over every camera and lamp."""

import pytest

from device.errors import CameraMissing, LightLimit
from device.head import hazard_of
from device.light_safety.burst import burst
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.sim.light import SimLight
from device.values import ExposureSettings, Illumination
from tests.ports.conftest import Rig, guarded_rig, small_head

SHOT = ExposureSettings(0.02)


def guarded(rig, max_on_s=30.0):
    hazard = hazard_of(small_head())
    return GuardedLight(rig.light, rig.clock, max_on_s, hazard, MemoryLedger(rig.clock))


def test_a_burst_is_lit_throughout_and_dark_afterwards(rig):
    frames = burst(rig.camera, guarded(rig), Illumination("green"), SHOT, 3, rig.clock, whole_s=SHOT.exposure_s)
    assert [frame.illumination for frame in frames] == [Illumination("green")] * 3
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert rig.light.illumination is None


def test_a_burst_ends_before_the_guard_would_end_it():
    rig = guarded_rig()
    shot = ExposureSettings(9.0)  # of virtual time; the guard's timer runs in real time, which a frame must not reach
    light = guarded(Rig(rig.camera, SimLight(rig.camera.world), rig.clock), max_on_s=30.0)
    frames = burst(rig.camera, light, Illumination("green"), shot, 16, rig.clock, whole_s=shot.exposure_s)
    assert len(frames) == 3  # a fourth one might last until 36 s
    assert light.illumination is None


class SlowCamera:
    """Camera that takes longer for a frame than its exposure."""

    def __init__(self, camera, clock, overhead_s):
        self.camera, self.clock, self.overhead_s = camera, clock, overhead_s

    def expose(self, shot):
        self.clock.sleep(self.overhead_s)
        return self.camera.expose(shot)


@pytest.mark.parametrize("overhead_s", [0.0, 0.004, 0.05])
@pytest.mark.parametrize(("count", "parts"), [(1, 8), (2, 3), (4, 2)])
def test_split_exposures_have_no_more_light_than_whole_ones(overhead_s, count, parts):
    lit_s, exposed_s = [], []
    for number in (1, parts):
        rig = guarded_rig()
        light = guarded(Rig(rig.camera, SimLight(rig.camera.world), rig.clock))
        camera, shot = SlowCamera(rig.camera, rig.clock, overhead_s), ExposureSettings(0.1 / number)
        begin_s = rig.clock.now_s()
        frames = burst(camera, light, Illumination("green"), shot, count, rig.clock, parts=number, whole_s=0.1)
        lit_s.append(rig.clock.now_s() - begin_s)
        exposed_s.append(sum(frame.exposure_s for frame in frames))
        assert light.given_j_per_cm2 == pytest.approx(light.hazard.dose_j_per_cm2(Illumination("green"), lit_s[-1]))
        assert light.illumination is None
    assert lit_s[1] <= lit_s[0] + 1e-5, "the dose grows"  # rounding
    assert exposed_s[1] <= exposed_s[0] + 1e-9
    if overhead_s == 0:
        assert exposed_s[1] == pytest.approx(exposed_s[0]), "a camera without overhead loses no light"


@pytest.mark.parametrize("overhead_s", [0.0, 0.004, 0.02])
@pytest.mark.parametrize(("count", "parts"), [(1, 4), (4, 2)])
def test_parts_that_are_shorter_by_the_overhead_are_all_taken(overhead_s, count, parts):
    rig, whole_s = guarded_rig(), 0.1
    light = guarded(Rig(rig.camera, SimLight(rig.camera.world), rig.clock))
    camera = SlowCamera(rig.camera, rig.clock, overhead_s)
    part = ExposureSettings((whole_s + overhead_s) / parts - overhead_s)
    begin_s = rig.clock.now_s()
    illumination = Illumination("green")
    frames = burst(camera, light, illumination, part, count, rig.clock, parts=parts, whole_s=whole_s)
    assert len(frames) == count * parts
    assert rig.clock.now_s() - begin_s <= count * (whole_s + overhead_s) + 1e-5  # rounding


def test_a_stalled_first_part_adds_no_light():
    rig, whole_s, overhead_s, parts = guarded_rig(), 0.1, 0.005, 2
    light = guarded(Rig(rig.camera, SimLight(rig.camera.world), rig.clock))
    camera = SlowCamera(rig.camera, rig.clock, 0.05)
    begin_s = rig.clock.now_s()
    part = ExposureSettings((whole_s + overhead_s) / parts - overhead_s)
    burst(camera, light, Illumination("green"), part, 4, rig.clock, parts=parts, whole_s=whole_s)
    assert rig.clock.now_s() - begin_s <= 4 * (whole_s + overhead_s) + 1e-5  # rounding


class UnpluggedCamera:
    """Camera that is unplugged after its first exposure."""

    def __init__(self, camera):
        self.camera, self.exposures = camera, 0

    def expose(self, shot):
        self.exposures += 1
        if self.exposures > 1:
            raise CameraMissing("unplugged")
        return self.camera.expose(shot)


def test_an_error_between_two_frames_of_a_burst_turns_the_light_off(rig):
    with pytest.raises(CameraMissing):
        burst(
            UnpluggedCamera(rig.camera),
            guarded(rig),
            Illumination("green"),
            SHOT,
            3,
            rig.clock,
            whole_s=SHOT.exposure_s,
        )
    assert rig.light.illumination is None


class CuttingCamera:
    """Camera during whose exposure number `last` the guard's timer fires."""

    def __init__(self, rig, last):
        self.rig, self.last = rig, last

    def expose(self, shot):
        self.last -= 1
        if self.last == 0:
            self.rig.light.cut()  # the timer's action
        return self.rig.camera.expose(shot)


def test_a_burst_longer_than_the_guard_allows_raises_light_limit():
    rig = guarded_rig()
    with pytest.raises(LightLimit):
        burst(CuttingCamera(rig, 1), rig.light, Illumination("green"), SHOT, 4, rig.clock, whole_s=SHOT.exposure_s)
    assert rig.light.illumination is None


def test_a_later_frame_that_the_guard_has_ended_is_left_out():
    rig = guarded_rig()
    frames = burst(CuttingCamera(rig, 3), rig.light, Illumination("green"), SHOT, 4, rig.clock, whole_s=SHOT.exposure_s)
    assert len(frames) == 2
    assert rig.light.illumination is None
