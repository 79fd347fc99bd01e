"""First-order optics of eye, relay and field.

Angles are those at the eye, full where they are called a field; OPTICS.md 1.1 to 1.4, and the paper's sections "Optical
design" and "Hardware design". Contradictions in the paper: `decisions/` of this folder.
"""

from dataclasses import dataclass
from math import acos, asin, atan, degrees, pi, radians, sin, sqrt, tan

CORNEA_RADIUS_MM = 7.8
# Series through the ray trace of the real lenses, in powers of the half field over 30 degrees (OPTICS.md 6.3, 6.4);
# tests/physics/test_traced_relay.py compares them with the trace up to TRACED_TO_DEG.
TRACED_TO_DEG = 31.0
WALK_MM = {3: 5.2596, 5: 0.5667, 7: 0.0947}
SAGITTAL_DPT = {2: 6.4251, 4: -0.0886, 6: -0.0070}  # of a flat screen behind the model eye's lens
TANGENTIAL_DPT = {2: 11.6529, 4: 1.8813, 6: 0.5779}
# Chromatic eye: Rx = p - q / (lambda - c), dioptres and nm (Thibos et al., Applied Optics 31, 3594, 1992).
CHROMATIC_Q, CHROMATIC_C_NM = 633.46, 214.102
MODEL_EYE_MM = 25.2  # traced focal length of that lens at 0.55 um


@dataclass(frozen=True)
class Relay:
    """Afocal relay of two lenses that images the eye's pupil onto the diffuser's iris; the paper's by default."""

    first_mm: float = 37.5
    second_mm: float = 50.0
    iris_mm: float = 3.2
    diffuser_to_sensor_mm: float = 6.0

    @property
    def pupil_magnification(self) -> float:
        """Size at the diffuser over size at the eye's pupil: f2 / f1."""
        return self.second_mm / self.first_mm

    @property
    def angular_magnification(self) -> float:
        """Angle behind the relay over angle at the eye: f1 / f2."""
        return self.first_mm / self.second_mm

    @property
    def iris_at_eye_mm(self) -> float:
        """Diameter of the iris's image at the eye's pupil, mm."""
        return self.iris_mm / self.pupil_magnification

    def px_per_deg(self, pitch_um: float) -> float:
        """Return sensor pixels per degree at the eye, for small angles."""
        return self.angular_magnification * self.diffuser_to_sensor_mm * 1000 * pi / 180 / pitch_um

    def retina_um_per_px(self, pitch_um: float, eye_mm: float) -> float:
        """Return the width of one pixel on the retina of an eye of that focal length, um."""
        return pitch_um * eye_mm / (self.angular_magnification * self.diffuser_to_sensor_mm)

    def scale_per_dpt(self) -> float:
        """Return z a^2, the relative scaling of the caustic per dioptre."""
        return self.diffuser_to_sensor_mm / 1000 * self.angular_magnification**2

    def led_cone_deg(self, field_deg: float) -> float:
        """Return the full cone of an LED that lights a field, degrees: theta_illum = (f2 / f1) theta_LED."""
        return field_deg / self.pupil_magnification

    def ring_at_pupil_mm(self, ring_mm: float) -> float:
        """Return the diameter of the LED ring's image at the pupil, mm."""
        return ring_mm / self.pupil_magnification

    def beam_at_iris_mm(self, pupil_mm: float) -> float:
        """Return the diameter of the pupil's image on the iris, mm."""
        return pupil_mm * self.pupil_magnification

    def pupil_margin_mm(self, pupil_mm: float) -> float:
        """Return the largest shift of the pupil's image over the iris that leaves the iris filled, mm; < 0 if none."""
        return (self.beam_at_iris_mm(pupil_mm) - self.iris_mm) / 2

    def filled_field_deg(self, pupil_mm: float) -> float:
        """Return the full field within which beam walk leaves the iris filled, degrees (OPTICS.md 1.4).

        0 if the pupil's image is smaller than the iris.
        """
        margin_mm = self.pupil_margin_mm(pupil_mm)
        if margin_mm < 0:
            return 0.0
        low_deg, high_deg = 0.0, 90.0
        for _ in range(50):  # beam walk grows with the angle: halve the interval that holds the margin
            middle_deg = (low_deg + high_deg) / 2
            filled = beam_walk_mm(middle_deg) <= margin_mm
            low_deg, high_deg = (middle_deg, high_deg) if filled else (low_deg, middle_deg)
        return 2 * low_deg

    def first_lens_aperture_mm(self, field_deg: float) -> float:
        """Return the clear aperture of the first lens, mm: twice the chief ray's height plus the beam's diameter."""
        return 2 * self.first_mm * tan(radians(field_deg / 2)) + self.iris_at_eye_mm

    def beam_before_iris_mm(self, field_deg: float, distance_mm: float) -> float:
        """Return the diameter of the light of the whole field at a distance before the iris, mm."""
        return 2 * distance_mm * self.angular_magnification * tan(radians(field_deg / 2)) + self.iris_mm


