"""Contract of every Light implementation (device/ports.py)."""

import pytest

from device.values import ExposureSettings, Illumination

GREEN, RED = Illumination("green"), Illumination("red", 0.5)


def test_the_light_is_off_by_default(fresh_rig):
    assert fresh_rig.light.illumination is None
    assert fresh_rig.camera.expose(ExposureSettings(0.01)).illumination is None


def test_the_light_shows_the_requested_illumination_until_the_context_ends(rig):
    for illumination in (GREEN, RED):
        with rig.light.on(illumination):
            assert rig.light.illumination == illumination
        assert rig.light.illumination is None


def test_the_light_is_off_after_an_exception(rig):
    with pytest.raises(ZeroDivisionError), rig.light.on(GREEN):
        raise ZeroDivisionError
    assert rig.light.illumination is None


def test_a_context_that_is_never_entered_leaves_the_light_off(rig):
    rig.light.on(GREEN)
    assert rig.light.illumination is None


def test_off_is_immediate_and_idempotent(rig):
    with rig.light.on(GREEN):
        rig.light.off()
        assert rig.light.illumination is None
        rig.light.off()
    assert rig.light.illumination is None


def test_colours_give_different_frames(live_rig):
    rig = live_rig
    frames = {}
    for colour in ("green", "red"):
        with rig.light.on(Illumination(colour, 0.5)):
            frames[colour] = rig.camera.expose(ExposureSettings(0.05))
    assert frames["red"].illumination == RED
    assert abs(frames["red"].counts.mean() / frames["green"].counts.mean() - 1) > 0.1
