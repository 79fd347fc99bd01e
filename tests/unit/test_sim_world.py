"""Simulated world behind camera and lamp."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from scipy.signal import convolve2d

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.config.scene import EyeSpec, ObjectSpec
from device.errors import CameraMissing, CameraStalled, LightFault, SettingError, SpecError
from device.sim.blinks import lid_share
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.objects import moved_behind_field
from device.sim.render import convolved, crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import ExposureSettings, Illumination

HEAD = Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml"


def small_head(**sim):
    """Return the simulated head with larger pixels; `sim` replaces keys of its [sim] table."""
    spec = load_head(HEAD)
    camera = spec.camera.model_copy(update={"rows": 270, "cols": 480, "pitch_um": 4 * spec.camera.pitch_um})
    return spec.model_copy(update={"camera": camera, "sim": spec.sim.model_copy(update=sim)})


@pytest.fixture(scope="module")
def world():
    return World(small_head(), VirtualClock())


def test_green_at_full_drive_reaches_peak_e(world):
    exposure_s = world.spec.camera.exposure_s
    assert world.electrons_per_s("green").max() * exposure_s == pytest.approx(15000, rel=1e-5)
    assert world.electrons_per_s("red").max() > 1.2 * world.electrons_per_s("green").max()


def test_a_preview_in_red_is_bright_and_not_saturated(world):
    camera, light = SimCamera(world), SimLight(world)
    with light.on(Illumination(world.spec.light.preview_colour)):
        counts = camera.expose(ExposureSettings(world.spec.camera.preview_exposure_s)).counts
    assert 0.2 * 4095 < counts.max() < 0.9 * 4095


def test_a_dark_frame_holds_black_level_and_read_noise_only(world):
    counts = SimCamera(world).expose(ExposureSettings(0.1)).counts.astype(np.float64)
    camera = world.spec.camera
    assert counts.mean() == pytest.approx(camera.black_dn, abs=0.01)
    assert counts.max() <= camera.black_dn + 2


def test_ambient_light_needs_no_lamp():
    lit = World(small_head(), VirtualClock(), ambient_e_per_s=5000.0)
    counts = SimCamera(lit).expose(ExposureSettings(0.1)).counts
    assert counts.mean() == pytest.approx(64 + 500 / lit.spec.camera.gain_e_per_dn, rel=0.01)


@pytest.mark.parametrize("scene_shape", [(5, 6), (8, 7), (31, 40)])
@pytest.mark.parametrize("psf_shape", [(7, 7), (6, 6), (40, 40)])
def test_the_blur_is_the_linear_convolution_cropped_about_the_middle(scene_shape, psf_shape):
    rng = np.random.default_rng(0)
    scene, psf = (rng.random(shape).astype(np.float32) for shape in (scene_shape, psf_shape))
    whole = convolve2d(scene, psf)
    shape = (24, 21)
    expected = np.zeros(shape)
    for (row, col), value in np.ndenumerate(whole):
        target = (
            row - scene_shape[0] // 2 - psf_shape[0] // 2 + shape[0] // 2,
            col - scene_shape[1] // 2 - psf_shape[1] // 2 + shape[1] // 2,
        )
        if 0 <= target[0] < shape[0] and 0 <= target[1] < shape[1]:
            expected[target] = value
    assert convolved([(scene, psf)], shape) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_a_point_in_the_scene_shows_the_caustic_around_its_own_pixel():
    psf = np.zeros((9, 9), np.float32)
    psf[4, 4], psf[4, 6] = 0.75, 0.25
    scene = np.zeros((20, 20), np.float32)
    scene[10 + 3, 10 - 2] = 1
    seen = convolved([(scene, psf)], (40, 50))
    assert seen[20 + 3, 25 - 2] == pytest.approx(0.75, abs=1e-5)
    assert seen[20 + 3, 25] == pytest.approx(0.25, abs=1e-5)
    assert crop_or_pad(scene, (40, 50))[23, 23] == 1


def test_the_truth_lies_on_the_sensor_grid_around_its_middle(world):
    truth = world.truth("green")
    assert truth.shape == world.shape
    assert truth.dtype == np.float32
    rows, cols = np.nonzero(truth)
    assert rows.mean() == pytest.approx((270 - 1) / 2, abs=0.2)
    assert cols.mean() == pytest.approx((480 - 1) / 2, abs=0.2)
    assert np.ptp(cols) + 1 == pytest.approx(world.geometry.px_per_deg * 33.4, abs=2)


def test_light_from_beyond_the_sensor_edge_is_included():
    spec = small_head()
    narrow = spec.model_copy(update={"camera": spec.camera.model_copy(update={"rows": 100, "cols": 110})})
    wide, cut = World(spec, VirtualClock()), World(narrow, VirtualClock())
    assert cut.retina.field.sum() > cut.truth("green").astype(bool).sum()
    middle = wide.electrons_per_s("green")[85:185, 185:295]
    part = cut.electrons_per_s("green")
    assert part / part.mean() == pytest.approx(middle / middle.mean(), rel=1e-3)


def test_frames_differ_between_colours(world):
    green, red = world.electrons_per_s("green"), world.electrons_per_s("red")
    assert np.corrcoef(world.truth("green").ravel(), world.truth("red").ravel())[0, 1] < 0.99
    assert np.abs(green / green.max() - red / red.max()).max() > 0.02


def test_the_eyes_refraction_changes_the_caustic_and_not_the_calibration(world):
    myope = World(small_head(eye=EyeSpec(m_dpt=4.0)), VirtualClock())
    assert not np.allclose(myope.psf("green"), world.psf("green"), atol=1e-6)
    assert simulated_calibration(myope).id == simulated_calibration(world).id


def test_the_irradiance_is_computed_once(world):
    assert world.electrons_per_s("green") is world.electrons_per_s("green")


def test_left_eye_has_its_disc_on_the_other_side():
    left = World(small_head(), VirtualClock(), eye="OS")
    assert left.retina.disc[1] < left.retina.fovea[1]


def test_simulated_calibration_is_a_noisy_measurement_of_the_psf(world):
    calibration = simulated_calibration(world)
    psf = calibration.psfs[0].pixels
    true = crop_or_pad(world.psf("green"), world.shape)
    assert psf.shape == world.shape
    assert psf.sum(dtype=np.float64) == pytest.approx(1, abs=1e-4)
    assert 0.999 < np.corrcoef(psf.ravel(), true.ravel())[0, 1] < 1 - 1e-9  # close, and not the truth itself
    assert calibration.simulated
    assert calibration.sensor.gain_e_per_dn == world.spec.camera.gain_e_per_dn
    assert calibration.field_deg == 33.4
    assert abs(psf[:20].sum()) < 1e-5  # no pedestal


def test_a_sensor_smaller_than_the_caustic_can_be_calibrated():
    spec = small_head()
    tiny = spec.model_copy(update={"camera": spec.camera.model_copy(update={"rows": 60, "cols": 75})})
    world = World(tiny, VirtualClock())
    psf = simulated_calibration(world).psfs[0].pixels
    assert np.corrcoef(psf.ravel(), crop_or_pad(world.psf("green"), (60, 75)).ravel())[0, 1] > 0.999


def test_a_photograph_can_be_the_retina(tmp_path):
    picture = np.zeros((60, 90, 3), np.uint8)
    picture[:, 45:] = (200, 100, 50)
    Image.fromarray(picture).save(tmp_path / "eye.png")
    world = World(small_head(object=ObjectSpec(kind="image", image=tmp_path / "eye.png")), VirtualClock())
    for colour, level in {"red": 200, "green": 100, "blue": 50}.items():
        truth = world.truth(colour)
        assert truth[135, 290] == pytest.approx(level / 255, abs=0.01)
        assert truth[135, 190] < 0.01
    assert world.retina.vessels is None


def test_a_file_that_is_no_picture_is_refused(tmp_path):
    (tmp_path / "eye.png").write_text("not a picture")
    with pytest.raises(SpecError, match="cannot be read"):
        World(small_head(object=ObjectSpec(kind="image", image=tmp_path / "eye.png")), VirtualClock()).truth("green")


@pytest.mark.parametrize("missing", ["optics", "sim"])
def test_a_head_without_its_tables_is_refused(missing):
    with pytest.raises(SpecError, match="needs the tables"):
        World(small_head().model_copy(update={missing: None}), VirtualClock())


def test_negative_seeds_are_valid():
    assert World(small_head(seed=-3), VirtualClock()).truth("green").any()


def test_faults_raise_their_errors():
    world = World(small_head(), VirtualClock())
    camera, light = SimCamera(world), SimLight(world)
    world.faults.add("camera.stalled")
    before = world.clock.now_s()
    with pytest.raises(CameraStalled):
        camera.expose(ExposureSettings(0.1))
    assert world.clock.now_s() - before > 0.1
    world.faults = {"camera.missing"}
    with pytest.raises(CameraMissing):
        camera.expose(ExposureSettings(0.1))
    with pytest.raises(CameraMissing):
        SimCamera(world)
    world.faults = {"light.fault"}
    with pytest.raises(LightFault):
        light.on(Illumination("green"))
    assert light.illumination is None
    world.faults.clear()
    assert camera.expose(ExposureSettings(0.1)).number == 1


class SleepHooked(VirtualClock):
    """Virtual clock that calls `during` in each sleep, and takes 10 ms whenever it is read."""

    during = staticmethod(lambda: None)

    def now_s(self):
        self.elapsed_s += 0.01
        return super().now_s()

    def sleep(self, duration_s):
        self.during()
        super().sleep(duration_s)


def test_what_a_frame_computes_falls_within_its_exposure():
    world = World(small_head(), clock := SleepHooked())
    camera = SimCamera(world)
    begin_s = clock.elapsed_s
    camera.expose(ExposureSettings(0.1))
    assert clock.elapsed_s - begin_s == pytest.approx(0.11)  # and the first reading of the clock


def test_a_lamp_that_goes_out_during_an_exposure_leaves_a_dark_frame():
    world = World(small_head(), clock := SleepHooked())
    camera, light = SimCamera(world), SimLight(world)
    shot = ExposureSettings(0.1)
    dark = camera.expose(shot).counts.mean()
    with light.on(Illumination("green")):
        assert camera.expose(shot).counts.mean() > 2 * dark
        clock.during = lambda: setattr(world, "illumination", None)
        frame = camera.expose(shot)
    assert frame.illumination is None
    assert frame.counts.mean() == pytest.approx(dark, abs=0.5)  # dark current and read noise only: counts


def test_a_lamp_that_breaks_before_the_context_begins_stays_dark():
    world = World(small_head(), VirtualClock())
    light = SimLight(world)
    lit = light.on(Illumination("green"))
    world.faults.add("light.fault")
    with pytest.raises(LightFault):
        lit.__enter__()
    assert light.illumination is None


def test_leds_keep_their_colour_without_new_commands():
    """Latch of the real LED chain: without commands the lamp stays on, which is the reason for the guardian process."""
    world = World(small_head(), VirtualClock())
    camera, light = SimCamera(world), SimLight(world)
    light.on(Illumination("green")).__enter__()
    world.clock.sleep(3600)
    assert camera.expose(ExposureSettings(0.01)).illumination == Illumination("green")
    world.faults.add("light.silent")
    with pytest.raises(LightFault, match="hear"):
        light.off()
    assert camera.expose(ExposureSettings(0.01)).illumination == Illumination("green")
    world.faults.clear()
    light.off()
    assert camera.expose(ExposureSettings(0.01)).illumination is None


def test_a_fault_that_does_not_exist_is_refused():
    world = World(small_head(), VirtualClock())
    world.faults.add("camera.stolen")
    with pytest.raises(SettingError, match=r"camera\.stolen"):
        SimCamera(world)


def test_frames_are_marked_as_simulated_and_repeat_with_the_seed():
    frames = []
    for _ in range(2):
        world = World(small_head(), VirtualClock())
        with SimLight(world).on(Illumination("green")):
            frames.append(SimCamera(world).expose(ExposureSettings(0.1)))
    assert all(frame.simulated for frame in frames)
    assert np.array_equal(frames[0].counts, frames[1].counts)


def lit_frames(drift_deg_per_s, count=5):
    """Return the noise-free electrons of lit frames of one eye that drifts."""
    moving = World(small_head(eye=EyeSpec(drift_deg_per_s=drift_deg_per_s)), VirtualClock())
    camera = SimCamera(moving)
    moving.present_eye("OD")
    moving.illumination = Illumination("green")
    frames = []
    for _ in range(count):
        frames.append(moving.electrons(0.1))
        camera.expose(ExposureSettings(0.1))
    return moving, frames


def test_a_drifting_retina_moves_from_frame_to_frame_behind_a_field_that_stands_still():
    moving, frames = lit_frames(4.0)
    step_px = 0.4 * moving.geometry.px_per_deg
    assert moving.eyes.drift_px == pytest.approx(step_px)
    assert np.array_equal(frames[0], frames[4]), "after four frames the eye is back"
    first, second = (frame - frame.mean() for frame in frames[:2])
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.9, "most of the light is the field, which stands still"
    retina, field = moving.retina.reflectance["green"], moving.retina.field
    moved = moved_behind_field(moving.retina, (0.0, step_px), moving.geometry.px_per_deg * moving.scene.half_field_deg)
    inner = ndimage.binary_erosion(field, iterations=round(step_px) + 3)
    expected = ndimage.shift(retina, (0.0, step_px), order=3)
    assert np.abs(moved.reflectance["green"] - expected)[inner].max() < 0.01
    assert not moved.reflectance["green"][~ndimage.binary_dilation(field, iterations=2)].any()


def test_a_shorter_frame_of_a_moving_eye_has_a_shorter_blur_and_step():
    """Two halves of an exposure together show what the whole one does; each moves half as far."""
    moving, frames = lit_frames(4.0)
    halves = []
    moving.lit_frames = 0
    for _ in range(4):
        halves.append(moving.electrons(0.05))
        moving.lit_frames += 1
    assert moving.eyes.parts(0.05) == 2
    moved = float(np.abs(frames[1] - frames[0]).max())

    def apart(left, right):
        """Return the difference of two frames in steps of one exposure."""
        return float(np.abs(left - right).max()) / moved

    # 0.1: light from beyond the edge of the field is smeared with the picture in one long frame
    assert apart(halves[0] + halves[1], frames[0]) < 0.1
    assert apart(halves[2] + halves[3], frames[1]) < 0.1
    assert apart(2 * halves[0], frames[0]) == pytest.approx(0.25, abs=0.1), "its middle is a quarter of a step before"
    assert apart(2 * halves[1], 2 * halves[0]) == pytest.approx(0.5, abs=0.1)
    assert World(small_head(), VirtualClock()).eyes.parts(0.05) == 1, "a still eye looks the same in any exposure"


def test_torsion_turns_the_retina_about_the_middle_of_the_field_from_frame_to_frame():
    turning = World(small_head(eye=EyeSpec(torsion_deg_per_s=30.0)), VirtualClock())
    assert turning.eyes.torsion_deg == pytest.approx(3.0)
    radius_px = turning.geometry.px_per_deg * turning.scene.half_field_deg
    moved = moved_behind_field(turning.retina, (0.0, 0.0), radius_px, 3.0)
    away = np.subtract(turning.retina.disc, (np.array(turning.retina.field.shape) - 1) / 2)
    turned = np.subtract(moved.disc, (np.array(turning.retina.field.shape) - 1) / 2)
    assert np.hypot(*turned) == pytest.approx(np.hypot(*away))
    angle_deg = np.degrees(np.arctan2(-turned[0], turned[1]) - np.arctan2(-away[0], away[1]))
    assert angle_deg == pytest.approx(3.0), "counter-clockwise as displayed"
    still, inner = turning.retina.reflectance["green"], ndimage.binary_erosion(turning.retina.field, iterations=6)
    expected = ndimage.rotate(still, 3.0, reshape=False, order=3)
    assert np.abs(moved.reflectance["green"] - expected)[inner].max() < 0.01
    assert not World(small_head(eye=EyeSpec(torsion_deg_per_s=0.05)), VirtualClock()).eyes.moves, "not seen"


def test_blinks_close_the_lid_for_a_share_of_the_exposures_as_often_as_the_scene_says():
    scene = World(small_head(eye=EyeSpec(blinks_per_min=15)), VirtualClock()).scene
    shares = [lid_share(scene, 0.1 * k, 0.1) for k in range(3000)]
    per_s = 15 / 60
    # 75 +- 9 blinks of 0.25 s in five minutes, few of which overlap.
    assert np.mean(shares) == pytest.approx(1 - np.exp(-0.25 * per_s), rel=0.35)
    assert {0.0, 1.0} <= {round(share, 9) for share in shares}, "frames of an open eye and of a closed lid"
    assert any(0.01 < share < 0.99 for share in shares), "frames during which the lid closes"
    seldom = World(small_head(eye=EyeSpec(blinks_per_min=1)), VirtualClock()).scene
    assert not any(lid_share(seldom, 0.1 * k, 0.1) for k in range(3000)), "a chance below one per cent"


def test_a_closed_lid_shows_even_light():
    clock = VirtualClock()
    blinking = World(small_head(eye=EyeSpec(blinks_per_min=120)), clock)
    blinking.illumination = Illumination("green")
    frames = []
    for _ in range(40):
        clock.sleep(0.1)
        frames.append(blinking.electrons(0.1))
    contrasts = [float(frame.std() / frame.mean()) for frame in frames]
    assert min(contrasts) < 0.05 * max(contrasts)
    assert [float(frame.mean()) for frame in frames] == pytest.approx([frames[0].mean()] * 40, rel=1e-4)


def test_a_still_eye_gives_equal_frames():
    moving, frames = lit_frames(0.05)
    assert moving.eyes.drift_px == 0
    assert all(np.array_equal(frames[0], frame) for frame in frames)


def test_a_simulated_eye_turns_its_disc_into_the_middle_for_the_field_of_the_nerve():
    eyes = World(small_head(), VirtualClock())
    for eye in ("OD", "OS"):
        eyes.present_eye(eye, "centre")
        straight, light = eyes.retina.disc, eyes.electrons_per_s("green")
        eyes.present_eye(eye, "nerve")
        middle = (np.array(eyes.retina.field.shape) - 1) / 2
        assert np.hypot(*(np.array(eyes.retina.disc) - middle)) < 0.01
        assert np.hypot(*(np.array(straight) - middle)) > 9 * eyes.geometry.px_per_deg
        assert not np.array_equal(eyes.electrons_per_s("green"), light)


def test_a_screen_does_not_turn_to_a_fixation_target():
    screen = World(small_head(object=ObjectSpec(kind="point")), VirtualClock())
    screen.present_eye("OD", "nerve")
    assert screen.eyes.turn_deg == (0.0, 0.0)
