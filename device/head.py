"""The one place that chooses: a head file becomes a camera, a guarded light and a calibration. Never a fallback."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

from device.calibration.admission import refuse_old, refuse_other_mode
from device.calibration.archive import Archive, Kept, Provenance
from device.calibration.leds import with_measured_light
from device.clock import Clock
from device.dose import FIELD_DEG, NO_LIGHT, Hazard, light_limits, radiometry
from device.drivers.button import GpioButton
from device.drivers.chips import Eeprom24, I2cBus, Max17048, Tmp117
from device.drivers.gpio import InputLine, OutputLine
from device.drivers.guardian import Guardian
from device.drivers.heartbeat import Heartbeat
from device.drivers.pi_camera import PiCamera
from device.drivers.ring import Apa102Ring
from device.drivers.v4l2_camera import V4l2Camera
from device.errors import HeadMismatch, PowerLow, SpecError, TooHot
from device.guard import GuardedLight
from device.ledger import Ledger
from device.optics.matrix import chain_of, ring
from device.ports import Battery, Button, Camera, HeadMemory, Light, Thermometer
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.chips import SimBattery, SimButton, SimHeadMemory, SimThermometer
from device.sim.light import Mirrored, SimLight
from device.sim.replay import ReplayCamera, ReplayLight, find_recording, recorded_calibration, recorded_head
from device.sim.world import World
from device.spec import ChainSpec, InstrumentSpec, ReplaySpec, load_head
from device.values import Calibration, Eye

LEASE_MARGIN_S = 0.05  # the guard's own timer comes first; the other process is for when it does not come


def by_hand(eye: Eye) -> None:
    """A real head is held before an eye by a person, whom nobody can move."""


@dataclass(frozen=True)
class Chips:
    """The chips of a head, as far as it has them."""

    thermometer: Thermometer | None = None
    battery: Battery | None = None
    memory: HeadMemory | None = None


@dataclass(frozen=True)
class Head:
    """An opened head: what it is, its camera, its guarded light, its chips, and what the factory measured about it.

    `provenance` is where that comes from; None where nobody measured it. `facing` is told which eye is asked for next,
    while it is dark: whoever stands before a simulated head brings it.
    """

    spec: InstrumentSpec
    camera: Camera
    light: GuardedLight
    calibration: Calibration
    chips: Chips = Chips()
    button: Button | None = None
    held: ExitStack = field(default_factory=ExitStack)  # what ends with it, the last first
    provenance: Provenance | None = None
    facing: Callable[[Eye], None] = by_hand

    @property
    def kind(self) -> str:
        """What the page must say about every picture."""
        return kind_of(self.spec)

    def check(self) -> None:
        """Before every picture: TooHot or PowerLow if the head had better rest, BusFault if it cannot say."""
        said = self.spec.bus
        if said is None:
            return
        if self.chips.thermometer is not None and (warm_c := self.chips.thermometer.read_c()) > said.warmest_c:
            raise TooHot(f"the head is {warm_c:.0f} C warm, more than {said.warmest_c:.0f}")
        if self.chips.battery is not None and (charge := self.chips.battery.read()).fraction < said.emptiest:
            raise PowerLow(f"the battery is at {charge.fraction:.0%}, {charge.volts:.2f} V")

    def close(self) -> None:
        """Be dark, then let every part go."""
        try:
            self.light.off()
        finally:
            self.held.close()


def kind_of(spec: InstrumentSpec) -> str:
    """`simulated`, `recording` or `real`."""
    if spec.camera.backend == "replay":
        return "recording"
    return "simulated" if is_simulated(spec) else "real"


def is_simulated(spec: InstrumentSpec) -> bool:
    """Whether any part of it, or what is known about it, is made up: then all of it counts as simulated."""
    backends = {spec.camera.backend, spec.light.backend, *(part.backend for part in (spec.bus, spec.gpio) if part)}
    return "sim" in backends or spec.sim is not None


def refuse_unfit(kept: Kept, spec: InstrumentSpec) -> None:
    """Refuse what this head cannot have: CalibrationOtherMode; HeadMismatch for a simulated one, or one of others."""
    found, said = kept.calibration, kept.provenance
    refuse_other_mode(found, said, spec.camera)
    if found.simulated and not is_simulated(spec):
        raise HeadMismatch(f"{found.id}, of {said.serial}, was measured on a simulated head")
    if said.origin == "imported" and not (spec.calibration and spec.calibration.imported):
        raise HeadMismatch(
            f"{found.id} is a PSF from {said.source}, not measured on this head",
            "Calibrate the head. To try this PSF all the same, write `imported = true` under [calibration].",
        )
    if missing := {"black_dn", "white_dn"} & set(said.unknown):
        raise HeadMismatch(
            f"{found.id} does not say {' and '.join(sorted(missing))}, without which no head can use it",
            "Import the PSF again with --black-dn and --white-dn.",
        )


def open_head(spec: InstrumentSpec, clock: Clock, ledger: Ledger, allocator: Any = None) -> Head:
    """Open the parts that the head file names; a part that is missing is an error, never replaced by another.

    `ledger` keeps the book of light; only what shows light to no eye may use a MemoryLedger. `allocator` is where a
    camera driver takes its buffers from; None: where its library does. Whatever was opened before an error is dark and
    closed after it.
    """
    if spec.calibration is not None:
        kept = Archive(spec.calibration.archive).load()
        spec = with_measured_light(spec, dict(kept.provenance.figures), f"calibration {kept.calibration.id}")
    if (spec.camera.backend == "replay") != (spec.light.backend == "replay"):
        raise SpecError(f"a {spec.camera.backend} camera cannot see a {spec.light.backend} lamp")
    with Opening(spec, clock, allocator) as opening:
        head = _replayed(opening, ledger) if spec.camera.backend == "replay" else _opened(opening, ledger)
        refuse_another_head(head)
        return replace(head, held=opening.undo.pop_all())


class Opening:
    """A head that is being opened part by part; inside its context, and what was opened is closed at the end of it."""

    def __init__(self, spec: InstrumentSpec, clock: Clock, allocator: Any = None) -> None:
        self.spec, self.clock, self.undo = spec, clock, ExitStack()
        self._allocator = allocator

    def __enter__(self) -> "Opening":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undo.close()

    @cached_property
    def world(self) -> World:
        """What simulated parts share, and what a calibration that is not measured yet is taken from."""
        if self.spec.sim is None:
            raise SpecError(
                f"{self.spec.name} has no calibration: without its PSF no picture can be made",
                "Calibrate the head and name the archive in the table [calibration], or add the table [sim] to try its "
                "parts with a simulated calibration.",
            )
        return World(self.spec, self.clock)

    def calibration(self) -> Calibration:
        """The one in force in the archive that the head file names; without a name that of the simulated world."""
        return self.kept.calibration if self.kept is not None else simulated_calibration(self.world)

    @cached_property
    def kept(self) -> Kept | None:
        """What the archive holds, if it fits the head's file and is not too old; None if the file names no archive."""
        if self.spec.calibration is None:
            return None
        kept = Archive(self.spec.calibration.archive).load()
        refuse_unfit(kept, self.spec)
        refuse_old(kept.provenance, self.clock.wall())
        return kept

    def lamp(self, chain: ChainSpec | None = None) -> Light:
        """The lamp, without its guard; of `chain` instead of the head file's if one is given."""
        if self.spec.light.backend == "sim":
            return SimLight(self.world)
        chain = chain or chain_of(self.spec)
        assert chain is not None
        guardian = Guardian(chain.device, chain.rows * chain.cols)
        self.undo.callback(guardian.close)
        ring = Apa102Ring(chain, guardian, self.spec.light.max_on_s + LEASE_MARGIN_S, self._pulse())
        self.undo.callback(ring.close)
        return Mirrored(ring, self.world) if self.spec.camera.backend == "sim" else ring

    def _pulse(self) -> Heartbeat | None:
        said = self.spec.gpio
        if said is None or said.heartbeat is None or said.backend == "sim":
            return None
        pulse = Heartbeat(OutputLine(said.chip, said.heartbeat))
        self.undo.callback(pulse.close)
        return pulse

    def button(self) -> Button | None:
        """The shutter's button, if the head file names one."""
        said = self.spec.gpio
        if said is None or said.button is None:
            return None
        if said.backend == "sim":
            return SimButton(self.world)
        button = GpioButton(InputLine(said.chip, said.button), self.clock)
        self.undo.callback(button.close)
        return button

    def camera(self, light: Light) -> Camera:
        """The camera; its frames say what `light` shows."""
        camera: Camera
        match self.spec.camera.backend:
            case "sim":
                camera = SimCamera(self.world)
            case "picamera2":
                made_up = is_simulated(self.spec)
                camera = PiCamera(self.spec.camera, light, allocator=self._allocator, simulated=made_up)
            case "v4l2":
                camera = V4l2Camera(self.spec.camera, light, self.clock, simulated=is_simulated(self.spec))
            case "replay":
                raise SpecError("a recording is opened with the folder that it is in")
        self.undo.callback(camera.close)
        return camera

    def chips(self) -> Chips:
        """The chips that the head file names."""
        said = self.spec.bus
        if said is None:
            return Chips()
        if said.backend == "sim":
            return Chips(
                SimThermometer(self.world) if said.thermometer is not None else None,
                SimBattery(self.world) if said.battery is not None else None,
                SimHeadMemory(self.world) if said.memory is not None else None,
            )
        bus = I2cBus(said.device)
        self.undo.callback(bus.close)
        return Chips(
            Tmp117(bus, said.thermometer) if said.thermometer is not None else None,
            Max17048(bus, said.battery) if said.battery is not None else None,
            Eeprom24(bus, said.memory, self.clock) if said.memory is not None else None,
        )


