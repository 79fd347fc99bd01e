"""Effects of the sensor: rolling shutter, fixed patterns, dust, mosaic, noise, dark current, response, saturation."""

from dataclasses import replace
from math import hypot, pi, sqrt

import numpy as np

from device.sim.effects.eye import brightest_reflex
from device.sim.effects.illumination import STRAY_ETA_PER_SHARE, pulse_swing
from device.sim.optical_setup import CONSTANT_LIGHT, OpticalSetup, Scene, Size
from device.values import Mask

_SHUTTER_ETA_PER_DEG = 12.0  # a skew moves vessels at the top and bottom edge against each other
_FILTER_LEAK = 0.1  # transmission of a filter of another colour
_RGGB_SITES = {"red": ((0, 0),), "green": ((0, 1), (1, 0)), "blue": ((1, 1),)}
_NONLINEARITY_ETA_PER_SHARE = 140.0
_DUST_ETA_PER_RMS = 2000.0  # of the missing share of the light over the sensor
_GAIN_STEP_ETA_PER_SHARE = 420.0
_COLUMNS_ETA_PER_NOISE = 4.5  # a pattern of columns is as strong along one axis as white noise over both
_SATURATION_SIGMAS = 6.0  # of its noise, by which the brightest pixel may stay below the well and never reach it


class RollingShutter:
    """Rolling shutter: each row is read `line_s` after the one before, so drift skews the image; OPTICS.md 3.9."""

    name = "shutter"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the skew from first to last row, degrees; 0 with a global shutter."""
        skew_deg = scene.sim.eye.drift_deg_per_s * scene.sim.sensor.line_s * scene.spec.camera.rows
        return Size(
            _SHUTTER_ETA_PER_DEG * skew_deg * scene.weight, f"{skew_deg:.3f} deg from the first row to the last"
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Set the shift of the image between two successive rows, px to the right."""
        scene = setup.scene
        setup.lag_px = scene.sim.eye.drift_deg_per_s * scene.sim.sensor.line_s * scene.geometry.px_per_deg


class Dust:
    """Dust on the sensor: round shadows at places that the seed fixes, which the flat frame does not have yet.

    OPTICS.md 3.8.
    """

    name = "dust"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the root mean square of the missing share of the light."""
        sensor, camera = scene.sim.sensor, scene.spec.camera
        dark_um2 = sensor.dust_spots * pi / 4 * sensor.dust_um**2
        covered = min(dark_um2 / (camera.rows * camera.cols * camera.pitch_um**2), 1)
        why = f"{sensor.dust_spots} shadows cover {covered:.2%}"
        return Size(_DUST_ETA_PER_RMS * sensor.dust_shade * sqrt(covered) * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the response by the shadows of the grains."""
        sensor = setup.scene.sim.sensor
        if not sensor.dust_spots:
            return
        places = np.random.default_rng((setup.scene.seed, 71)).random((sensor.dust_spots, 2)) * setup.shape
        rows, cols = np.ogrid[: setup.shape[0], : setup.shape[1]]
        radius_px = sensor.dust_um / setup.scene.spec.camera.pitch_um / 2
        light = np.ones(setup.shape, np.float32)
        for row, col in places:
            light[np.hypot(rows - row, cols - col) < radius_px] = 1 - sensor.dust_shade
        setup.calibrated.multiply_response(light)


class Prnu:
    """Photo-response non-uniformity (PRNU): fixed-pattern gain 1 + prnu N(0, 1); a flat frame corrects it.

    OPTICS.md 3.8. The pattern is white; its ratio to the shot noise, prnu sqrt(signal), is largest at the peak.
    """

    name = "prnu"

    def size(self, scene: Scene) -> Size:
        """Return the fixed pattern over the shot noise at the peak: prnu sqrt(peak)."""
        spread = scene.sim.sensor.prnu
        return Size(spread * sqrt(scene.peak_e), f"{spread:.2%} from pixel to pixel")

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply each pixel's response by this sensor's pattern."""
        draw = np.random.default_rng((setup.scene.seed, 31)).standard_normal(setup.shape, dtype=np.float32)
        setup.multiply_response(np.maximum(1 + np.float32(setup.scene.sim.sensor.prnu) * draw, 0))


class GainStep:
    """Gain step: the right half of the sensor, behind its own amplifier, has another gain than in the flat frame.

    OPTICS.md 3.8.
    """

    name = "gain_step"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the relative step."""
        step = scene.sim.sensor.gain_step
        return Size(_GAIN_STEP_ETA_PER_SHARE * abs(step) * scene.weight, f"{step:.2%} between the halves")

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the response of the right half."""
        step = setup.scene.sim.sensor.gain_step
        if step:
            gain = np.ones(setup.shape, np.float32)
            gain[:, setup.shape[1] // 2 :] += np.float32(step)
            setup.calibrated.multiply_response(gain)


class BayerMosaic:
    """Bayer colour filter array (RGGB) under one colour of light: other filters transmit 0.1; OPTICS.md 1.5."""

    name = "bayer"

    def size(self, scene: Scene) -> Size:
        """Return sqrt(1 / kept - 1), kept being the share of light behind the mosaic; 0 on a monochrome sensor."""
        if not scene.sim.sensor.bayer:
            return Size(0.0, "the sensor is monochrome")
        kept = _FILTER_LEAK + (1 - _FILTER_LEAK) * len(_RGGB_SITES[scene.colour]) / 4
        return Size(sqrt(1 / kept - 1), f"the mosaic lets {kept:.0%} of {scene.colour} light through")

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply each pixel's response by the transmission of its filter."""
        if not setup.scene.sim.sensor.bayer:
            return
        response = np.full(setup.shape, _FILTER_LEAK, np.float32)
        for row, col in _RGGB_SITES[setup.scene.colour]:
            response[row::2, col::2] = 1
        setup.multiply_response(response)


