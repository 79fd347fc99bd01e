"""Which LEDs of a matrix make a ring: geometry alone, never indices by heart."""

from math import hypot

from device.errors import SpecError
from device.spec import ChainSpec, InstrumentSpec

LEAST_LEDS = 4  # fewer do not light a field from all around


def places_mm(chain: ChainSpec) -> list[tuple[float, float]]:
    """(right, up) of every LED from the light path's axis, LED side facing you; index 0 is at the bottom left."""
    row, col = chain.axis if chain.axis is not None else ((chain.rows - 1) / 2, (chain.cols - 1) / 2)
    pitch = chain.pitch_mm
    return [((i % chain.cols - col) * pitch, (i // chain.cols - row) * pitch) for i in range(chain.rows * chain.cols)]


def ring(chain: ChainSpec) -> tuple[int, ...]:
    """The LEDs whose distance from the axis is that of the ring, within its tolerance, or those that the head names.

    Raises SpecError where none is. The LuMini's only clean ring near 9.5 mm is that of 10.04 mm, with eight LEDs.
    """
    if chain.leds is not None:
        return chain.leds
    radius, slack = chain.ring_mm / 2, chain.tolerance_mm / 2
    found = tuple(i for i, place in enumerate(places_mm(chain)) if abs(hypot(*place) - radius) <= slack)
    if not found:
        near = min(places_mm(chain), key=lambda place: abs(hypot(*place) - radius))
        raise SpecError(
            f"light.chain.ring_mm = {chain.ring_mm:g}: no LED lies on that ring; the nearest one is "
            f"{2 * hypot(*near):.2f} mm wide"
        )
    if len(found) > chain.most_lit:
        raise SpecError(f"light.chain: {len(found)} LEDs lie on that ring, more than most_lit = {chain.most_lit}")
    return found


def ring_at_pupil_mm(chain: ChainSpec, magnification: float) -> float:
    """How wide the ring is where the relay images it into the eye's pupil (optics.md 1.4)."""
    return 2 * max(_radii_mm(chain)) * magnification


def inner_ring_at_pupil_mm(chain: ChainSpec, magnification: float) -> float:
    """The same for those of its LEDs that are nearest to the axis: what the cornea's reflex is judged by."""
    return 2 * min(_radii_mm(chain)) * magnification


def _radii_mm(chain: ChainSpec) -> list[float]:
    places = places_mm(chain)
    return [hypot(*places[i]) for i in ring(chain)]


def for_pupil(chain: ChainSpec, pupil_mm: float, magnification: float) -> ChainSpec:
    """The same matrix with the widest ring of at least four LEDs whose image fits into a pupil of that diameter.

    The wider the ring, the farther its reflex is from the picture (optics.md 3.6). Raises SpecError where none fits.
    """
    distances = sorted({round(hypot(*place), 3) for place in places_mm(chain)}, reverse=True)
    for radius_mm in distances:
        found = chain.model_copy(update={"ring_mm": 2 * radius_mm, "leds": None, "trims": None})
        if radius_mm > 0 and len(ring(found)) >= LEAST_LEDS and ring_at_pupil_mm(found, magnification) <= pupil_mm:
            return found
    raise SpecError(
        f"light.pupil_mm = {pupil_mm:g}: no ring of at least {LEAST_LEDS} LEDs of this matrix fits into that pupil"
    )


def chain_of(spec: InstrumentSpec) -> ChainSpec | None:
    """The ring that the head file describes, or that fits the pupil which it names; None without one."""
    chain, light = spec.light.chain, spec.light
    if chain is None or light.pupil_mm is None or spec.optics is None:
        return chain
    return for_pupil(chain, light.pupil_mm, spec.optics.angular_magnification)
