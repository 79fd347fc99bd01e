"""`diffuscope calibrate`: whoever stands at the bench, a technician or the simulator, and a procedure between them."""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import version
from math import degrees
from pathlib import Path

from device.calibration.archive import Archive, Kept
from device.calibration.procedure import FILLED, Job, Operator, Procedure, Stand
from device.clock import Clock
from device.errors import SettingError
from device.head import Bench, open_bench
from device.sim import stage
from device.sim.mishaps import mend, spoil
from device.sim.world import World
from device.spec import InstrumentSpec
from device.values import Identity

ASKED: dict[Stand, str] = {
    "cap": "Put the cap on the head and shade it.",
    "screen": "Take the cap off and put the even screen before the head, switched on.",
    "point": "Put the point source before the head, on its axis, and switch the screen off.",
}


@dataclass(frozen=True)
class Wish:
    """What the command line says; None: what the head knows itself."""

    archive: Path
    serial: str | None
    made_by: str
    source_deg: float | None = None
    mishaps: Mapping[str, str] = field(default_factory=dict)  # of a simulated head: what goes wrong at which stand


def calibrate(
    spec: InstrumentSpec, wish: Wish, clock: Clock, ask: Callable[[str], None], tell: Callable[[str], None]
) -> Kept:
    """Measure a head and put the calibration in force; steps that were done before an error are taken up again.

    `ask` says to a person what to put before the head, and returns when it is there.
    """
    with closing(open_bench(spec, clock)) as bench:
        world = bench.world
        job = Job(spec, serial_of(bench, wish), wish.made_by, version("diffuscope"), source_of(spec, wish))
        if wish.mishaps and world is None:
            raise SettingError("nothing goes wrong on purpose on a real head", "Leave out --mishap.")
        put = (lambda stand: ask(ASKED[stand])) if world is None else with_mishaps(world, wish.mishaps)
        operator = Operator(put, tell)
        work = wish.archive / ".steps"
        procedure = Procedure(job, bench.camera, operator, clock, work, bench.chips.thermometer)
        archive = Archive(wish.archive)
        kept = archive.load(procedure.run(archive))
        note_in_head(bench, kept)
        return kept


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
            case "point":
                world.stage = stage.point(world, e_per_s)

    return put


def serial_of(bench: Bench, wish: Wish) -> str:
    """What the wish, the head's memory or the simulator says, in this order; SettingError if nobody knows."""
    if wish.serial is not None:
        return wish.serial
    known = bench.chips.memory.read() if bench.chips.memory is not None else None
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