class ShotNoise:
    """Shot noise: the electrons of a pixel follow Poisson's law, variance = mean; OPTICS.md 3.8."""

    name = "shot"

    def size(self, scene: Scene) -> Size:
        """Return the size eta = 1, because eta is measured in units of the noise, mostly shot noise."""
        share = 1 - (scene.spec.camera.read_noise_e / scene.noise_e) ** 2
        origin = "" if scene.budget is None else f"; {scene.budget.why}"
        return Size(1.0, f"{share:.2%} of the variance, {scene.peak_e:.0f} electrons at the peak{origin}")

    def apply(self, setup: OpticalSetup) -> None:
        """Switch the sensor model's shot noise on."""
        setup.sensor = replace(setup.sensor, shot=True)


class DarkCurrent:
    """Dark current: thermal electrons, dark_e_per_s times the exposure time in every pixel; OPTICS.md 3.2."""

    name = "dark"

    def size(self, scene: Scene) -> Size:
        """Return the size eta of stray light with the same mean, before a dark frame is subtracted."""
        dark_e = scene.sim.sensor.dark_e_per_s * scene.spec.camera.exposure_s
        return Size(
            STRAY_ETA_PER_SHARE * dark_e / scene.lit_e * scene.weight,
            f"{dark_e:.1f} electrons in one exposure",
            CONSTANT_LIGHT,
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Set the dark current of the setup, electrons per second in every pixel."""
        setup.dark_e_per_s = setup.scene.sim.sensor.dark_e_per_s


class Dsnu:
    """Dark-signal non-uniformity (DSNU): fixed-pattern offset dsnu_e N(0, 1), which a dark frame corrects.

    OPTICS.md 3.8.
    """

    name = "dsnu"

    def size(self, scene: Scene) -> Size:
        """Return the pattern's standard deviation over the noise of a pixel; the pattern is white."""
        spread_e = scene.sim.sensor.dsnu_e
        return Size(spread_e / scene.noise_e, f"{spread_e:.1f} electrons from pixel to pixel")

    def apply(self, setup: OpticalSetup) -> None:
        """Add this sensor's pattern to the offsets."""
        draw = np.random.default_rng((setup.scene.seed, 37)).standard_normal(setup.shape, dtype=np.float32)
        setup.sensor = setup.sensor.offset_by(np.float32(setup.scene.sim.sensor.dsnu_e) * draw)


class ColumnNoise:
    """Column noise: an offset of each column, column_noise_e N(0, 1), of its own amplifier; OPTICS.md 3.8."""

    name = "columns"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the offsets' standard deviation over the noise of a pixel."""
        spread_e = scene.sim.sensor.column_noise_e
        return Size(
            _COLUMNS_ETA_PER_NOISE * spread_e / scene.noise_e, f"{spread_e:.1f} electrons from column to column"
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Add the offsets of this sensor's columns."""
        draw = np.random.default_rng((setup.scene.seed, 41)).standard_normal(setup.shape[1], dtype=np.float32)
        offset_e = np.float32(setup.scene.sim.sensor.column_noise_e) * draw
        setup.sensor = setup.sensor.offset_by(np.broadcast_to(offset_e, setup.shape))


class HotPixels:
    """Hot pixels: defective pixels with a full well of charge in addition to their light; NUMERICS.md 6.1."""

    name = "hot"

    def size(self, scene: Scene) -> Size:
        """Return the rms error, full well times sqrt(share), over the noise of a pixel."""
        share = scene.sim.sensor.hot_pixels
        camera = scene.spec.camera
        error_e = camera.full_well_e * sqrt(share)
        return Size(error_e / scene.noise_e, f"{share * camera.rows * camera.cols:.0f} pixels are full")

    def apply(self, setup: OpticalSetup) -> None:
        """Add a full well to each hot pixel."""
        full_e = np.float32(setup.scene.spec.camera.full_well_e)
        setup.sensor = setup.sensor.offset_by(hot_pixels(setup.scene) * full_e)


def hot_pixels(scene: Scene) -> Mask:
    """Return the mask of hot pixels, (rows, cols) of the sensor, reproducible by the scene's seed."""
    shape = scene.spec.camera.rows, scene.spec.camera.cols
    return np.random.default_rng((scene.seed, 41)).random(shape) < scene.sim.sensor.hot_pixels


class ReadNoise:
    """Read noise: Gaussian, read_noise_e electrons rms in every pixel of every frame; OPTICS.md 3.8."""

    name = "read"

    def size(self, scene: Scene) -> Size:
        """Return 1 if there is read noise, because it is the noise of a dark frame; else 0."""
        read_e = scene.spec.camera.read_noise_e
        return Size(1.0 if read_e > 0 else 0.0, f"{read_e:.2f} electrons: all the noise that a dark frame has")

    def apply(self, setup: OpticalSetup) -> None:
        """Set the read noise of the sensor."""
        setup.sensor = replace(setup.sensor, read_noise_e=setup.scene.spec.camera.read_noise_e)


class Nonlinearity:
    """Response nonlinearity: a quadratic term that grows towards the full well, s (1 + k s / well); OPTICS.md 3.2."""

    name = "nonlinearity"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the relative error at the peak."""
        at_peak = scene.sim.sensor.nonlinearity * min(scene.peak_e / scene.spec.camera.full_well_e, 1)
        return Size(_NONLINEARITY_ETA_PER_SHARE * abs(at_peak) * scene.weight, f"{at_peak:.2%} at the peak")

    def apply(self, setup: OpticalSetup) -> None:
        """Set the quadratic term of the sensor model: the relative error at the full well."""
        setup.sensor = replace(setup.sensor, nonlinearity=setup.scene.sim.sensor.nonlinearity)


class Saturation:
    """Saturation: charge is clipped at the full well and counts at the converter's white level; OPTICS.md 3.8."""

    name = "saturation"

    def size(self, scene: Scene) -> Size:
        """Return 0 if no pixel is hot and the brightest stays six sigmas below the full well, else a large eta."""
        full_e = scene.spec.camera.full_well_e
        flaws = scene.sim.sensor
        exposure_s = scene.spec.camera.exposure_s
        light = scene.sim.light
        veils = light.stray + light.stray_gradient + light.ambient + light.ghost + brightest_reflex(scene)
        bands = pulse_swing(light.pwm_hz, light.pwm_duty, exposure_s) if light.pwm_hz else 0.0
        even_e = scene.peak_e * (1 + veils) * (1 + bands) * (1 + max(flaws.gain_step, 0))
        even_e += flaws.dark_e_per_s * exposure_s
        noise_e = sqrt(even_e + scene.spec.camera.read_noise_e**2 + flaws.dsnu_e**2)
        top_e = (even_e * (1 + _SATURATION_SIGMAS * flaws.prnu) + _SATURATION_SIGMAS * noise_e) * (
            1 + max(flaws.nonlinearity, 0)
        )
        why = f"the brightest pixel collects up to {top_e:.0f} of {full_e:.0f} electrons"
        return Size(0.0 if top_e < full_e and not flaws.hot_pixels else 10.0 * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Set full well and white level."""
        camera = setup.scene.spec.camera
        setup.sensor = replace(setup.sensor, full_well_e=camera.full_well_e, white_dn=camera.white_dn)


class Quantisation:
    """Quantisation noise of the converter: white, variance (1 LSB)^2 / 12; OPTICS.md 3.2."""

    name = "quantisation"

    def size(self, scene: Scene) -> Size:
        """Return the rounding noise over the noise of a dark frame (rounding and read noise); shot noise is larger."""
        camera = scene.spec.camera
        rounding_e = camera.gain_e_per_dn / sqrt(12)
        why = f"{camera.bit_depth} bit: {rounding_e:.1f} electrons are rounded away, of the noise that a dark frame has"
        return Size(rounding_e / hypot(rounding_e, camera.read_noise_e), why)

    def apply(self, setup: OpticalSetup) -> None:
        """Change nothing: the converter always rounds."""
