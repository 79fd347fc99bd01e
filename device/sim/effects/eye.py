"""Effects of the eye: reflectance, corneal reflex, refraction in the field, accommodation, tear film, motion."""

from math import ceil, cos, exp, hypot, pi, radians, sin, sqrt, tan

import numpy as np
from scipy import ndimage

from device.optics import eye
from device.optics.diffuser import Refraction
from device.optics.illumination import LEDS, PEAK_UM
from device.sim.optical_setup import MEAN_SPHERE, OpticalSetup, Place, Scene, Size
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
_LOCAL_ETA_PER_DPT = 2.5  # of the root mean square over the field, of a refraction that is zero in its middle
_TEAR_FILM_ETA_PER_SHARE_DEG = 6.0  # for a width of one degree; smaller angles remove less detail
_HUMAN_INDEX = 1.336  # of aqueous and vitreous humour
_RETINA_RADIUS_UM = 12000.0  # OPTICS.md 3.4
_WIDEST_DEG = 60.0  # of the local effects: farther out, their values at this angle
_OBLIQUE_AT_DEG = 30.0
_MAX_SCATTERED = 0.9  # of the light, by a tear film that is broken everywhere


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
    away = _reflex_radius_um(scene)
    wide = _REFLEX_WIDTH * scene.optics.iris_um
    chords = (2 * away * sin(pi * k / LEDS) for k in range(LEDS))
    amid = LEDS * exp(-((away / wide) ** 2) / 2)
    return _reflex_share(scene) * max(sum(exp(-((chord / wide) ** 2) / 2) for chord in chords), amid)


def _reflex_radius_um(scene: Scene) -> float:
    """Return the distance of the blobs from the axis on the sensor, um."""
    optics = scene.optics
    return optics.angular_magnification * optics.diffuser_to_sensor_um * radians(max(reflex_deg(scene), 0.0))


