"""The eye, the relay and the field in first order: the numbers of a design before anything is simulated.

Angles are those at the eye, full where they are called a field; optics.md 1.1 to 1.4, and the paper's sections "Optical
design" and "Hardware design". Where the paper contradicts itself is in this folder's README.
"""

from dataclasses import dataclass
from math import acos, asin, atan, degrees, hypot, pi, radians, sin, sqrt, tan

CORNEA_RADIUS_MM = 7.8
CORNEA_INDEX = 1.376
WALK_FROM_DEG, WALK_MM, WALK_POWER = 15.0, 0.12801840, 1.4409122


@dataclass(frozen=True)
class Relay:
    """Two lenses that image the eye's pupil onto the diffuser's iris; the paper's by default."""

    first_mm: float = 37.5
    second_mm: float = 50.0
    iris_mm: float = 3.2
    diffuser_to_sensor_mm: float = 6.0

    @property
    def pupil_magnification(self) -> float:
        """Diffuser over pupil: f2 / f1."""
        return self.second_mm / self.first_mm

    @property
    def angular_magnification(self) -> float:
        """Angle behind the relay over angle at the eye: f1 / f2."""
        return self.first_mm / self.second_mm

    @property
    def iris_at_eye_mm(self) -> float:
        """The iris as the eye's pupil sees it."""
        return self.iris_mm / self.pupil_magnification

    def px_per_deg(self, pitch_um: float) -> float:
        """Sensor pixels per degree at the eye, small angles."""
        return self.angular_magnification * self.diffuser_to_sensor_mm * 1000 * pi / 180 / pitch_um

    def retina_um_per_px(self, pitch_um: float, eye_mm: float) -> float:
        """What one pixel covers on the retina of an eye of that focal length."""
        return pitch_um * eye_mm / (self.angular_magnification * self.diffuser_to_sensor_mm)

    def dot_px(self, dot_um: float, pitch_um: float, eye_mm: float) -> float:
        """The diameter on the sensor of a dot on the retina or the screen, in pixels."""
        return dot_um / self.retina_um_per_px(pitch_um, eye_mm)

    def dot_null_cpd(self, dot_um: float, eye_mm: float) -> float:
        """The first null of the dot's spectrum, cycles per degree: 1.22 / its angle."""
        return 1.22 / degrees(dot_um / (1000 * eye_mm))

    def half_shift_mm(self, field_deg: float) -> float:
        """s = a f_d theta / 2: how far the caustic of the field's edge moves on the sensor (paper, small angles)."""
        return self.angular_magnification * self.diffuser_to_sensor_mm * radians(field_deg) / 2

    def half_shift_tan_mm(self, field_deg: float) -> float:
        """The same for an ideal (f-tan) relay."""
        return self.angular_magnification * self.diffuser_to_sensor_mm * tan(radians(field_deg / 2))

    def extent_mm(self, field_deg: float) -> float:
        """d + 2 s: the sensor that catches all light of the field (paper's rule D > d + 2 s)."""
        return self.iris_mm + 2 * self.half_shift_mm(field_deg)

    def strict_field_deg(self, sensor_mm: float) -> float:
        """The widest field that keeps the paper's rule on that side of a sensor; 0 if none does."""
        room_mm = sensor_mm - self.iris_mm
        return max(0.0, degrees(room_mm / (self.angular_magnification * self.diffuser_to_sensor_mm)))

    def captured(self, field_deg: float, sensor_mm: float) -> float:
        """The share of the light of a point at the field's edge that falls on a sensor of that side; optics.md 1.5."""
        u = (sensor_mm / 2 - self.half_shift_mm(field_deg)) / (self.iris_mm / 2)
        u = max(-1.0, min(1.0, u))
        return 1 - (acos(u) - u * sqrt(1 - u * u)) / pi

    def half_caught_field_deg(self, sensor_mm: float) -> float:
        """The field at whose edge half the light still falls on a sensor of that side; optics.md 1.5."""
        return degrees(sensor_mm / (self.angular_magnification * self.diffuser_to_sensor_mm))

    def scale_per_dpt(self) -> float:
        """z a^2: how much one dioptre stretches the caustic."""
        return self.diffuser_to_sensor_mm / 1000 * self.angular_magnification**2

    def edge_shift_um_per_dpt(self) -> float:
        """How far one dioptre moves the caustic at the iris's edge."""
        return self.scale_per_dpt() * self.iris_mm / 2 * 1000

    def led_cone_deg(self, field_deg: float) -> float:
        """The full cone that an LED must shine to light a field: theta_illum = (f2 / f1) theta_LED."""
        return field_deg / self.pupil_magnification

    def ring_at_pupil_mm(self, ring_mm: float) -> float:
        """The LED ring's diameter as the pupil sees it."""
        return ring_mm / self.pupil_magnification

    def beam_at_iris_mm(self, pupil_mm: float) -> float:
        """The diameter of the pupil's image on the iris."""
        return pupil_mm * self.pupil_magnification

    def pupil_margin_mm(self, pupil_mm: float) -> float:
        """How far the pupil's image may slide over the iris before it clips, at the diffuser: (m P - d) / 2."""
        return (self.beam_at_iris_mm(pupil_mm) - self.iris_mm) / 2

    def filled_field_deg(self, pupil_mm: float) -> float:
        """The full field within which beam walk leaves the iris filled (optics.md 1.4); 0 for a pupil too small."""
        margin_mm = self.pupil_margin_mm(pupil_mm)
        if margin_mm < 0:
            return 0.0
        return 2 * (WALK_FROM_DEG + float((margin_mm / WALK_MM) ** (1 / WALK_POWER)))

    def clear_at_first_mm(self, field_deg: float) -> float:
        """The diameter that the first lens must have: the chief ray's height and the beam's half, twice."""
        return 2 * self.first_mm * tan(radians(field_deg / 2)) + self.iris_at_eye_mm

    def clear_before_iris_mm(self, field_deg: float, distance_mm: float) -> float:
        """The light's diameter at a distance before the iris."""
        return 2 * distance_mm * self.angular_magnification * tan(radians(field_deg / 2)) + self.iris_mm


