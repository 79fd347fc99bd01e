"""Effects of the eye: spectral reflectance, corneal reflex, refraction, field curvature, motion during the exposure."""

from math import cos, exp, hypot, pi, radians, sin

import numpy as np

from device.optics import eye
from device.optics.diffuser import Refraction
from device.optics.illumination import LEDS
from device.sim.optical_setup import OpticalSetup, Place, Scene, Size
from device.sim.render import azimuth_and_angle
from device.values import Image

_TINT_ETA = {"red": 10.0, "green": 0.0, "blue": 5.0, "amber": 5.0}  # vessels keep 1/7 and 4/5 of their green contrast
_REFRACTION_ETA_PER_DPT = 3.0
_CURVATURE_ETA_PER_DPT = 5.0  # of the mean over the field: its edge is blurred most, and shows it most
_CORNEA_R = (0.376 / 2.376) ** 2
_TISSUE_R = 0.0141  # of the perifovea in green, to which the share refers
_REFLEX_WIDTH = 0.25  # of the iris: the sigma of a blob that fills it
_REFLEX_ETA_PER_SHARE = 55.0  # a smooth blob outside the fitted basis, by its brightest place
_MOTION_ETA_PER_DEG2 = 2.25


class Tint:
    """Spectral reflectance of the object: the contrast of vessels depends on the colour of the light; OPTICS.md 4.1."""

    name = "tint"

    def size(self, scene: Scene) -> Size:
        """Return the size eta by colour of the light: 0 in green, the colour of the ideal setup, and 0 for drawings."""
        if scene.sim.object.kind not in ("retina", "image"):
            return Size(0.0, "this object looks the same in every colour")
        return Size(_TINT_ETA[scene.colour] * scene.weight, f"seen in {scene.colour}; vessels are drawn for green")

    def apply(self, setup: OpticalSetup) -> None:
        """Replace the object by its reflectance in this colour."""
        setup.object = setup.subject.plane(setup.scene.colour)