@dataclass(frozen=True)
class Bench:
    """What a calibration needs of a head: its camera, its lamp dark, its chips; `world` is None before a real head."""

    camera: Camera
    chips: Chips
    world: World | None
    held: ExitStack

    def close(self) -> None:
        """Let every part go."""
        self.held.close()


def refuse_recording(spec: InstrumentSpec) -> None:
    """SpecError for a recording, which nobody can put a cap on."""
    if spec.camera.backend == "replay":
        raise SpecError(f"{spec.name} is a recording: it cannot be calibrated", "Give the file of a head with --head.")


def open_bench(spec: InstrumentSpec, clock: Clock, allocator: Any = None) -> Bench:
    """Open a head that has no calibration yet; SpecError for a recording."""
    refuse_recording(spec)
    with Opening(spec, clock, allocator) as opening:
        lamp = opening.lamp()
        lamp.off()
        camera, chips = opening.camera(lamp), opening.chips()
        return Bench(camera, chips, opening.world if spec.camera.backend == "sim" else None, opening.undo.pop_all())


@contextmanager
def head_memory(spec: InstrumentSpec, clock: Clock) -> Iterator[HeadMemory | None]:
    """The memory of a head, and nothing else of it; None if its file names none."""
    with Opening(spec, clock) as opening:
        yield opening.chips().memory