def field_deg(object_mm: float, focal_length_mm: float = 25.0) -> float:
    """The full field that an object of that size fills behind a lens: 2 atan(h / 2f)."""
    return 2 * degrees(atan(object_mm / (2 * focal_length_mm)))


def size_mm(field_deg: float, focal_length_mm: float = 25.0) -> float:
    """The object that fills a full field: h = 2 f tan(theta / 2)."""
    return 2 * focal_length_mm * tan(radians(field_deg / 2))


def correction_dpt(distance_mm: float, focal_length_mm: float = 25.0) -> float:
    """The spectacle correction of a model eye whose screen stands at a distance from its lens: 1/s - 1/f."""
    return 1000 / distance_mm - 1000 / focal_length_mm


def walk_mm(angle_deg: float) -> float:
    """How far the beam of a field angle walks over the iris: one law through three anchors; optics.md 1.4."""
    return float(WALK_MM * max(0.0, abs(angle_deg) - WALK_FROM_DEG) ** WALK_POWER)


def overlap(shift_mm: float, beam_mm: float, iris_mm: float) -> float:
    """The share of an iris that a wider round beam covers when their middles are apart; radii, optics.md 1.4, V."""
    x, big, r = abs(shift_mm), beam_mm, iris_mm
    if x <= big - r:
        return 1.0
    if x >= big + r:
        return 0.0
    lens = r * r * acos((x * x + r * r - big * big) / (2 * x * r))
    lens += big * big * acos((x * x + big * big - r * r) / (2 * x * big))
    lens -= 0.5 * sqrt((-x + r + big) * (x + r - big) * (x - r + big) * (x + r + big))
    return lens / (pi * r * r)


def petzval_mm(focal_length_mm: float = 25.0, index: float = 1.517) -> tuple[float, float]:
    """Radii of the sagittal and the tangential image surface of a thin lens with its stop: f/(1 + 1/n), f/(3 + 1/n)."""
    return focal_length_mm / (1 + 1 / index), focal_length_mm / (3 + 1 / index)


def cornea_reflectance(index: float = CORNEA_INDEX) -> float:
    """Of the cornea's first surface, at right angles (Fresnel)."""
    return ((index - 1) / (index + 1)) ** 2


def reflex_free_mm(half_field_deg: float) -> float:
    """How far from the axis light must enter so that the cornea mirrors it outside the field: R sin(theta)."""
    return CORNEA_RADIUS_MM * sin(radians(half_field_deg))


def reflex_deg(ring_radius_mm: float, half_field_deg: float) -> float:
    """Where the mirror image of an off-axis LED stands, degrees from the axis; optics.md 3.6."""
    return 2 * degrees(asin(min(ring_radius_mm / CORNEA_RADIUS_MM, 1.0))) - half_field_deg


def strongest_dpt(m_dpt: float, j0_dpt: float, j45_dpt: float) -> float:
    """The refraction of the strongest meridian, without its sign."""
    return abs(m_dpt) + hypot(j0_dpt, j45_dpt)
