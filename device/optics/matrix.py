"""Ring geometry: places of the LEDs of a matrix or a constant-current ring, and the LEDs that a head lights."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot

from device.config.head_file import ChainSpec, InstrumentSpec
from device.errors import SpecError
from device.optics.eye import iris_overlap
from device.optics.illumination import LED, Led, led_at
from device.values import Colour

MIN_LEDS = 4  # fewer do not light a field from all sides
EMITTER_MM = 0.25  # width of the green emitter in an APA102-2020; OPTICS.md 3.5 (an estimate)


@dataclass(frozen=True)
class Lamp:
    """LEDs of one colour of a ring: one LED at full drive, their number, and the width of what shines, mm."""

    led: Led
    count: int
    emitter_mm: float = EMITTER_MM


def led_positions_mm(chain: ChainSpec) -> list[tuple[float, float]]:
    """Return (right, up) of every LED from the light path's axis, mm, seen from the LED side.

    Index 0 is at the bottom left; the index increases along a row, then from row to row upwards.
    """
    row, col = chain.axis if chain.axis is not None else ((chain.rows - 1) / 2, (chain.cols - 1) / 2)
    pitch = chain.pitch_mm
    return [((i % chain.cols - col) * pitch, (i // chain.cols - row) * pitch) for i in range(chain.rows * chain.cols)]


def ring(chain: ChainSpec) -> tuple[int, ...]:
    """Return the indices of the LEDs on a circle of diameter `ring_mm` +- `tolerance_mm`, or `chain.leds` if given.

    SpecError if there is none, or more than `most_lit`. Of the LuMini's rings near 9.5 mm only that of 10.04 mm, with
    eight LEDs, is clearly separate.
    """
    if chain.leds is not None:
        return chain.leds
    radius = chain.ring_mm / 2
    slack = chain.tolerance_mm / 2
    found = tuple(i for i, place in enumerate(led_positions_mm(chain)) if abs(hypot(*place) - radius) <= slack)
    if not found:
        near = min(led_positions_mm(chain), key=lambda place: abs(hypot(*place) - radius))
        raise SpecError(
            f"light.chain.ring_mm = {chain.ring_mm:g}: no LED lies on that ring; the nearest one is "
            f"{2 * hypot(*near):.2f} mm wide"
        )
    if len(found) > chain.most_lit:
        raise SpecError(f"light.chain: {len(found)} LEDs lie on that ring, more than most_lit = {chain.most_lit}")
    return found


def ring_at_pupil_mm(chain: ChainSpec, magnification: float) -> float:
    """Return the outer diameter of the ring's image in the eye's pupil, mm; `magnification` is f1 / f2."""
    return 2 * max(_radii_mm(chain)) * magnification


def inner_ring_at_pupil_mm(chain: ChainSpec, magnification: float) -> float:
    """Return the inner diameter of the ring's image in the eye's pupil, mm, which decides the corneal reflex."""
    return 2 * min(_radii_mm(chain)) * magnification


def _radii_mm(chain: ChainSpec) -> list[float]:
    """Return the distance of each LED of the ring from the axis, mm."""
    places = led_positions_mm(chain)
    return [hypot(*places[i]) for i in ring(chain)]


def ring_for_pupil(chain: ChainSpec, pupil_mm: float, magnification: float) -> ChainSpec:
    """Return the matrix with the widest ring of at least four LEDs whose image fits into a pupil of that diameter.

    The wider the ring, the farther its corneal reflex is from the picture (OPTICS.md 3.6). SpecError if no ring fits,
    or if a ring at least as wide has more than `most_lit` LEDs.
    """
    distances = sorted({round(hypot(*place), 3) for place in led_positions_mm(chain)}, reverse=True)
    for radius_mm in distances:
        found = chain.model_copy(update={"ring_mm": 2 * radius_mm, "leds": None, "trims": None})
        if radius_mm > 0 and len(ring(found)) >= MIN_LEDS and ring_at_pupil_mm(found, magnification) <= pupil_mm:
            return found
    raise SpecError(
        f"light.pupil_mm = {pupil_mm:g}: no ring of at least {MIN_LEDS} LEDs of this matrix fits into that pupil"
    )


def chain_of(spec: InstrumentSpec) -> ChainSpec | None:
    """Return the LED matrix of a head file, with `light.pupil_mm` that of the ring that fits; None without a matrix."""
    chain = spec.light.chain
    light = spec.light
    if chain is None or light.pupil_mm is None or spec.optics is None:
        return chain
    return ring_for_pupil(chain, light.pupil_mm, spec.optics.angular_magnification)


def geometry_of(spec: InstrumentSpec, colour: Colour | None = None) -> ChainSpec | None:
    """Return the places of a head's LEDs as a matrix with its ring; None without LEDs of its own.

    Of a constant-current ring those of `colour`, by default the picture's; SpecError if it has none of that colour.
    """
    sinks = spec.light.sinks
    if sinks is None:
        return chain_of(spec)
    wanted = colour or spec.light.colour
    if wanted not in sinks.colours:
        raise SpecError(f"{spec.name} has no {wanted} LEDs")
    leds = sinks.colours[wanted].places
    return ChainSpec(device=sinks.device, rows=sinks.rows, cols=sinks.cols, pitch_mm=sinks.pitch_mm, leds=leds)


def lamps_of(spec: InstrumentSpec) -> Mapping[Colour, Lamp] | None:
    """Return the LEDs of a head by colour; None without LEDs of its own, such as a simulated or recorded head's."""
    sinks = spec.light.sinks
    if sinks is not None:
        return {
            colour: Lamp(led_at(outputs.wavelength_um, outputs.power_mw), len(outputs.places), outputs.emitter_mm)
            for colour, outputs in sinks.colours.items()
        }
    chain = chain_of(spec)
    return None if chain is None else {colour: Lamp(led, len(ring(chain))) for colour, led in LED.items()}


def share_in_pupil(chain: ChainSpec, magnification: float, emitter_mm: float, pupil_mm: float) -> float:
    """Return the share of the ring's light, 0 to 1, whose image at the eye falls into a centred pupil, diameter mm."""
    radius = magnification * emitter_mm / 2
    passed = [iris_overlap(magnification * at, pupil_mm / 2, min(radius, pupil_mm / 2)) for at in _radii_mm(chain)]
    return sum(passed) / len(passed)
