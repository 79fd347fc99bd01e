"""`diffuscope calibrate`: whoever stands at the bench, a technician or the simulator, and a procedure between them."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from math import degrees
from pathlib import Path

from device.calibration.archive import Archive, Kept
from device.calibration.leds import led_readings, unknown
from device.calibration.procedure import FILLED, MOVES, TINTED, Job, Operator, Procedure, Stand
from device.clock import Clock
from device.errors import SettingError
from device.head import Bench, open_bench
from device.sim import stage
from device.sim.world import World
from device.spec import InstrumentSpec
from device.values import Colour

EYE_MM = 25.0  # the paper's model eye
ASKED: dict[Stand, str] = {
    "cap": "Put the cap on the head and shade it.",
    "screen": "Take the cap off and put the even screen before the head, switched on.",
    "point": "Put the point source before the head, on its axis, and switch the screen off.",
    **{
        stand: f"Move the point source along the axis to {moved_mm:+g} mm ({way} the lens) of where it was first."
        for stand, moved_mm in MOVES.items()
        for way in ["away from" if moved_mm > 0 else "towards"]
    },
    **{stand: f"Put the point source back where it was first, and let it shine in {c}." for c, stand in TINTED.items()},
}


@dataclass(frozen=True)
class Wish:
    """What the command line says; None: what the head knows itself. What the rest says is in Job."""

    archive: Path
    serial: str | None
    made_by: str
    source_deg: float | None
    eye_mm: float | None = None
    dioptres: bool = False
    colours: tuple[Colour, ...] = ()
    keep_raw: bool = False
    leds: Path | None = None


def calibrate(
    spec: InstrumentSpec, wish: Wish, clock: Clock, ask: Callable[[str], None], tell: Callable[[str], None]
) -> Kept:
    """Measure a head and put the calibration in force; steps that were done before an error are taken up again.

    `ask` says to a person what to put before the head, and returns when it is there.
    """
    leds = led_readings(wish.leds, spec) if wish.leds is not None else None
    for line in unknown(leds, spec) if leds is not None else ():
        tell(line)
    with closing(open_bench(spec, clock)) as bench:
        world = bench.world
        who = _serial(bench, wish), wish.made_by, version("diffuscope")
        source = _source_deg(spec, wish), _eye_mm(spec, wish)
        job = Job(spec, *who, *source, wish.dioptres, wish.colours, wish.keep_raw, leds)
        operator = Operator((lambda stand: ask(ASKED[stand])) if world is None else staging(world), tell)
        work = wish.archive / ".steps"
        procedure = Procedure(job, bench.camera, operator, clock, work, bench.chips.thermometer)
        archive = Archive(wish.archive)
        return archive.load(procedure.run(archive))


def staging(world: World) -> Callable[[Stand], None]:
    """Puts things before a simulated head, as bright as its picture's exposure likes them."""
    e_per_s = FILLED * world.spec.camera.full_well_e / world.spec.camera.exposure_s

    def put(stand: Stand) -> None:
        match stand:
            case "cap":
                world.stage = stage.cap(world)
            case "screen":
                world.stage = stage.screen(world, e_per_s)
            case _:
                colour = next((colour for colour, name in TINTED.items() if name == stand), None)
                world.stage = stage.point(world, e_per_s, moved_mm=MOVES.get(stand, 0.0), colour=colour)

    return put


def _serial(bench: Bench, wish: Wish) -> str:
    if wish.serial is not None:
        return wish.serial
    known = bench.chips.memory.read() if bench.chips.memory is not None else None
    if known is not None:
        return known.serial
    if bench.world is not None:
        return "simulated"
    raise SettingError("this head does not say who it is", "Give its serial number with --serial.")


def _source_deg(spec: InstrumentSpec, wish: Wish) -> float:
    if wish.source_deg is not None or spec.sim is None:
        return wish.source_deg or 0.0
    return degrees(spec.sim.calibration.source_um / spec.sim.eye.focal_length_um)


def _eye_mm(spec: InstrumentSpec, wish: Wish) -> float:
    if wish.eye_mm is not None or spec.sim is None:
        return wish.eye_mm or EYE_MM
    return spec.sim.eye.focal_length_um / 1000