def _replayed(opening: Opening, ledger: Ledger) -> Head:
    spec, clock = opening.spec, opening.clock
    assert spec.replay is not None
    lamp = ReplayLight()
    camera = ReplayCamera(spec.replay, lamp, clock)
    opening.undo.callback(camera.close)
    light = GuardedLight(lamp, clock, spec.light.max_on_s, hazard_of(spec), ledger)
    return Head(spec, camera, light, recorded_calibration(camera, spec))


def _opened(opening: Opening, ledger: Ledger) -> Head:
    spec, calibration = opening.spec, opening.calibration()
    facing: Callable[[Eye], None] = by_hand
    if spec.camera.backend == "sim":
        facing = opening.world.meet
        facing("OD")  # its light is traced now, not while a lamp is lit
    light = GuardedLight(opening.lamp(), opening.clock, spec.light.max_on_s, hazard_of(spec), ledger)
    camera = opening.camera(light)
    known = opening.kept.provenance if opening.kept is not None else None
    chips, button = opening.chips(), opening.button()
    return Head(spec, camera, light, calibration, chips, button, provenance=known, facing=facing)


def refuse_another_head(head: Head) -> None:
    """A head that knows whose it is must be the one that the calibration was measured on."""
    if head.chips.memory is None:
        return
    known, loaded, bus = head.chips.memory.read(), head.calibration.id, head.spec.bus
    if known is None and (head.spec.calibration is None or (bus is not None and bus.backend == "sim")):
        return  # never calibrated, and what is loaded is made up; or a simulated memory, which ends with its process
    if known is None or known.calibration_id != loaded:
        knows = (
            f"head {known.serial} was calibrated as {known.calibration_id[:16]}" if known else "this head knows none"
        )
        raise HeadMismatch(
            f"{knows}, loaded is {loaded}",
            "Do not take pictures; call the technician. If this head was calibrated just now, `diffuscope calibrations "
            f"use {loaded} --archive DIR --head HEAD` tells it; another calibration is put in force the same way.",
        )
    whose = head.provenance
    if whose is not None and whose.origin == "measured" and whose.serial != known.serial:
        raise HeadMismatch(f"this is head {known.serial}, loaded is the calibration of {whose.serial}")