class Reflex:
    """Corneal reflex (first Purkinje image): the cornea's mirror image of the LED ring, through crossed polarisers.

    Each of 12 LEDs gives a Gaussian blob on the sensor, because the mirror image is 256 dpt out of focus. The blob's
    peak over the mean signal is R_cornea leak / R_tissue, with R_cornea = ((n - 1) / (n + 1))^2 and n = 1.376. Its
    angle from the axis is 2 asin(r_ring / 7.8 mm) - field / 2, r_ring being the radius of the ring's image at the pupil
    (OPTICS.md 3.6).
    """

    name = "reflex"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the reflex's brightest place; 0 without cornea or outside the field."""
        if scene.sim.eye.shown_by != "human eye":
            return Size(0.0, "there is no cornea in front")
        if not _reflex_in_field(scene):
            return Size(0.0, f"the reflex stands {reflex_deg(scene):.1f} deg off the axis, outside the field")
        why = f"up to {brightest_reflex(scene):.2%} of the mean signal, {reflex_deg(scene):.1f} deg off the axis"
        return Size(_REFLEX_ETA_PER_SHARE * brightest_reflex(scene) * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Add the twelve blobs to the veiling light; none if the reflex is outside the field."""
        if _reflex_in_field(setup.scene):
            blobs = reflex_blobs(setup.scene, setup.shape)
            setup.added_light.veils[self.name] = blobs * np.float32(_reflex_share(setup.scene))


def _ring_mm(scene: Scene) -> float:
    """Return the radius of the LED ring's image at the eye's pupil, mm."""
    return scene.sim.light.ring_um / 2000 * scene.optics.angular_magnification


def reflex_deg(scene: Scene) -> float:
    """Return the reflex's angle from the axis, degrees: 2 asin(r_ring / 7.8 mm) - half field; it may be negative."""
    return eye.reflex_deg(_ring_mm(scene), scene.half_field_deg)


def _reflex_share(scene: Scene) -> float:
    """Return the peak of one LED's reflex over the mean signal of the tissue."""
    return _CORNEA_R * scene.sim.light.polariser_leak / _TISSUE_R


def _reflex_in_field(scene: Scene) -> bool:
    """Return true if the scene has a cornea (a human eye) and its mirror image of the ring is inside the field."""
    return scene.sim.eye.shown_by == "human eye" and reflex_deg(scene) <= scene.half_field_deg


def brightest_reflex(scene: Scene) -> float:
    """Return the reflex where the blobs overlap most, over the mean signal of the tissue; 0 outside the field."""
    if not _reflex_in_field(scene):
        return 0.0
    away, wide = _reflex_radius_um(scene), _REFLEX_WIDTH * scene.optics.iris_um
    chords = (2 * away * sin(pi * k / LEDS) for k in range(LEDS))
    amid = LEDS * exp(-((away / wide) ** 2) / 2)
    return _reflex_share(scene) * max(sum(exp(-((chord / wide) ** 2) / 2) for chord in chords), amid)


def _reflex_radius_um(scene: Scene) -> float:
    """Return the distance of the blobs from the axis on the sensor, um."""
    optics = scene.optics
    return optics.angular_magnification * optics.diffuser_to_sensor_um * radians(max(reflex_deg(scene), 0.0))


def reflex_blobs(scene: Scene, shape: tuple[int, int]) -> Image:
    """Return the blobs of all LEDs on the sensor, float32 (rows, cols); each peaks at 1, overlapping ones add."""
    away, wide = _reflex_radius_um(scene), _REFLEX_WIDTH * scene.optics.iris_um
    y_um, x_um = ((np.arange(n) - n // 2) * scene.spec.camera.pitch_um for n in shape)
    out = np.zeros(shape, np.float32)
    for led in range(LEDS):
        turn = 2 * pi * led / LEDS
        squared = (y_um[:, None] - away * sin(turn)) ** 2 + (x_um[None, :] - away * cos(turn)) ** 2
        out += np.exp(-squared / (2 * wide**2)).astype(np.float32)
    return out


class RefractiveError:
    """Refractive error: defocus and astigmatism (M, J0, J45, in dpt) of the eye scale the PSF; OPTICS.md 2.6.

    The edge of the PSF (the caustic) moves by scale_per_dpt hypot(M, J0, J45) times the iris's radius.
    """

    name = "refraction"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the blur strength hypot(M, J0, J45)."""
        m, j0, j45 = scene.refraction
        dpt = hypot(m, j0, j45)
        edge_um = dpt * scene.geometry.scale_per_dpt * scene.optics.iris_um / 2
        return Size(
            _REFRACTION_ETA_PER_DPT * dpt * scene.weight, f"{dpt:.2f} dpt move the caustic's edge by {edge_um:.1f} um"
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Set the refraction of the setup to that of the scene's eye."""
        setup.refraction = setup.scene.refraction


class FieldCurvature:
    """Field curvature and oblique astigmatism of an eye in front of a flat surface; OPTICS.md 3.4.

    The vergences are those of the traced model eye: its lens focuses the edge of the field on curved surfaces. A flat
    screen lies behind both, so its edge is myopic.
    """

    name = "curvature"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the mean defocus, half of that at the edge; 0 for a curved surface."""
        if scene.sim.eye.surface == "curved":
            return Size(0.0, "the surface follows the eye's focus")
        sagittal, tangential = curvature_dpt(scene, scene.half_field_deg)
        mean_dpt = (sagittal + tangential) / 4
        return Size(
            _CURVATURE_ETA_PER_DPT * mean_dpt * scene.weight, f"the edge is {sagittal:.1f} and {tangential:.1f} dpt off"
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Register the additional refraction of each place: sphere and radial cylinder; zero for a curved surface."""
        scene = setup.scene

        def aberration(place: Place) -> Refraction:
            if scene.sim.eye.surface == "curved":
                return Refraction()
            turn, angle_deg = azimuth_and_angle(place)
            sagittal, tangential = curvature_dpt(scene, min(angle_deg, hypot(60, 0)))
            cylinder = (tangential - sagittal) / 2
            return Refraction((sagittal + tangential) / 2, cylinder * cos(2 * turn), cylinder * sin(2 * turn))

        setup.aberrations[self.name] = aberration


def curvature_dpt(scene: Scene, angle_deg: float) -> tuple[float, float]:
    """Return sagittal and tangential defocus of a flat surface at an angle from the axis, dioptres: OPTICS.md 6.4."""
    return eye.flat_screen_dpt(angle_deg, scene.sim.eye.focal_length_um / 1000)


class Motion:
    """Motion blur: constant drift of the eye during the exposure blurs the image along a line; OPTICS.md 3.9."""

    name = "motion"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the square of the drift in one exposure."""
        way_deg = scene.sim.eye.drift_deg_per_s * scene.spec.camera.exposure_s
        return Size(_MOTION_ETA_PER_DEG2 * way_deg**2 * scene.weight, f"{way_deg:.3f} deg in one exposure")

    def apply(self, setup: OpticalSetup) -> None:
        """Set the drift of the image in one exposure, px to the right."""
        scene = setup.scene
        way_deg = scene.sim.eye.drift_deg_per_s * scene.spec.camera.exposure_s
        setup.drift_px = (way_deg * scene.geometry.px_per_deg, 0.0)
