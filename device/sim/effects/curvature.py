"""Field curvature and oblique astigmatism of an eye that looks at a flat surface (optics.md 3.4).

A thin lens with its stop focuses the edge of the field on spheres of radius R_s = f / (1 + 1/n) and
R_t = f / (3 + 1/n); a flat surface lies behind both, so its edge looks short-sighted.
"""

from math import cos, hypot, radians, sin, tan

from device.optics.diffuser import Refraction
from device.sim.render import azimuth_and_angle
from device.sim.setup import Place, Scene, Setup, Size

name = "curvature"

GLASS_N = 1.517
ETA_PER_DPT = 5.0  # of the mean over the field: its edge is blurred most, and shows it most


def curvature_dpt(scene: Scene, angle_deg: float) -> tuple[float, float]:
    """Sagittal and tangential defocus of a flat surface at an angle from the axis: h^2 / (2 R f^2), in dioptres."""
    f_m = scene.sim.eye.focal_length_um * 1e-6
    h_m = f_m * tan(radians(angle_deg))
    sagittal, tangential = ((k + 1 / GLASS_N) / f_m for k in (1, 3))
    return h_m**2 * sagittal / (2 * f_m**2), h_m**2 * tangential / (2 * f_m**2)


def size(scene: Scene) -> Size:
    """Weighed by area: over a disc, the mean of h^2 is half of the edge's."""
    if scene.sim.eye.surface == "curved":
        return Size(0.0, "the surface follows the eye's focus")
    sagittal, tangential = curvature_dpt(scene, scene.half_field_deg)
    mean_dpt = (sagittal + tangential) / 4
    return Size(ETA_PER_DPT * mean_dpt * scene.weight, f"the edge is {sagittal:.1f} and {tangential:.1f} dpt off")


def apply(setup: Setup) -> None:
    """More sphere and a radial cylinder towards the edge."""
    scene = setup.scene

    def there(place: Place) -> Refraction:
        if scene.sim.eye.surface == "curved":
            return Refraction()
        turn, angle_deg = azimuth_and_angle(place)
        sagittal, tangential = curvature_dpt(scene, min(angle_deg, hypot(60, 0)))
        cylinder = (tangential - sagittal) / 2
        return Refraction((sagittal + tangential) / 2, cylinder * cos(2 * turn), cylinder * sin(2 * turn))

    setup.aberrations[name] = there
