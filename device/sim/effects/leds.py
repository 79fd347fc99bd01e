"""Illumination by the single LEDs of a ring that is not conjugate to the eye's pupil, and a dead LED of it.

With f1 and f2 the lenses, a = f1 / f2, the relay is afocal: a ray that leaves an LED at rho (mm off the axis) under
the slope psi enters the eye under theta = -psi / a, whatever its LED. At the pupil it is a (rho - a b theta) off the
axis, b (`sim.light.ring_offset_um`) being the distance of the ring from the plane that is conjugate to the pupil.
Through its hole in the cap each LED could light the same disc of the retina (the field); it lights only the part whose
rays pass the pupil. For LED i this is

    |a rho_i - a^2 b theta - c| <= P / 2,   a disc around (a rho_i - c) / (a^2 b) of radius P / (2 a^2 b),

with c the pupil's decentration (`decentred_um`) and P its diameter (`pupil_um`); the emitter's width softens the edge.
The field is lit by the sum of these discs. For b = 0 every LED lights the whole field: spread and a dead LED change the
common gain only, which the exposure takes out (optics.md 3.5). This is how the paper trims its field by moving the ring
along the axis. The eye's pupil is taken to stand in the relay's focus.
"""

from math import cos, hypot, pi, radians, sin

import numpy as np
from numpy.typing import NDArray

from device.errors import SpecError
from device.optics.eye import overlap
from device.optics.illumination import LEDS
from device.optics.matrix import chain_of, places_mm, ring
from device.sim.setup import Place, Scene, Setup, Size

name = "leds"

EMITTER_MM = 0.25  # width of the green emitter in an APA102-2020; optics.md 3.5 (a guess)
ETA_PER_SHARE = 180.0  # of the standard deviation over the field, relative to the mean
RADII, TURNS = 48, 48  # where the light over the field is evaluated for the size
EDGE_STEPS = 65  # of the soft edge's table


def leds_mm(scene: Scene) -> list[Place]:
    """(right, down) of the LEDs from the axis: the ring of the head's matrix; without one, twelve on `ring_um`."""
    chain = chain_of(scene.spec)
    if chain is not None:
        at = places_mm(chain)
        return [(at[i][0], -at[i][1]) for i in ring(chain)]
    radius, turns = scene.sim.light.ring_um / 2000, (2 * pi * k / LEDS for k in range(LEDS))
    return [(radius * cos(turn), radius * sin(turn)) for turn in turns]


def drives(scene: Scene) -> NDArray[np.float64]:
    """Return each LED's share of the ring's total light, (LEDs,); the shares sum to 1, and the dead LED has 0."""
    light, count = scene.sim.light, len(leds_mm(scene))
    draws = np.random.default_rng((scene.seed, 9)).standard_normal(count)
    drive = np.maximum(1 + light.led_spread * draws, 0.0)
    if light.dead_led is not None:
        if light.dead_led >= count:
            raise SpecError(f"sim.light.dead_led = {light.dead_led}: the ring has the LEDs 0 to {count - 1}")
        drive[light.dead_led] = 0.0
    return np.asarray(drive / drive.sum())


def clearance_mm(scene: Scene) -> float:
    """Least distance between a ray of the field and the pupil's edge, at the pupil; negative where rays are cut."""
    a, eye = scene.optics.angular_magnification, scene.sim.eye
    walk = a**2 * abs(scene.sim.light.ring_offset_um) / 1000 * radians(scene.half_field_deg)
    off = max(hypot(a * x - eye.decentred_um / 1000, a * y) for x, y in leds_mm(scene))
    return eye.pupil_um / 2000 - a * EMITTER_MM / 2 - off - walk


def uneven(scene: Scene) -> bool:
    """True if the ring is offset and the pupil cuts at least one ray; then the field is unevenly lit."""
    lit = scene.sim.eye.shown_by != "screen"
    return lit and scene.sim.light.ring_offset_um != 0 and clearance_mm(scene) < 0


def lit_share(scene: Scene, right_deg: NDArray[np.float64], down_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of the ring's light that reaches places of the retina, 0 to 1, in the shape of the two arguments.

    SpecError where no light enters the pupil at all.
    """
    a, eye = scene.optics.angular_magnification, scene.sim.eye
    slope_mm = a**2 * scene.sim.light.ring_offset_um / 1000  # at the pupil, per unit of theta
    pupil, emitter = eye.pupil_um / 2000, a * EMITTER_MM / 2
    steps = np.linspace(max(pupil - emitter, 0), pupil + emitter, EDGE_STEPS)
    passed = [overlap(float(at), pupil, emitter) for at in steps]
    right, down = slope_mm * np.radians(right_deg), slope_mm * np.radians(down_deg)
    lit = np.zeros(np.broadcast_shapes(right.shape, down.shape))
    for (x, y), drive in zip(leds_mm(scene), drives(scene), strict=True):
        lit += drive * np.interp(np.hypot(a * x - eye.decentred_um / 1000 - right, a * y - down), steps, passed)
    if not lit.any():
        raise SpecError(f"sim.light.ring_offset_um = {1000 * slope_mm / a**2:g}: no LED's light enters the pupil")
    return np.asarray(lit)


def size(scene: Scene) -> Size:
    """In proportion to how unevenly the field is lit; exactly nothing while the pupil cuts no ray."""
    light = scene.sim.light
    if not uneven(scene):
        if scene.sim.eye.shown_by == "screen":
            return Size(0.0, "the screen shines by itself")
        dead = "" if light.dead_led is None else " and a dead one"
        return Size(0.0, f"a spread of {light.led_spread:.0%} between LEDs{dead} changes only the common gain")
    radius_deg = scene.half_field_deg * np.sqrt((np.arange(RADII) + 1) / RADII)[:, None]  # rings of equal area
    turn = 2 * pi * np.arange(TURNS) / TURNS
    lit = lit_share(scene, radius_deg * np.cos(turn), radius_deg * np.sin(turn))
    spread = float(lit.std() / lit.mean())
    why = f"the ring stands {light.ring_offset_um / 1000:g} mm off its place: the field's light varies by {spread:.2%}"
    return Size(ETA_PER_SHARE * spread * scene.weight, why)


def apply(setup: Setup) -> None:
    """Multiply the object by the light that reaches it."""
    if not uneven(setup.scene):
        return
    rows, cols = ((np.arange(n) - (n - 1) / 2) / setup.scene.geometry.px_per_deg for n in setup.object.shape)
    setup.object = (setup.object * lit_share(setup.scene, cols[None, :], rows[:, None])).astype(np.float32)
