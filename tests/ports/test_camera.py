"""Contract of every Camera implementation (device/ports.py)."""

import numpy as np
import pytest

from device.errors import CameraMissing, FrameError
from device.values import ExposureSettings, Illumination

SHOT = ExposureSettings(0.05)
GREEN = Illumination("green")


def test_a_frame_has_the_sensor_shape_and_uint16_counts(rig):
    frame = rig.camera.expose(SHOT)
    assert frame.counts.shape == rig.camera.shape
    assert frame.counts.dtype == np.uint16
    assert frame.exposure_s == SHOT.exposure_s
    assert not frame.counts.flags.writeable


def test_frame_numbers_increase_and_frames_differ(rig):
    with rig.light.on(GREEN):
        frames = [rig.camera.expose(SHOT) for _ in range(3)]
    assert frames[0].number < frames[1].number < frames[2].number
    assert not np.array_equal(frames[0].counts, frames[1].counts)


def test_a_later_exposure_does_not_overwrite_an_earlier_frame(rig):
    with rig.light.on(GREEN):
        first = rig.camera.expose(SHOT)
        kept = first.counts.copy()
        rig.camera.expose(SHOT)
    assert np.array_equal(first.counts, kept)


def test_the_callers_buffer_is_filled(rig):
    buffer = np.zeros(rig.camera.shape, np.uint16)
    with rig.light.on(GREEN):
        frame = rig.camera.expose(SHOT, buffer)
    assert np.shares_memory(frame.counts, buffer)
    assert buffer.max() > 0


def test_a_buffer_that_does_not_fit_is_refused(rig):
    rows, cols = rig.camera.shape
    for wrong in (np.zeros((rows, cols + 1), np.uint16), np.zeros((rows, cols), np.float32)):
        with pytest.raises(FrameError):
            rig.camera.expose(SHOT, wrong)


def test_a_frame_without_lamp_is_dark_and_reports_no_illumination(rig):
    with rig.light.on(GREEN):
        lit = rig.camera.expose(SHOT)
    dark = rig.camera.expose(SHOT)
    assert lit.illumination == GREEN
    assert dark.illumination is None
    assert lit.counts.max() > dark.counts.max() + 50  # of 255, where a camera has eight bits
    assert dark.counts.mean() < lit.counts.mean()


def test_twice_the_exposure_gives_twice_the_light(live_rig):
    rig = live_rig
    dark = rig.camera.expose(SHOT).counts.astype(np.float64).mean()
    with rig.light.on(Illumination("green", 0.5)):
        once = rig.camera.expose(ExposureSettings(0.03)).counts.mean() - dark
        twice = rig.camera.expose(ExposureSettings(0.06)).counts.mean() - dark
    assert twice == pytest.approx(2 * once, rel=0.02)


def test_an_exposure_lasts_at_least_the_exposure_time(rig):
    before = rig.clock.now_s()
    rig.camera.expose(ExposureSettings(0.2))
    assert rig.clock.now_s() - before >= 0.2 - 1e-9


def test_closing_twice_is_harmless_and_a_closed_camera_raises_camera_missing(fresh_rig):
    fresh_rig.camera.close()
    fresh_rig.camera.close()
    with pytest.raises(CameraMissing):
        fresh_rig.camera.expose(SHOT)
