"""`diffuscope calibrate`: whoever stands at the bench, a technician or the simulator, and a procedure between them."""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import version
from math import degrees
from pathlib import Path

from device.calibration.archive import Archive, Kept
from device.calibration.leds import led_readings, unknown
from device.calibration.procedure import FILLED, MOVES, TINTED, Job, Operator, Procedure, Stand
from device.clock import Clock
from device.errors import MemoryDamaged, SettingError
from device.head import Bench, open_bench
from device.sim import stage
from device.sim.mishaps import mend, spoil
from device.sim.world import World
from device.spec import InstrumentSpec
from device.values import Colour, Identity

WORK = ".steps"  # in the archive: what was measured of a calibration that is not whole yet
EYE_MM = 25.0  # the paper's model eye
LONGEST_SERIAL = 64  # of characters: what a head's memory keeps
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
    source_deg: float | None = None
    eye_mm: float | None = None
    dioptres: bool = False
    colours: tuple[Colour, ...] = ()
    keep_raw: bool = False
    leds: Path | None = None
    mishaps: Mapping[str, str] = field(default_factory=dict)  # of a simulated head: what goes wrong at which stand


def calibrate(
    spec: InstrumentSpec, wish: Wish, clock: Clock, ask: Callable[[str], None], tell: Callable[[str], None]
) -> Kept:
    """Measure a head and put the calibration in force; steps that were done before an error are taken up again.

    `ask` says to a person what to put before the head, and returns when it is there.
    """
    with closing(open_bench(spec, clock)) as bench:
        if wish.mishaps and bench.world is None:
            raise SettingError("nothing goes wrong on purpose on a real head", "Leave out --mishap.")
        put = (lambda stand: ask(ASKED[stand])) if bench.world is None else with_mishaps(bench.world, wish.mishaps)
        return calibrate_on(bench, spec, wish, clock, Operator(put, tell))


def calibrate_on(bench: Bench, spec: InstrumentSpec, wish: Wish, clock: Clock, operator: Operator) -> Kept:
    """The same with a head that is open already; its memory learns last whose calibration it is.

    A power cut before that leaves a head that refuses to start, and says how its memory is written.
    """
    job, work = job_of(bench, spec, wish, operator.tell), wish.archive / WORK
    procedure = Procedure(job, bench.camera, operator, clock, work, bench.chips.thermometer)
    archive = Archive(wish.archive)
    kept = archive.load(procedure.run(archive))
    note_in_head(bench, kept)
    return kept


def job_of(bench: Bench, spec: InstrumentSpec, wish: Wish, tell: Callable[[str], None]) -> Job:
    """What is to be measured of whom; what nobody measured about its LEDs is said."""
    leds = led_readings(wish.leds, spec) if wish.leds is not None else None
    for line in unknown(leds, spec) if leds is not None else ():
        tell(line)
    who = serial_of(bench, wish), wish.made_by, version("diffuscope")
    return Job(spec, *who, source_of(spec, wish), _eye_mm(spec, wish), wish.dioptres, wish.colours, wish.keep_raw, leds)


def note_in_head(bench: Bench, kept: Kept) -> None:
    """The head's memory, where it has one, says from now on who it is and which calibration is its own."""
    if bench.chips.memory is not None:
        bench.chips.memory.write(Identity(kept.provenance.serial, kept.calibration.id))


def with_mishaps(world: World, mishaps: Mapping[str, str]) -> Callable[[Stand], None]:
    """Puts things before a simulated head, and lets go wrong what the wish names for that stand."""
    put = staging(world)
    if strange := set(mishaps) - set(ASKED):
        raise SettingError(f"no step wants {sorted(strange)[0]!r}", f"Choose from {', '.join(ASKED)}.")

    def put_and_spoil(stand: Stand) -> None:
        mend(world)
        put(stand)
        if stand in mishaps:
            spoil(world, mishaps[stand])

    return put_and_spoil


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


def serial_of(bench: Bench, wish: Wish) -> str:
    """What the wish, the head's memory or the simulator says, in this order; SettingError if nobody knows.

    A memory that does not answer is an error now, not after all the work.
    """
    try:
        known = bench.chips.memory.read() if bench.chips.memory is not None else None
    except MemoryDamaged:
        if wish.serial is None:
            raise
        known = None  # torn by a power cut, and about to be written anew
    if wish.serial is not None:
        if not 0 < len(wish.serial) <= LONGEST_SERIAL or not wish.serial.isprintable():
            raise SettingError(f"{wish.serial!r} is no serial number", "Give one short line with --serial.")
        return wish.serial
    if known is not None:
        return known.serial
    if bench.world is not None:
        return "simulated"
    raise SettingError("this head does not say who it is", "Give its serial number with --serial.")


def source_of(spec: InstrumentSpec, wish: Wish) -> float:
    """How wide the point source is as the head sees it, degrees; 0 where nobody says."""
    if wish.source_deg is not None or spec.sim is None:
        return wish.source_deg or 0.0
    return degrees(spec.sim.calibration.source_um / spec.sim.eye.focal_length_um)


def _eye_mm(spec: InstrumentSpec, wish: Wish) -> float:
    if wish.eye_mm is not None or spec.sim is None:
        return wish.eye_mm or EYE_MM
    return spec.sim.eye.focal_length_um / 1000
