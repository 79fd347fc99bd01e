"""Effects of the illumination: penumbra, falloff, single and pulsed LEDs of the ring, stray light, ambient light.

Ring that is not conjugate to the eye's pupil (`Leds`). With f1 and f2 the lenses, a = f1 / f2, the relay is afocal: a
ray that leaves an LED at rho (mm off the axis) under the slope psi enters the eye under theta = -psi / a, whatever its
LED. At the pupil the ray is a (rho - a b theta) off the axis, where b (`sim.light.ring_offset_um`) is the distance of
the ring from the plane that is conjugate to the pupil. Through its hole in the cap each LED could light the same disc
of the retina (the field). The pupil passes only a part of these rays: LED i lights

    |a rho_i - a^2 b theta - c| <= P / 2,   a disc around (a rho_i - c) / (a^2 b) of radius P / (2 a^2 b),

with c the pupil's decentration (`decentred_um`) and P its diameter (`pupil_um`); the emitter's width softens the edge.
The field is lit by the sum of these discs. For b = 0 every LED lights the whole field: spread and a dead LED change the
common gain only, which the exposure compensates (OPTICS.md 3.5). The paper trims its field in the same way, by moving
the ring along the axis. The eye's pupil is assumed to stand in the relay's focus.
"""

from math import cos, hypot, pi, radians, sin

import numpy as np
from numpy.typing import NDArray

from device.errors import SpecError
from device.optics.eye import iris_overlap
from device.optics.illumination import LEDS
from device.optics.led_cap import relative_intensity
from device.optics.matrix import EMITTER_MM, geometry_of, led_positions_mm, ring
from device.sim.optical_setup import CONSTANT_LIGHT, LIGHT_OVER_FIELD, OpticalSetup, Place, Scene, Size
from device.values import Image

STRAY_ETA_PER_SHARE = 320.0  # of the mean signal, where no constant is fitted; a solver that fits one sees less
_FALLOFF_ETA = 7.0  # at 33.4 degrees on a sensor that the field fills, where the edge keeps 0.84 of the light
_FALLOFF_TABLE_LOSS = 1 - cos(radians(16.7)) ** 4
_GRADIENT_ETA_PER_SHARE = 200.0
_PWM_ETA_PER_SHARE = 2200.0  # of half the range of the rows' light
_LEDS_ETA_PER_SHARE = 180.0  # of the standard deviation over the field, relative to the mean
_RADII, _TURNS = 48, 48  # polar grid on which the light over the field is evaluated for the size
_EDGE_STEPS = 65  # of the soft edge's table


class Penumbra:
    """Soft edge of the field: the dies behind the holes of the LEDs' cap, as far as it is seen; OPTICS.md 4.9."""

    name = "penumbra"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, in proportion to the share of the axis's light that the field's edge loses."""
        if scene.cap is None:
            return Size(0.0, "the field has a sharp edge")
        left = float(relative_intensity(scene.cap, scene.optics.angular_magnification, scene.half_field_deg, 0.0))
        why = f"a die of {scene.cap.emitter_mm:g} mm: the field's edge gets {left:.2f} of the middle's light"
        return Size(_FALLOFF_ETA * (1 - left) / _FALLOFF_TABLE_LOSS * scene.weight, why, LIGHT_OVER_FIELD)

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the object, which is as wide as the light, by the intensity relative to that of the axis."""
        setup.object = setup.object * light_of_cap(setup.scene, setup.object.shape)


def light_of_cap(scene: Scene, shape: tuple[int, ...]) -> Image:
    """Return the intensity over that on the axis in the middle of `shape` (rows, cols), float32; 1 without a cap."""
    cap = scene.cap
    magnification = scene.optics.angular_magnification
    if cap is None:
        return np.ones(shape, np.float32)
    places = ((np.arange(n) - (n - 1) / 2) / scene.geometry.px_per_deg for n in shape)
    (down, row), (right, col) = (np.unique(np.abs(axis), return_inverse=True) for axis in places)  # a quadrant
    light = np.vstack([relative_intensity(cap, magnification, right, distance) for distance in down])
    return light[np.ix_(row, col)].astype(np.float32)


