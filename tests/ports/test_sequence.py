"""Frames that belong together, over every camera and lamp."""

import numpy as np
import pytest

from device.errors import LightLimit
from device.sequence import burst, colours
from device.values import Glow, Shot
from tests.ports.conftest import guarded_rig

SHOT = Shot(0.02)


def test_a_burst_is_lit_through_and_dark_after_it(rig):
    rows, cols = rig.camera.shape
    into = np.zeros((3, rows, cols), np.uint16)
    frames = list(burst(rig.camera, rig.light, Glow("green"), SHOT, 3, into))
    assert [frame.glow for frame in frames] == [Glow("green")] * 3
    assert all(np.array_equal(frame.counts, plane) for frame, plane in zip(frames, into, strict=True))
    assert rig.light.glow is None


def test_a_burst_that_nobody_ends_is_dark_when_it_is_dropped(rig):
    frames = burst(rig.camera, rig.light, Glow("green"), SHOT, 3)
    next(frames)
    assert rig.light.glow is not None
    frames.close()
    assert rig.light.glow is None


def test_each_colour_has_its_own_frame_and_its_own_darkness(live_rig):
    glows = (Glow("red", 0.5), Glow("green", 0.5), Glow("red", 0.5))
    taken = list(colours(live_rig.camera, live_rig.light, glows, SHOT))
    assert [colour for colour, _, _ in taken] == ["red", "green", "red"]
    for _, frame, dark in taken:
        assert dark.glow is None
        assert frame.counts.mean() > dark.counts.mean() + 1
    red, green, again = (frame.counts.mean() for _, frame, _ in taken)
    assert red == pytest.approx(again, rel=0.02)
    assert abs(red / green - 1) > 0.05


def test_a_burst_that_is_longer_than_the_guard_allows_stops_in_the_dark():
    rig = guarded_rig()
    guarded = rig.light
    frames = burst(rig.camera, guarded, Glow("green"), SHOT, 3)
    next(frames)
    guarded._cut()  # the timer, which here is not waited for
    with pytest.raises(LightLimit):
        next(frames)
    assert rig.light.glow is None
