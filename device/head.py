"""Factory of heads: opens camera, guarded light, chips and calibration that a head file names, without any fallback."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

from device.calibration.archive import Archive, Provenance, StoredCalibration
from device.calibration.calibration_validity import refuse_expired, refuse_other_mode
from device.calibration.led_radiometry import with_led_radiometry
from device.calibration.procedure.calibration_sequence import (
    AXIAL_OFFSETS_MM,
    COLOUR_TARGETS,
    TARGET_FILL_SHARE,
    CalibrationTarget,
)
from device.clock import Clock
from device.config.head_file import ChainSpec, InstrumentSpec, ReplaySpec, load_head
from device.config.operating_limits import is_battery_low, is_too_hot
from device.drivers.button import GpioButton
from device.drivers.chips import Eeprom24, I2cBus, Max17048, Tmp117
from device.drivers.gpio import InputLine, OutputLine
from device.drivers.guardian import Guardian
from device.drivers.heartbeat import Heartbeat
from device.drivers.no_light import NoLight
from device.drivers.pi_camera import PiCamera
from device.drivers.probe import ProbeFinding, probe_parts
from device.drivers.ring import Apa102Ring, LedRing, Tlc5971Ring
from device.drivers.v4l2_camera import V4l2Camera
from device.errors import HeadMismatch, PowerLow, SettingError, SpecError, TooHot
from device.light_safety.dose_ledger import Ledger, MemoryLedger
from device.light_safety.guard import GuardedLight
from device.light_safety.hazard import NO_LIGHT, Hazard, light_limits, radiometry
from device.optics.matrix import chain_of, lamps_of
from device.optics.trial_lens import TrialLens
from device.ports import NO_CHIPS, Button, Camera, Chips, HeadMemory, Light
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.sim import calibration_targets, fault_injection
from device.sim.camera import SimCamera
from device.sim.chips import SimBattery, SimButton, SimHeadMemory, SimThermometer
from device.sim.light import MirroredLight, SimLight
from device.sim.replay import ReplayCamera, ReplayLight, find_recording, recorded_calibration, recorded_head
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Eye

LEASE_MARGIN_S = 0.05  # so that the guard's timer ends first; the guardian process acts only if the timer fails


def no_repositioning(eye: Eye, field: str | None = None) -> None:
    """Do nothing: `present_eye` of a head without simulated camera, which the operator positions by hand."""


@dataclass(frozen=True)
class Head:
    """Opened head: specification, camera, guarded light, chips and calibration.

    `provenance` describes the origin of an archived calibration; None without an archive. `present_eye` is called with
    the next eye while the lamp is dark; a simulated head then shows that eye. `place_trial_lens` puts a trial lens
    before it, at a distance from its pupil in mm, and `place_white_card` a white card in place of the eye; None with a
    real camera, whose operator does.
    """

    spec: InstrumentSpec
    camera: Camera
    light: GuardedLight
    calibration: Calibration
    chips: Chips = NO_CHIPS
    button: Button | None = None
    resources: ExitStack = field(default_factory=ExitStack)  # closes the opened parts in reverse order
    provenance: Provenance | None = None
    present_eye: Callable[[Eye, str | None], None] = no_repositioning
    place_trial_lens: Callable[[TrialLens, float], None] | None = None
    place_white_card: Callable[[], None] | None = None

    @property
    def kind(self) -> str:
        """`simulated`, `recording` or `real`; the page shows it with every picture."""
        return kind_of(self.spec)

    def check(self) -> None:
        """Raise TooHot or PowerLow beyond the limits of the head file, BusFault if a chip does not answer."""
        bus = self.spec.bus
        if bus is None:
            return
        thermometer = self.chips.thermometer
        battery = self.chips.battery
        if thermometer is not None and is_too_hot(warm_c := thermometer.read_c(), bus.warmest_c):
            raise TooHot(f"the head is {warm_c:.0f} C warm, more than {bus.warmest_c:.0f}")
        if battery is not None and is_battery_low((charge := battery.read()).fraction, bus.emptiest):
            raise PowerLow(f"the battery is at {charge.fraction:.0%}, {charge.volts:.2f} V")

    def close(self) -> None:
        """Turn the lamp off, then close all parts."""
        try:
            self.light.off()
        finally:
            self.resources.close()


def kind_of(spec: InstrumentSpec) -> str:
    """Return `recording` for a replayed head, `simulated` if any part or the calibration is simulated, else `real`."""
    if spec.camera.backend == "replay":
        return "recording"
    return "simulated" if is_simulated(spec) else "real"


def is_simulated(spec: InstrumentSpec) -> bool:
    """Return true if any backend is "sim" or the table [sim] exists; then the whole head counts as simulated."""
    backends = {spec.camera.backend, spec.light.backend, *(part.backend for part in (spec.bus, spec.gpio) if part)}
    return "sim" in backends or spec.sim is not None


def refuse_unsuitable_calibration(kept: StoredCalibration, spec: InstrumentSpec) -> None:
    """Raise an error if a calibration cannot be used by this head.

    CalibrationModeMismatch for another sensor mode. HeadMismatch for a simulated calibration on a real head, for an
    imported PSF without `imported = true`, and for one without black or white level.
    """
    found = kept.calibration
    provenance = kept.provenance
    refuse_other_mode(found, provenance, spec.camera)
    if found.simulated and not is_simulated(spec):
        raise HeadMismatch(f"{found.id}, of {provenance.serial}, was measured on a simulated head")
    if provenance.origin == "imported" and not (spec.calibration and spec.calibration.imported):
        raise HeadMismatch(
            f"{found.id} is a PSF from {provenance.source}, not measured on this head",
            "Calibrate the head. To try this PSF all the same, write `imported = true` under [calibration].",
        )
    if missing := {"black_dn", "white_dn"} & set(provenance.unknown):
        raise HeadMismatch(
            f"{found.id} does not say {' and '.join(sorted(missing))}, without which no head can use it",
            "Import the PSF again with --black-dn and --white-dn.",
        )


def open_head(spec: InstrumentSpec, clock: Clock, ledger: Ledger, allocator: Any = None) -> Head:
    """Return the opened head; a part that the head file names and that is missing is an error, never replaced.

    `ledger` stores the light dose; a MemoryLedger is for lights that reach no eye. `allocator` gives the camera driver
    its buffers (None: the library's own). HeadMismatch if the head's memory contradicts the calibration. After an error
    all opened parts are dark and closed.
    """
    spec = with_calibrated_light(spec)
    if spec.light.backend == "none":
        raise SpecError(
            f"{spec.name} has no lamp, so it takes no pictures of eyes",
            "Take frames in the light that is there: diffuscope frame --head HEAD -o raw.tiff (hardware/bench.md).",
        )
    if spec.camera.bayer:
        raise SpecError(
            f"{spec.name} has a sensor with colour filters: its counts are not grey, and no picture of an eye",
            "Fit the monochrome version and write bayer = false. For frames only: diffuscope frame --head HEAD -o "
            "raw.tiff, then diffuscope reconstruct with --bayer.",
        )
    if (spec.camera.backend == "replay") != (spec.light.backend == "replay"):
        raise SpecError(f"a {spec.camera.backend} camera cannot see a {spec.light.backend} lamp")
    with HeadOpener(spec, clock, allocator) as opening:
        head = _replayed(opening, ledger) if spec.camera.backend == "replay" else _opened(opening, ledger)
        refuse_mismatched_head(head)
        return replace(head, resources=opening.resources.pop_all())


def with_calibrated_light(spec: InstrumentSpec) -> InstrumentSpec:
    """Return the head with the LED readings of its calibration; unchanged without an archive or readings."""
    if spec.calibration is None:
        return spec
    kept = Archive(spec.calibration.archive).load()
    return with_led_radiometry(spec, dict(kept.provenance.figures), f"calibration {kept.calibration.id}")


def refuse_without_lamp(spec: InstrumentSpec) -> None:
    """Raise SpecError for a head without a lamp of its own."""
    if spec.light.backend in ("none", "replay"):
        raise SpecError(f"{spec.name} has no lamp of its own", "Give the file of a head with LEDs.")


@contextmanager
def open_light(spec: InstrumentSpec, clock: Clock, ledger: Ledger) -> Iterator[GuardedLight]:
    """Open the guarded lamp of a head alone, without camera and calibration; it is dark and closed on exit.

    With heartbeat and guardian process as in `open_head`, and limits by the radiometry of `spec`. SpecError for a head
    without a lamp of its own, LightFault.
    """
    refuse_without_lamp(spec)
    with HeadOpener(spec, clock) as opening:
        light = opening.light(ledger)
        try:
            yield light
        finally:
            light.off()


class HeadOpener:
    """Opens the parts of a head one by one; on exit of its context the opened parts are closed in reverse order."""

    def __init__(self, spec: InstrumentSpec, clock: Clock, allocator: Any = None) -> None:
        self.spec = spec
        self.clock = clock
        self.resources = ExitStack()
        self._allocator = allocator

    def __enter__(self) -> "HeadOpener":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.resources.close()

    @cached_property
    def world(self) -> World:
        """Simulated world that the simulated parts share; SpecError without the table [sim]."""
        if self.spec.sim is None:
            raise SpecError(
                f"{self.spec.name} has no calibration: without its PSF no picture can be made",
                "Calibrate the head and name the archive in the table [calibration], or add the table [sim] to try its "
                "parts with a simulated calibration.",
            )
        return World(self.spec, self.clock)

    def calibration(self) -> Calibration:
        """Return the calibration of the head file's archive, else a simulated one; SpecError without either table."""
        return (
            self.archived_calibration.calibration
            if self.archived_calibration is not None
            else simulated_calibration(self.world)
        )

    @cached_property
    def archived_calibration(self) -> StoredCalibration | None:
        """Active calibration of the archive, checked against the head file and the validity period.

        None without an archive.
        """
        if self.spec.calibration is None:
            return None
        kept = Archive(self.spec.calibration.archive).load()
        refuse_unsuitable_calibration(kept, self.spec)
        refuse_expired(kept.provenance, self.clock.wall())
        return kept

    def light(self, ledger: Ledger, chain: ChainSpec | None = None) -> GuardedLight:
        """Return the guarded lamp, with limits by the head's radiometry and its dose in `ledger`; there is no other.

        A real lamp lights the LEDs of `chain`, if given, instead of the head file's: some of the ring, no others.
        """
        return GuardedLight(self._lamp(chain), self.clock, self.spec.light.max_on_s, hazard_of(self.spec), ledger)

    def _lamp(self, chain: ChainSpec | None) -> Light:
        """Return the lamp that the guard gets."""
        if self.spec.light.backend == "sim":
            return SimLight(self.world)
        if self.spec.light.backend == "none":
            return NoLight()
        ring = self._ring(chain)
        self.resources.callback(ring.close)
        return MirroredLight(ring, self.world) if self.spec.camera.backend == "sim" else ring

    def _ring(self, chain: ChainSpec | None) -> LedRing:
        """Return the driver of the head's ring with its guardian."""
        lease_s = self.spec.light.max_on_s + LEASE_MARGIN_S
        sinks = self.spec.light.sinks
        if self.spec.light.backend == "tlc5971":
            assert sinks is not None
            guardian = Guardian(sinks.device, chip="tlc5971")
            self.resources.callback(guardian.close)
            return Tlc5971Ring(sinks, guardian, lease_s, self._pulse())
        chain = chain or chain_of(self.spec)
        assert chain is not None
        guardian = Guardian(chain.device, chain.rows * chain.cols)
        self.resources.callback(guardian.close)
        return Apa102Ring(chain, guardian, lease_s, self._pulse())

    def _pulse(self) -> Heartbeat | None:
        """Return the opened heartbeat of the lamp's hardware watchdog; None without one, or with simulated GPIO."""
        gpio = self.spec.gpio
        if gpio is None or gpio.heartbeat is None or gpio.backend == "sim":
            return None
        pulse = Heartbeat(OutputLine(gpio.chip, gpio.heartbeat))
        self.resources.callback(pulse.close)
        return pulse

    def button(self) -> Button | None:
        """Return the shutter button; None if the head file names none."""
        gpio = self.spec.gpio
        if gpio is None or gpio.button is None:
            return None
        if gpio.backend == "sim":
            return SimButton(self.world)
        button = GpioButton(InputLine(gpio.chip, gpio.button), self.clock)
        self.resources.callback(button.close)
        return button

    def camera(self, light: Light) -> Camera:
        """Return the camera, which marks its frames with the state of `light`; SpecError for a recording."""
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
        self.resources.callback(camera.close)
        return camera

    def chips(self) -> Chips:
        """Return the chips that the table [bus] names, real or simulated; none without the table."""
        bus = self.spec.bus
        if bus is None:
            return NO_CHIPS
        if bus.backend == "sim":
            return Chips(
                SimThermometer(self.world) if bus.thermometer is not None else None,
                SimBattery(self.world) if bus.battery is not None else None,
                SimHeadMemory(self.world) if bus.memory is not None else None,
            )
        i2c = I2cBus(bus.device)
        self.resources.callback(i2c.close)
        return Chips(
            Tmp117(i2c, bus.thermometer) if bus.thermometer is not None else None,
            Max17048(i2c, bus.battery) if bus.battery is not None else None,
            Eeprom24(i2c, bus.memory, self.clock) if bus.memory is not None else None,
        )


@dataclass(frozen=True)
class Bench:
    """Parts of a head for a calibration: camera, with the lamp dark, and chips; `world` is None with a real camera."""

    camera: Camera
    chips: Chips
    world: World | None
    resources: ExitStack

    @property
    def is_simulated(self) -> bool:
        """True if the camera is simulated, so that targets are placed and faults injected by this object."""
        return self.world is not None

    def place_target(self, stand: CalibrationTarget) -> None:
        """Place the calibration target of a step in front of a simulated head and clear its faults.

        No-op for a real head.
        """
        if self.world is not None:
            fault_injection.clear_faults(self.world)
            target_placer(self.world)(stand)

    def inject_fault(self, name: str) -> None:
        """Inject one of `fault_names` into a simulated bench; SettingError for a real head or an unknown name."""
        if self.world is None:
            raise SettingError("faults are injected into simulated heads only", "Leave it out.")
        fault_injection.inject_fault(self.world, name)

    def close(self) -> None:
        """Close all parts."""
        self.resources.close()


def trial_lens_placer(world: World) -> Callable[[TrialLens, float], None]:
    """Return a function that puts a trial lens before the eye of a simulated head, in place of the lens before."""
    bare = world.eyes

    def place(lens: TrialLens, vertex_mm: float) -> None:
        world.eyes = bare.behind_lens(lens, vertex_mm)
        world.present_eye(world.eye)

    return place


def white_card_placer(world: World) -> Callable[[], None]:
    """Return a function that puts a white card in place of the eye of a simulated head."""

    def place() -> None:
        world.eyes = world.eyes.behind_card()

    return place


def target_placer(world: World) -> Callable[[CalibrationTarget], None]:
    """Return a function that places calibration targets before a simulated head, as bright as one exposure needs."""
    e_per_s = TARGET_FILL_SHARE * world.spec.camera.full_well_e / world.spec.camera.exposure_s

    def place(stand: CalibrationTarget) -> None:
        match stand:
            case "cap":
                world.target = calibration_targets.cap(world)
            case "screen":
                world.target = calibration_targets.screen(world, e_per_s)
            case _:
                colour = next((colour for colour, name in COLOUR_TARGETS.items() if name == stand), None)
                world.target = calibration_targets.point(
                    world, e_per_s, moved_mm=AXIAL_OFFSETS_MM.get(stand, 0.0), colour=colour
                )

    return place


def fault_names() -> tuple[str, ...]:
    """Return the names of the faults that can be injected into a simulated bench, sorted."""
    return tuple(sorted(fault_injection.BENCH_FAULTS))


def refuse_recording(spec: InstrumentSpec) -> None:
    """Raise SpecError for a recording: it cannot be calibrated."""
    if spec.camera.backend == "replay":
        raise SpecError(f"{spec.name} is a recording: it cannot be calibrated", "Give the file of a head with --head.")


def open_bench(spec: InstrumentSpec, clock: Clock, allocator: Any = None) -> Bench:
    """Open camera and chips of a head for a calibration, without loading a stored one; SpecError for a recording."""
    refuse_recording(spec)
    with HeadOpener(spec, clock, allocator) as opening:
        camera = opening.camera(opening.light(MemoryLedger(clock)))
        chips = opening.chips()
        return Bench(
            camera, chips, opening.world if spec.camera.backend == "sim" else None, opening.resources.pop_all()
        )


def probe(spec: InstrumentSpec, clock: Clock, allocator: Any = None, *, leds: bool = True) -> Iterator[ProbeFinding]:
    """Check every part that the head file names, one after the other; light each LED of the ring and detect it.

    The light is guarded, and its dose is not stored: it reaches no eye. Without `leds` the lamp stays dark. A
    HardwareError of a part becomes a finding and is not raised. The lamp is dark at the end.
    """
    yield from probe_parts(spec, lambda: HeadOpener(spec, clock, allocator), clock, MemoryLedger(clock), leds=leds)


@contextmanager
def head_memory(spec: InstrumentSpec, clock: Clock) -> Iterator[HeadMemory | None]:
    """Open the chips of a head, yield its memory (None if the head file names none), and close them on exit."""
    with HeadOpener(spec, clock) as opening:
        yield opening.chips().memory


def _replayed(opening: HeadOpener, ledger: Ledger) -> Head:
    """Return the opened head of a recording: its camera, a lamp without light, and the recorded calibration."""
    spec = opening.spec
    clock = opening.clock
    assert spec.replay is not None
    lamp = ReplayLight()
    camera = ReplayCamera(spec.replay, lamp, clock)
    opening.resources.callback(camera.close)
    light = GuardedLight(lamp, clock, spec.light.max_on_s, hazard_of(spec), ledger)
    recorded = recorded_calibration(camera, spec)
    psfs = tuple(map(without_hot_pixels, recorded.psfs))
    return Head(spec, camera, light, replace(recorded, psfs=psfs))


def _opened(opening: HeadOpener, ledger: Ledger) -> Head:
    """Return an opened real or simulated head with its calibration, guarded light, camera, chips and button."""
    spec = opening.spec
    calibration = opening.calibration()
    facing: Callable[[Eye, str | None], None] = no_repositioning
    lens_placer = card_placer = None
    if spec.camera.backend == "sim":
        facing = opening.world.present_eye
        lens_placer = trial_lens_placer(opening.world)
        card_placer = white_card_placer(opening.world)
        facing("OD", None)  # traces the light now, not while a lamp is on
    light = opening.light(ledger)
    camera = opening.camera(light)
    known = opening.archived_calibration.provenance if opening.archived_calibration is not None else None
    chips = opening.chips()
    button = opening.button()
    return Head(
        spec,
        camera,
        light,
        calibration,
        chips,
        button,
        provenance=known,
        present_eye=facing,
        place_trial_lens=lens_placer,
        place_white_card=card_placer,
    )


def refuse_mismatched_head(head: Head) -> None:
    """Raise HeadMismatch if the head has a memory that names another calibration or head than is loaded, or none."""
    if head.chips.memory is None:
        return
    known = head.chips.memory.read()
    loaded = head.calibration.id
    bus = head.spec.bus
    if known is None and (head.spec.calibration is None or (bus is not None and bus.backend == "sim")):
        return  # never calibrated with a simulated calibration loaded, or a simulated memory, lost with its process
    if known is None or known.calibration_id != loaded:
        content = (
            f"head {known.serial} was calibrated as {known.calibration_id[:16]}" if known else "this head knows none"
        )
        raise HeadMismatch(
            f"{content}, loaded is {loaded}",
            "Do not take pictures; call the technician. If this head was calibrated just now, `diffuscope calibrations "
            f"use {loaded} --archive DIR --head HEAD` tells it; another calibration is put in force the same way.",
        )
    provenance = head.provenance
    if provenance is not None and provenance.origin == "measured" and provenance.serial != known.serial:
        raise HeadMismatch(f"this is head {known.serial}, loaded is the calibration of {provenance.serial}")


def hazard_of(spec: InstrumentSpec) -> Hazard:
    """Return the hazard and limits of a head's light, by measured radiometry, else worst case; no light in a replay."""
    if spec.light.backend in ("replay", "none"):
        return Hazard(NO_LIGHT, light_limits())
    if spec.optics is None:
        return Hazard(radiometry(spec.light.radiometry, lamps=lamps_of(spec)), light_limits())
    optics = spec.optics
    beams = radiometry(
        spec.light.radiometry, optics.field_deg, lamps=lamps_of(spec), magnification=optics.angular_magnification
    )
    return Hazard(beams, light_limits())


def recording_spec(folder: Path, raws: tuple[Path, ...] = (), psfs: tuple[Path, ...] = ()) -> InstrumentSpec:
    """Return the specification of a recording: from `raws` and `psfs`, else `recording.toml`, else by file names."""
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
    """Return the name of a recording: that of its folder, resolved first for `.`."""
    return folder.resolve().name or "recording"


def _beside(replay: ReplaySpec, folder: Path) -> ReplaySpec:
    """Return the recording with its relative paths resolved against `folder`."""
    return ReplaySpec(
        raws=tuple(folder / path for path in replay.raws),
        psfs=tuple(folder / path for path in replay.psfs),
        black_dn=replay.black_dn,
        dark=folder / replay.dark if replay.dark else None,
        flat=folder / replay.flat if replay.flat else None,
    )