class Falloff:
    """Illumination falloff towards the field's edge: cos^4 law (Lambert and the eye's cos^3), and vignetting.

    E(theta) / E(0) = cos^4 theta exp(-(theta / vignette)^2), each factor only where the scene sets it; OPTICS.md 3.5.
    """

    name = "falloff"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the share of light that the field's edge loses."""
        loss = 1 - float(_relative_illuminance(scene, np.array(scene.half_field_deg)))
        if not loss:
            return Size(0.0, "the illumination is even")
        return Size(
            _FALLOFF_ETA * loss / _FALLOFF_TABLE_LOSS * scene.weight,
            f"the field's edge gets {1 - loss:.2f} of the middle's light",
            LIGHT_OVER_FIELD,
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the object by the relative illuminance."""
        rows, cols = (np.arange(n) - (n - 1) / 2 for n in setup.object.shape)
        angle_deg = np.hypot(rows[:, None], cols[None, :]) / setup.scene.geometry.px_per_deg
        setup.object = (setup.object * _relative_illuminance(setup.scene, angle_deg)).astype(np.float32)


def _relative_illuminance(scene: Scene, angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return E(theta) / E(0) at angles from the axis in degrees, 0 to 1, in the shape of `angle_deg`."""
    light = scene.sim.light
    left = np.cos(np.radians(np.minimum(angle_deg, 85))) ** 4 if light.falloff else np.ones_like(angle_deg)
    if light.vignette_deg is not None:
        left = left * np.exp(-((angle_deg / light.vignette_deg) ** 2))
    return np.asarray(left)


class Leds:
    """Uneven illumination by the LEDs, one of them possibly dead, of a ring that is not conjugate to the pupil."""

    name = "leds"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the relative unevenness; 0 for a screen, or if the pupil cuts no ray."""
        light = scene.sim.light
        if not _unevenly_lit(scene):
            if scene.sim.eye.shown_by == "screen":
                return Size(0.0, "the screen shines by itself")
            dead = "" if light.dead_led is None else " and a dead one"
            return Size(0.0, f"a spread of {light.led_spread:.0%} between LEDs{dead} changes only the common gain")
        radius_deg = scene.half_field_deg * np.sqrt((np.arange(_RADII) + 1) / _RADII)[:, None]  # rings of equal area
        turn = 2 * pi * np.arange(_TURNS) / _TURNS
        lit = lit_share(scene, radius_deg * np.cos(turn), radius_deg * np.sin(turn))
        spread = float(lit.std() / lit.mean())
        why = (
            f"the ring stands {light.ring_offset_um / 1000:g} mm off its place: "
            f"the field's light varies by {spread:.2%}"
        )
        return Size(_LEDS_ETA_PER_SHARE * spread * scene.weight, why, LIGHT_OVER_FIELD)

    def apply(self, setup: OpticalSetup) -> None:
        """Multiply the object by the share of the ring's light at each place; no change where the size is 0."""
        if not _unevenly_lit(setup.scene):
            return
        rows, cols = ((np.arange(n) - (n - 1) / 2) / setup.scene.geometry.px_per_deg for n in setup.object.shape)
        setup.object = (setup.object * lit_share(setup.scene, cols[None, :], rows[:, None])).astype(np.float32)


def leds_mm(scene: Scene) -> list[Place]:
    """Return (right, down) of each LED from the axis, mm: the matrix's ring, else 12 on a circle `ring_um` wide."""
    chain = geometry_of(scene.spec)
    if chain is not None:
        at = led_positions_mm(chain)
        return [(at[i][0], -at[i][1]) for i in ring(chain)]
    radius = scene.sim.light.ring_um / 2000
    turns = (2 * pi * k / LEDS for k in range(LEDS))
    return [(radius * cos(turn), radius * sin(turn)) for turn in turns]


def _drives(scene: Scene) -> NDArray[np.float64]:
    """Return each LED's share of the ring's total light, (LEDs,), with the random spread `led_spread`.

    The shares sum to 1, and the dead LED has 0. SpecError for a dead LED that the ring does not have.
    """
    light = scene.sim.light
    count = len(leds_mm(scene))
    draws = np.random.default_rng((scene.seed, 9)).standard_normal(count)
    drive = np.maximum(1 + light.led_spread * draws, 0.0)
    if light.dead_led is not None:
        if light.dead_led >= count:
            raise SpecError(f"sim.light.dead_led = {light.dead_led}: the ring has the LEDs 0 to {count - 1}")
        drive[light.dead_led] = 0.0
    return np.asarray(drive / drive.sum())


def _clearance_mm(scene: Scene) -> float:
    """Return the least distance between a ray of the field and the pupil's edge, at the pupil; < 0 if rays are cut."""
    a = scene.optics.angular_magnification
    eye = scene.sim.eye
    walk = a**2 * abs(scene.sim.light.ring_offset_um) / 1000 * radians(scene.half_field_deg)
    off = max(hypot(a * x - eye.decentred_um / 1000, a * y) for x, y in leds_mm(scene))
    return eye.pupil_um / 2000 - a * EMITTER_MM / 2 - off - walk


def _unevenly_lit(scene: Scene) -> bool:
    """Return true if the ring is offset and the pupil cuts at least one ray; false for a self-luminous screen."""
    lit = scene.sim.eye.shown_by != "screen"
    return lit and scene.sim.light.ring_offset_um != 0 and _clearance_mm(scene) < 0


def lit_share(scene: Scene, right_deg: NDArray[np.float64], down_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of the ring's light that reaches places of the retina, 0 to 1, in the arguments' joint shape.

    Places are degrees right and down from the axis. SpecError if no light enters the pupil for any of them.
    """
    a = scene.optics.angular_magnification
    eye = scene.sim.eye
    slope_mm = a**2 * scene.sim.light.ring_offset_um / 1000  # at the pupil, per unit of theta
    pupil = eye.pupil_um / 2000
    emitter = a * EMITTER_MM / 2
    steps = np.linspace(max(pupil - emitter, 0), pupil + emitter, _EDGE_STEPS)
    passed = [iris_overlap(float(at), pupil, emitter) for at in steps]
    right = slope_mm * np.radians(right_deg)
    down = slope_mm * np.radians(down_deg)
    lit = np.zeros(np.broadcast_shapes(right.shape, down.shape))
    for (x, y), drive in zip(leds_mm(scene), _drives(scene), strict=True):
        lit += drive * np.interp(np.hypot(a * x - eye.decentred_um / 1000 - right, a * y - down), steps, passed)
    if not lit.any():
        raise SpecError(f"sim.light.ring_offset_um = {1000 * slope_mm / a**2:g}: no LED's light enters the pupil")
    return np.asarray(lit)


class Pwm:
    """Pulse-width modulation (PWM) of the LEDs before a rolling shutter: bands of rows; OPTICS.md 3.5."""

    name = "pwm"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to half the range of the rows' light; 0 with a global shutter."""
        light, line_s = scene.sim.light, scene.sim.sensor.line_s
        if not (light.pwm_hz and line_s):
            return Size(0.0, "all rows see the same pulses" if light.pwm_hz else "the LEDs' current is constant")
        half = pulse_swing(light.pwm_hz, light.pwm_duty, scene.spec.camera.exposure_s)
        why = f"pulses at {light.pwm_hz:g} Hz: the light of the rows varies by +-{half:.2%}"
        return Size(_PWM_ETA_PER_SHARE * half * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Set the light of each row over the mean, for an exposure that begins at a time of the clock."""
        light, line_s = setup.scene.sim.light, setup.scene.sim.sensor.line_s
        if not (light.pwm_hz and line_s):
            return
        starts_s = line_s * np.arange(setup.shape[0], dtype=np.float64)

        def light_of_rows(begin_s: float, exposure_s: float) -> Image:
            return pulse_light(begin_s + starts_s, exposure_s, light.pwm_hz, light.pwm_duty)[:, None]

        setup.calibrated.light_of_rows = light_of_rows


def pulse_light(begin_s: NDArray[np.float64], exposure_s: float, pwm_hz: float, duty: float) -> Image:
    """Return the light of pulses within exposures that begin at `begin_s`, over the mean, in its shape; OPTICS.md 3.5.

    A pulse begins at time 0, and lasts for `duty` (above 0, up to 1) of a period.
    """
    begin, end = pwm_hz * begin_s, pwm_hz * (begin_s + exposure_s)
    on = [np.floor(at) * duty + np.minimum(at % 1, duty) for at in (begin, end)]
    return np.asarray((on[1] - on[0]) / (pwm_hz * exposure_s * duty), np.float32)


def pulse_swing(pwm_hz: float, duty: float, exposure_s: float) -> float:
    """Return half the range of `pulse_light` over all beginnings, a share of its mean; OPTICS.md 3.5."""
    rest = pwm_hz * exposure_s % 1
    return (min(rest, duty) - max(rest + duty - 1, 0)) / (2 * pwm_hz * exposure_s * duty)


class Stray:
    """Stray light: constant veiling glare from scatter in lenses and walls while the lamp is on; OPTICS.md 3.7."""

    name = "stray"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to stray light over the mean signal."""
        share = scene.sim.light.stray
        return Size(STRAY_ETA_PER_SHARE * share * scene.weight, f"{share:.2%} of the mean signal", CONSTANT_LIGHT)

    def apply(self, setup: OpticalSetup) -> None:
        """Add a constant to every pixel while the lamp is on, as a share of the mean signal."""
        setup.added_light.veils[self.name] = setup.scene.sim.light.stray


class StrayGradient:
    """Stray light with a gradient: none at the sensor's left edge, most at its right one; OPTICS.md 3.7."""

    name = "gradient"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the stray light at the right edge over the mean signal."""
        share = scene.sim.light.stray_gradient
        why = f"up to {share:.2%} of the mean signal, at the right edge"
        return Size(_GRADIENT_ETA_PER_SHARE * share * scene.weight, why, CONSTANT_LIGHT)

    def apply(self, setup: OpticalSetup) -> None:
        """Add a plane to the veiling light, as a share of the mean signal."""
        across = np.linspace(0, setup.scene.sim.light.stray_gradient, setup.shape[1], dtype=np.float32)
        setup.added_light.veils[self.name] = np.broadcast_to(across, setup.shape)


class Ambient:
    """Ambient light: a constant on every pixel, lamp on or off; a dark frame subtracts the mean, not the noise.

    OPTICS.md 3.7, constant stray light.
    """

    name = "ambient"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to ambient light over the mean signal."""
        share = scene.sim.light.ambient
        return Size(STRAY_ETA_PER_SHARE * share * scene.weight, f"{share:.2%} of the mean signal", CONSTANT_LIGHT)

    def apply(self, setup: OpticalSetup) -> None:
        """Add a constant to every pixel of every frame, as a share of the lit frame's mean signal."""
        setup.added_light.ambient = setup.scene.sim.light.ambient