def hazard_of(spec: InstrumentSpec) -> Hazard:
    """What the light of a head does to an eye, by its own measurements or at its worst, and the limits for it."""
    if spec.light.backend == "replay":
        return Hazard(NO_LIGHT, light_limits())
    field_deg = spec.optics.field_deg if spec.optics else FIELD_DEG
    chain = chain_of(spec)
    if chain is None:
        return Hazard(radiometry(spec.light.radiometry, field_deg), light_limits())
    leds = len(ring(chain))
    return Hazard(radiometry(spec.light.radiometry, field_deg, leds=leds), light_limits())


def recording(folder: Path, raws: tuple[Path, ...] = (), psfs: tuple[Path, ...] = ()) -> InstrumentSpec:
    """The head that plays a folder: its `recording.toml` if there is one, else what the file names say."""
    if raws or psfs:
        if not (raws and psfs):
            raise SpecError("a recording needs both its raws and its PSFs", "Give --raw and --psf together.")
        return recorded_head(ReplaySpec(raws=raws, psfs=psfs), _name(folder))
    if not folder.is_dir():
        raise SpecError(f"{folder} is not a folder", "Give the folder that holds a raw frame and its PSF.")
    toml = folder / "recording.toml"
    if not toml.is_file():
        return recorded_head(find_recording(folder), _name(folder))
    spec = load_head(toml)
    if spec.replay is None:
        raise SpecError(f"{toml}: a recording needs the table [replay]")
    return spec.model_copy(update={"replay": _beside(spec.replay, folder)})


def _name(folder: Path) -> str:
    """What to call a recording: its folder, also when that was given as `.`"""
    return folder.resolve().name or "recording"


def _beside(replay: ReplaySpec, folder: Path) -> ReplaySpec:
    """The same recording with its paths taken from the folder of its file."""
    return ReplaySpec(
        raws=tuple(folder / path for path in replay.raws),
        psfs=tuple(folder / path for path in replay.psfs),
        black_dn=replay.black_dn,
        dark=folder / replay.dark if replay.dark else None,
        flat=folder / replay.flat if replay.flat else None,
    )
