"""Effects of the instrument's optics: vignetting at the iris, LED bandwidth, ghost, size of the calibration's point."""

from math import cos, radians, sin, tan

from device.optics.eye import beam_walk_mm
from device.sim.optical_setup import Ghost, OpticalSetup, Place, Scene, Size
from device.sim.render import azimuth_and_angle

_VIGNETTING_ETA_PER_MM = 220.0  # of the beam's edge inside the iris's: the caustic of the field's edge loses a side
_BANDWIDTH_ETA_PER_UM = 0.25
_BANDWIDTH_LINES = 3
_GHOST_ETA_PER_SHARE = 130.0
_SOURCE_ETA, _SOURCE_UM, _SOURCE_POWER = 0.89, 275.0, 1.4  # .08, .21, .89 for 50, 100, 275 um


class PupilVignetting:
    """Vignetting at the iris: beam walk at wide angles, and pupils that are small or off the axis; OPTICS.md 1.4, 3.3.

    Beam walk at the diffuser is that of the ray trace of the relay's lenses (OPTICS.md 6.3): 3.3 mm at 25 degrees.
    """

    name = "pupil"

    def size(self, scene: Scene) -> Size:
        """Return the size eta, proportional to the uncovered width of the iris, mm, for light from the field's edge."""
        shift = _beam_shift_mm(scene, scene.half_field_deg)
        margin = _shift_margin_mm(scene)
        why = f"at the edge the beam is {shift:.2f} mm off, and the iris is filled up to {margin:.2f} mm"
        return Size(_VIGNETTING_ETA_PER_MM * max(shift - margin, 0.0) * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Register the function that gives each place's shift (right, down) of the beam from the iris's centre, um."""
        scene = setup.scene
        eye = scene.sim.eye
        m = 1 / scene.optics.angular_magnification

        def beam_shift_um(place: Place) -> tuple[float, float]:
            turn, angle_deg = azimuth_and_angle(place)
            radial_um = 1000 * (beam_walk_mm(angle_deg) if eye.walks else 0.0)
            radial_um += m * eye.axial_um * tan(radians(min(angle_deg, 60)))
            return radial_um * cos(turn) + m * eye.decentred_um, radial_um * sin(turn)

        setup.beams[self.name] = beam_shift_um


def _beam_shift_mm(scene: Scene, angle_deg: float) -> float:
    """Return the largest distance between the centres of beam and iris at this angle, mm."""
    eye = scene.sim.eye
    m = 1 / scene.optics.angular_magnification
    walk = beam_walk_mm(angle_deg) if eye.walks else 0.0
    return walk + m * (eye.decentred_um + abs(eye.axial_um) * tan(radians(angle_deg))) / 1000


def _shift_margin_mm(scene: Scene) -> float:
    """Return the largest shift, mm, at which the beam still fills the iris."""
    return (scene.sim.eye.pupil_um / scene.optics.angular_magnification - scene.optics.iris_um) / 2000


class Bandwidth:
    """Chromatic dispersion over the LED's bandwidth: the PSF is the sum over three wavelengths; OPTICS.md 2.3.

    The diffuser deflects all wavelengths of one LED almost equally: eta is 0.002 for a retina in light 40 nm wide, and
    0.007 for dots in light 30 nm wide.
    """

    name = "bandwidth"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the bandwidth."""
        wide_um = scene.optics.bandwidth_um
        return Size(_BANDWIDTH_ETA_PER_UM * wide_um * scene.weight, f"{1000 * wide_um:.0f} nm wide")

    def apply(self, setup: OpticalSetup) -> None:
        """Compute the PSF from three wavelengths instead of one."""
        setup.lines = _BANDWIDTH_LINES


class SplitterGhost:
    """Ghost of the beam splitter: a second image, from both faces of a wedged plate; OPTICS.md 3.11.

    The PSF has none: the plate was turned or exchanged after its measurement.
    """

    name = "ghost"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to the light of the second image; 0 if it is not displaced."""
        light = scene.sim.light
        away = max(map(abs, light.ghost_deg)) > 0
        why = f"a second image of {light.ghost:.2%}, {light.ghost_deg[0]:g} deg right and {light.ghost_deg[1]:g} down"
        return Size(_GHOST_ETA_PER_SHARE * light.ghost * away * scene.weight, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Set share and displacement of the second image, in whole pixels."""
        light, px_per_deg = setup.scene.sim.light, setup.scene.geometry.px_per_deg
        right_px, down_px = (round(at_deg * px_per_deg) for at_deg in light.ghost_deg)
        if light.ghost:
            setup.calibrated.ghost = Ghost(light.ghost, right_px, down_px)


class SourceSize:
    """Finite size of the calibration's point source: the measured PSF is convolved with a disc; OPTICS.md 2.5, 3.2."""

    name = "source"

    def size(self, scene: Scene) -> Size:
        """Return the effect's size eta, proportional to diameter^1.4 of the source."""
        dot_um = scene.sim.calibration.source_um
        return Size(
            _SOURCE_ETA * (dot_um / _SOURCE_UM) ** _SOURCE_POWER * scene.weight,
            f"a dot of {dot_um:.0f} um stands for the point",
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Set the diameter of the calibration's source, um; objects in a frame are not blurred by it."""
        setup.calibrated.source_um = setup.scene.sim.calibration.source_um