def field_deg(object_mm: float, focal_length_mm: float = 25.0) -> float:
    """Return the full field of an object behind a lens, degrees: 2 atan(h / 2f)."""
    return 2 * degrees(atan(object_mm / (2 * focal_length_mm)))


def size_mm(field_deg: float, focal_length_mm: float = 25.0) -> float:
    """Return the size of an object that fills a full field, mm: h = 2 f tan(theta / 2)."""
    return 2 * focal_length_mm * tan(radians(field_deg / 2))


def correction_dpt(distance_mm: float, focal_length_mm: float = 25.0) -> float:
    """Return the spectacle correction of a model eye with its screen at a distance from its lens, dpt: 1/s - 1/f."""
    return 1000 / distance_mm - 1000 / focal_length_mm


def beam_walk_mm(angle_deg: float) -> float:
    """Return the shift of the beam over the iris at a field angle, mm: the ray trace's series; OPTICS.md 6.3."""
    return _series(WALK_MM, angle_deg)


def flat_screen_dpt(angle_deg: float, focal_length_mm: float) -> tuple[float, float]:
    """Return sagittal and tangential vergence, dpt, of a flat screen in the focus of the model eye; OPTICS.md 6.4.

    `focal_length_mm` scales the lens with its screen.
    """
    scale = MODEL_EYE_MM / focal_length_mm
    return scale * _series(SAGITTAL_DPT, angle_deg), scale * _series(TANGENTIAL_DPT, angle_deg)


def _series(terms: dict[int, float], angle_deg: float) -> float:
    return sum(factor * (abs(angle_deg) / 30) ** power for power, factor in terms.items())


def iris_overlap(shift_mm: float, beam_mm: float, iris_mm: float) -> float:
    """Return the share of an iris, 0 to 1, that a wider round beam covers at a shift of their centres.

    `beam_mm` and `iris_mm` are radii; OPTICS.md 1.4, V.
    """
    x = abs(shift_mm)
    big = beam_mm
    r = iris_mm
    if x <= big - r:
        return 1.0
    if x >= big + r:
        return 0.0
    lens = r * r * acos((x * x + r * r - big * big) / (2 * x * r))
    lens += big * big * acos((x * x + big * big - r * r) / (2 * x * big))
    lens -= 0.5 * sqrt((-x + r + big) * (x + r - big) * (x - r + big) * (x + r + big))
    return lens / (pi * r * r)


def reflex_free_mm(half_field_deg: float) -> float:
    """Return the least height at the pupil whose corneal reflex falls outside the field, mm: R sin(theta)."""
    return CORNEA_RADIUS_MM * sin(radians(half_field_deg))


def reflex_deg(ring_radius_mm: float, half_field_deg: float) -> float:
    """Return the corneal reflex's angle from the axis, degrees: 2 asin(r / 7.8 mm) - half field; it may be negative.

    r = `ring_radius_mm`: radius of the LED ring's image at the eye's pupil. Inside the field if <= `half_field_deg`.
    """
    return 2 * degrees(asin(min(ring_radius_mm / CORNEA_RADIUS_MM, 1.0))) - half_field_deg


def chromatic_difference_dpt(wavelength_um: float, reference_um: float) -> float:
    """Return by how much the eye is more myopic at a wavelength than at the reference, dioptres.

    0.400 to 0.700 um. Source: Thibos et al., Applied Optics 31, 3594 (1992); -0.50 from 522 to 622 nm.
    """
    return CHROMATIC_Q / (1000 * wavelength_um - CHROMATIC_C_NM) - CHROMATIC_Q / (1000 * reference_um - CHROMATIC_C_NM)
