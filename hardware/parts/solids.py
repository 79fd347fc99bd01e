"""A CAD part as a mesh of another library, manifold3d: what pictures are cut from, and what tests measure."""

import numpy as np
from build123d import Part
from manifold3d import CrossSection, Manifold, Mesh

FINE_MM, FINE_RAD = 0.01, 0.1
__all__ = ["CrossSection", "Manifold", "solid"]


def solid(part: Part) -> Manifold:
    """The part, tessellated to a hundredth of a mm; ValueError if its surface is not closed."""
    points, corners = part.tessellate(FINE_MM, FINE_RAD)
    places = np.array([tuple(point) for point in points], np.float32)
    whole = Mesh(vert_properties=places, tri_verts=np.array(corners, np.uint32))
    whole.merge()
    made = Manifold(whole)
    if made.is_empty():
        raise ValueError(f"the surface is not closed: {made.status()}")
    return made
