"""The beam that walks over the iris at wide angles, and pupils too small or off the axis (optics.md 1.4, 3.3)."""

from math import cos, radians, sin, tan

from device.sim.render import azimuth_and_angle
from device.sim.setup import Place, Scene, Setup, Size

name = "pupil"

WALK_FROM_DEG, WALK_MM, WALK_POWER = 15.0, 0.12801840, 1.4409122
ETA_PER_MM = 220.0  # of the beam's edge inside the iris's: the caustic of the field's edge loses a side


def walk_mm(angle_deg: float) -> float:
    """How far the beam's middle has walked at the diffuser: the paper's three anchors in one law."""
    return float(WALK_MM * max(0.0, abs(angle_deg) - WALK_FROM_DEG) ** WALK_POWER)


def shift_mm(scene: Scene, angle_deg: float) -> float:
    """How far the beam's middle is from the iris's at most, at this angle."""
    eye, m = scene.sim.eye, 1 / scene.optics.angular_magnification
    walk = walk_mm(angle_deg) if eye.walks else 0.0
    return walk + m * (eye.decentred_um + abs(eye.axial_um) * tan(radians(angle_deg))) / 1000


def room_mm(scene: Scene) -> float:
    """How far the beam may move before the iris cuts it."""
    return (scene.sim.eye.pupil_um / scene.optics.angular_magnification - scene.optics.iris_um) / 2000


def size(scene: Scene) -> Size:
    """Exactly nothing while the beam of the field's edge still fills the iris."""
    shift, room = shift_mm(scene, scene.half_field_deg), room_mm(scene)
    why = f"at the edge the beam is {shift:.2f} mm off, and the iris is filled up to {room:.2f} mm"
    return Size(ETA_PER_MM * max(shift - room, 0.0) * scene.weight, why)


def apply(setup: Setup) -> None:
    """Register how far the beam's middle is from the iris's, in um, for each place in the field."""
    scene = setup.scene
    eye, m = scene.sim.eye, 1 / scene.optics.angular_magnification

    def there(place: Place) -> tuple[float, float]:
        turn, angle_deg = azimuth_and_angle(place)
        radial_um = 1000 * (walk_mm(angle_deg) if eye.walks else 0.0)
        radial_um += m * eye.axial_um * tan(radians(min(angle_deg, 60)))
        return radial_um * cos(turn) + m * eye.decentred_um, radial_um * sin(turn)

    setup.beams[name] = there
