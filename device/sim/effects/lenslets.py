"""Effects of lenslets at the iris: their curved image surface, how they were made, and their shift since then."""

from math import radians, tan

from device.sim.optical_setup import OpticalSetup, Scene, Size

_PRESENT = 1.0  # eta behind lenses is not measured, and no effect of lenses is small enough to be skipped


class LensCurvature:
    """Field curvature and oblique astigmatism of each lens: a thin plate lens with its stop at the lens; OPTICS.md 2.9.

    Sagittal and tangential power grow with the tangent of the angle at the iris.
    """

    name = "lens_curvature"

    def size(self, scene: Scene) -> Size:
        """Return the size eta: 0 for a diffuser, else 1 (not measured)."""
        if scene.optics.element.kind != "lenslets":
            return _no_lenses()
        if scene.optics.element.flat_field:
            return Size(0.0, "the lenses have a flat field")
        sagittal, tangential = edge_dpt(scene)
        why = f"at the edge the lenses are {sagittal:.0f} and {tangential:.0f} dpt too strong; eta not measured"
        return Size(_PRESENT, why)

    def apply(self, setup: OpticalSetup) -> None:
        """Compute the PSF of each place in the field with the lenses' power there."""
        if setup.optics.element.kind == "lenslets":
            setup.lenses = setup.lenses._replace(curved=not setup.optics.element.flat_field)


def edge_dpt(scene: Scene) -> tuple[float, float]:
    """Return the excess power of a lens at the field's edge, sagittal and tangential, dioptres at the eye."""
    optics = scene.optics
    squared = tan(radians(optics.angular_magnification * scene.half_field_deg)) ** 2 / 2
    eye_dpt = 1e6 / (optics.element.lenses[0][2] * optics.angular_magnification**2)
    inverse = 1 / optics.element.index
    return squared * (1 + inverse) * eye_dpt, squared * (3 + inverse) * eye_dpt


class LensFlaws:
    """Flaws of lenses as made: spread of the focal lengths, wavefront error, errors of the centres; OPTICS.md 2.9."""

    name = "lens_flaws"

    def size(self, scene: Scene) -> Size:
        """Return the size eta: 0 for a diffuser and perfect lenses, else 1 (not measured)."""
        flaws = scene.sim.element
        if scene.optics.element.kind != "lenslets":
            return _no_lenses()
        if not (flaws.focal_spread or flaws.surface_waves or flaws.centre_um):
            return Size(0.0, "the lenses are as drawn")
        return Size(
            _PRESENT,
            f"focal lengths +- {flaws.focal_spread:.1%}, {flaws.surface_waves:g} waves rms, centres "
            f"+- {flaws.centre_um:g} um; eta not measured",
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Make the lenses of frames and calibration with these flaws, drawn from the scene's seed."""
        made = setup.scene.sim.element.model_copy(update=setup.lenses.flaws.since)
        setup.lenses = setup.lenses._replace(flaws=made)


class LensShift:
    """Change of the lenses since the calibration: the plate has crept, or dust fell onto it; OPTICS.md 2.9."""

    name = "lens_shift"

    def size(self, scene: Scene) -> Size:
        """Return the size eta: 0 for a diffuser and lenses in their places, else 1 (not measured)."""
        flaws = scene.sim.element
        if scene.optics.element.kind != "lenslets":
            return _no_lenses()
        if not (flaws.moved_um or flaws.dust_grains):
            return Size(0.0, "the lenses stand as at the calibration")
        return Size(
            _PRESENT,
            f"centres moved by {flaws.moved_um:g} um along each axis, {flaws.dust_grains} grains; eta not measured",
        )

    def apply(self, setup: OpticalSetup) -> None:
        """Move and cover the lenses of frames, not those of the calibration."""
        since = setup.scene.sim.element.since
        setup.lenses = setup.lenses._replace(flaws=setup.lenses.flaws.model_copy(update=since))


def _no_lenses() -> Size:
    return Size(0.0, "the element is a diffuser")
