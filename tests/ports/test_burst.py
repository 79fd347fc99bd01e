"""Bursts and colour sequences of frames, over every camera and lamp."""

import numpy as np
import pytest

from device.errors import LightLimit
from device.light_safety.burst import burst, colour_sequence
from device.values import ExposureSettings, Illumination
from tests.ports.conftest import guarded_rig

SHOT = ExposureSettings(0.02)


def test_a_burst_is_lit_throughout_and_dark_afterwards(rig):
    rows, cols = rig.camera.shape
    into = np.zeros((3, rows, cols), np.uint16)
    frames = list(burst(rig.camera, rig.light, Illumination("green"), SHOT, 3, into))
    assert [frame.illumination for frame in frames] == [Illumination("green")] * 3
    assert all(np.array_equal(frame.counts, plane) for frame, plane in zip(frames, into, strict=True))
    assert rig.light.illumination is None


def test_closing_an_unfinished_burst_turns_the_light_off(rig):
    frames = burst(rig.camera, rig.light, Illumination("green"), SHOT, 3)
    next(frames)
    assert rig.light.illumination is not None
    frames.close()
    assert rig.light.illumination is None


def test_each_colour_has_its_own_lit_and_dark_frame(live_rig):
    glows = (Illumination("red", 0.5), Illumination("green", 0.5), Illumination("red", 0.5))
    taken = list(colour_sequence(live_rig.camera, live_rig.light, glows, SHOT))
    assert [colour for colour, _, _ in taken] == ["red", "green", "red"]
    for _, frame, dark in taken:
        assert dark.illumination is None
        assert frame.counts.mean() > dark.counts.mean() + 1
    red, green, again = (frame.counts.mean() for _, frame, _ in taken)
    assert red == pytest.approx(again, rel=0.02)
    assert abs(red / green - 1) > 0.05


def test_a_burst_longer_than_the_guard_allows_raises_light_limit():
    rig = guarded_rig()
    guarded = rig.light
    frames = burst(rig.camera, guarded, Illumination("green"), SHOT, 3)
    next(frames)
    guarded.cut()  # call the timer's action without waiting
    with pytest.raises(LightLimit):
        next(frames)
    assert rig.light.illumination is None
