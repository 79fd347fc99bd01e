"""What every Light keeps, whoever made it (device/ports.py)."""

import pytest

from device.values import Glow, Shot

GREEN, RED = Glow("green"), Glow("red", 0.5)


def test_it_is_dark_by_default(fresh_rig):
    assert fresh_rig.light.glow is None
    assert fresh_rig.camera.expose(Shot(0.01)).glow is None


def test_it_shines_what_it_was_told_until_the_context_ends(rig):
    for glow in (GREEN, RED):
        with rig.light.on(glow):
            assert rig.light.glow == glow
        assert rig.light.glow is None


def test_it_is_dark_after_an_exception(rig):
    with pytest.raises(ZeroDivisionError), rig.light.on(GREEN):
        raise ZeroDivisionError
    assert rig.light.glow is None


def test_a_context_that_is_never_entered_stays_dark(rig):
    rig.light.on(GREEN)
    assert rig.light.glow is None


def test_off_ends_the_light_at_once_and_is_harmless_twice(rig):
    with rig.light.on(GREEN):
        rig.light.off()
        assert rig.light.glow is None
        rig.light.off()
    assert rig.light.glow is None


def test_the_colours_are_different_pictures(live_rig):
    rig = live_rig
    frames = {}
    for colour in ("green", "red"):
        with rig.light.on(Glow(colour, 0.5)):
            frames[colour] = rig.camera.expose(Shot(0.05))
    assert frames["red"].glow == RED
    assert abs(frames["red"].counts.mean() / frames["green"].counts.mean() - 1) > 0.1