def reflex_blobs(scene: Scene, shape: tuple[int, int]) -> Image:
    """Return the blobs of all LEDs on the sensor, float32 (rows, cols); each peaks at 1, overlapping ones add."""
    away = _reflex_radius_um(scene)
    wide = _REFLEX_WIDTH * scene.optics.iris_um
    y_um, x_um = ((np.arange(n) - n // 2) * scene.spec.camera.pitch_um for n in shape)
    out = np.zeros(shape, np.float32)
    for led in range(LEDS):
        turn = 2 * pi * led / LEDS
        squared = (y_um[:, None] - away * sin(turn)) ** 2 + (x_um[None, :] - away * cos(turn)) ** 2
        out += np.exp(-squared / (2 * wide**2)).astype(np.float32)
    return out


class RefractiveError:
    """Refractive error: defocus and astigmatism (M, J0, J45, in dpt) of the eye scale the PSF; OPTICS.md 2.6.

    The rms shift of the PSF's edge (the caustic) is scale_per_dpt hypot(M, J0, J45) times the iris's radius.
    """

    name = "refraction"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the blur strength hypot(M, J0, J45)."""
        m, j0, j45 = scene.refraction
        dpt = hypot(m, j0, j45)
        edge_um = dpt * scene.geometry.scale_per_dpt * scene.optics.iris_um / 2
        return Size(
            _REFRACTION_ETA_PER_DPT * dpt * scene.weight,
            f"{dpt:.2f} dpt move the caustic's edge by {edge_um:.1f} um",
            MEAN_SPHERE,
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
        why = f"the edge is {sagittal:.1f} and {tangential:.1f} dpt off"
        return Size(_CURVATURE_ETA_PER_DPT * mean_dpt * scene.weight, why, MEAN_SPHERE)

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


class Accommodation:
    """Accommodation to the fixation target with lead and lag: added to the eye's mean sphere M; OPTICS.md 3.10.

    R = lead + slope D, from 0 to the amplitude, with the demand D = target - M: a long-sighted eye needs more, and the
    part of its refractive error that it accommodates is not measured without cycloplegia.
    """

    name = "accommodation"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the response; 0 for slope and lead 0, a relaxed eye."""
        response_dpt = accommodation_dpt(scene)
        if response_dpt == 0:
            return Size(0.0, "the eye is relaxed")
        demand_dpt = scene.sim.eye.fixation_dpt - scene.sim.eye.m_dpt
        why = f"{response_dpt:.2f} dpt for a demand of {demand_dpt:.2f} dpt"
        return Size(_REFRACTION_ETA_PER_DPT * response_dpt * scene.weight, why, MEAN_SPHERE)

    def apply(self, setup: OpticalSetup) -> None:
        """Add the response to the mean sphere of the setup's refraction."""
        m, j0, j45 = setup.refraction
        setup.refraction = Refraction(m + accommodation_dpt(setup.scene), j0, j45)


def accommodation_dpt(scene: Scene) -> float:
    """Return the accommodative response of the scene's eye, dioptres, 0 to its amplitude."""
    eye = scene.sim.eye
    response_dpt = eye.accommodation_lead_dpt + eye.accommodation_slope * (eye.fixation_dpt - eye.m_dpt)
    return min(max(response_dpt, 0.0), eye.accommodation_amplitude_dpt)


class ChromaticFocus:
    """Chromatic difference of focus of a human eye: M in another colour differs from M in green; OPTICS.md 3.10.

    The eye's `m_dpt` holds for the green LED.
    """

    name = "chromatic"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the difference; 0 in green, and where no human eye is in front."""
        difference_dpt = chromatic_dpt(scene)
        if difference_dpt == 0:
            why = "the eye's refraction is that in green" if scene.colour == "green" else "there is no human eye"
            return Size(0.0, why)
        eta = _REFRACTION_ETA_PER_DPT * abs(difference_dpt) * scene.weight
        return Size(eta, f"{difference_dpt:+.2f} dpt in {scene.colour} from green", MEAN_SPHERE)

    def apply(self, setup: OpticalSetup) -> None:
        """Add the difference to the mean sphere of the setup's refraction."""
        m, j0, j45 = setup.refraction
        setup.refraction = Refraction(m + chromatic_dpt(setup.scene), j0, j45)


def chromatic_dpt(scene: Scene) -> float:
    """Return the difference of M from green to the scene's colour, dioptres; positive: more myopic."""
    if scene.sim.eye.shown_by != "human eye" or scene.colour == "green":
        return 0.0
    return eye.chromatic_difference_dpt(PEAK_UM[scene.colour], PEAK_UM["green"])


class ObliqueAstigmatism:
    """Peripheral astigmatism of the eye: the tangential meridian is the stronger one, by theta^2; OPTICS.md 3.10.

    theta is the angle from the eye's own axis, so a turned eye is astigmatic in the middle of the field.
    """

    name = "oblique"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the root mean square of the cylinder component over the field."""
        if scene.sim.eye.oblique_dpt == 0:
            return Size(0.0, "the meridians of the eye agree over the field")
        half_deg = scene.half_field_deg
        off_deg = hypot(*scene.axis_deg)
        rms_deg2 = sqrt(half_deg**4 / 3 + 2 * half_deg**2 * off_deg**2 + off_deg**4)
        rms_dpt = scene.sim.eye.oblique_dpt / 2 * rms_deg2 / _OBLIQUE_AT_DEG**2
        edge_dpt = scene.sim.eye.oblique_dpt * ((half_deg + off_deg) / _OBLIQUE_AT_DEG) ** 2
        return Size(_LOCAL_ETA_PER_DPT * rms_dpt * scene.weight, f"up to {edge_dpt:.2f} dpt between the meridians")

    def apply(self, setup: OpticalSetup) -> None:
        """Register the cylinder of each place; the stronger meridian is along the radius from the eye's axis."""
        right_deg, down_deg = setup.scene.axis_deg
        at_30_dpt = setup.scene.sim.eye.oblique_dpt

        def aberration(place: Place) -> Refraction:
            turn, angle_deg = azimuth_and_angle((place[0] - right_deg, place[1] - down_deg))
            component = at_30_dpt / 2 * (min(angle_deg, _WIDEST_DEG) / _OBLIQUE_AT_DEG) ** 2
            return Refraction(0.0, component * cos(2 * turn), component * sin(2 * turn))

        if at_30_dpt:
            setup.aberrations[self.name] = aberration


class RetinaTilt:
    """Tilted or decentred retina: the mean sphere changes linearly over the field; OPTICS.md 3.10.

    dM = (tan tilt + decentration / radius) tan theta / (n f), with n = 1.336 in a human eye and 1 in a model eye.
    """

    name = "tilt"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the root mean square of the change of M over the field."""
        slope_dpt = hypot(*tilt_dpt(scene))
        if slope_dpt == 0:
            return Size(0.0, "the retina is neither tilted nor decentred")
        rms_deg = sqrt(scene.half_field_deg**2 / 4 + hypot(*scene.axis_deg) ** 2)
        edge_dpt = slope_dpt * tan(radians(min(scene.half_field_deg + hypot(*scene.axis_deg), _WIDEST_DEG)))
        eta = _LOCAL_ETA_PER_DPT * slope_dpt * tan(radians(min(rms_deg, _WIDEST_DEG))) * scene.weight
        return Size(eta, f"M changes by up to {edge_dpt:.2f} dpt from the axis to the edge")

    def apply(self, setup: OpticalSetup) -> None:
        """Register the mean sphere of each place, zero on the eye's axis; nothing for a retina without tilt."""
        right_deg, down_deg = setup.scene.axis_deg
        per_right, per_down = tilt_dpt(setup.scene)

        def aberration(place: Place) -> Refraction:
            turn, angle_deg = azimuth_and_angle((place[0] - right_deg, place[1] - down_deg))
            tangent = tan(radians(min(angle_deg, _WIDEST_DEG)))
            return Refraction(tangent * (per_right * cos(turn) + per_down * sin(turn)), 0.0, 0.0)

        if per_right or per_down:
            setup.aberrations[self.name] = aberration


def tilt_dpt(scene: Scene) -> tuple[float, float]:
    """Return the change of M to the right and down, dioptres per unit of tan theta; positive: myopic there."""
    eye = scene.sim.eye
    per_slope_dpt = 1e6 / (eye.focal_length_um * (_HUMAN_INDEX if eye.shown_by == "human eye" else 1.0))
    right, down = (
        per_slope_dpt * (tan(radians(tilt_deg)) + decentred_um / _RETINA_RADIUS_UM)
        for tilt_deg, decentred_um in zip(eye.retina_tilt_deg, eye.retina_decentred_um, strict=True)
    )
    return right, down


class TearFilm:
    """Break-up of the tear film: a share of the light is scattered by small angles; OPTICS.md 3.10.

    The share grows linearly with the time from the break-up; the rest of the light is not disturbed.
    """

    name = "tear_film"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the scattered share; 0 before the break-up."""
        share = scattered_share(scene)
        if share == 0:
            return Size(0.0, "the tear film is whole")
        why = f"{share:.2%} of the light is scattered by {scene.sim.eye.tear_film_deg:g} deg"
        return Size(_TEAR_FILM_ETA_PER_SHARE_DEG * share * scene.sim.eye.tear_film_deg * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Blur the scattered share of the object, which then reaches beyond the field's edge; its sum is kept."""
        share = np.float32(scattered_share(setup.scene))
        if share == 0:
            return
        sigma_px = setup.scene.sim.eye.tear_film_deg * setup.scene.geometry.px_per_deg
        clear = np.pad(setup.object, ceil(4 * sigma_px))
        scattered = ndimage.gaussian_filter(clear, sigma_px, mode="constant")
        setup.object = (1 - share) * clear + share * scattered


def scattered_share(scene: Scene) -> float:
    """Return the share of the light that the tear film scatters, 0 to 0.9."""
    eye = scene.sim.eye
    return min(eye.tear_film_per_s * max(eye.since_blink_s - eye.breakup_s, 0.0), _MAX_SCATTERED)


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
