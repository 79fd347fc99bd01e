"""The one place that chooses: a head file becomes a camera, a guarded light and a calibration. Never a fallback."""

from dataclasses import dataclass
from pathlib import Path

from device.clock import Clock
from device.dose import FIELD_DEG, NO_LIGHT, Hazard, light_limits, radiometry
from device.errors import SpecError
from device.guard import GuardedLight
from device.ledger import Ledger
from device.ports import Camera
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.replay import ReplayCamera, ReplayLight, find_recording, recorded_calibration, recorded_head
from device.sim.world import World
from device.spec import InstrumentSpec, ReplaySpec, load_head
from device.values import Calibration


@dataclass(frozen=True)
class Head:
    """An opened head: what it is, its camera, its guarded light, and what the factory measured about it."""

    spec: InstrumentSpec
    camera: Camera
    light: GuardedLight
    calibration: Calibration

    @property
    def kind(self) -> str:
        """`simulated`, `recording` or `real`: what the page must say about every picture."""
        return {"sim": "simulated", "replay": "recording"}.get(self.spec.camera.backend, "real")

    def close(self) -> None:
        """Be dark, then let the camera go."""
        self.light.off()
        self.camera.close()


def open_head(spec: InstrumentSpec, clock: Clock, ledger: Ledger) -> Head:
    """Open the parts that the head file names; a part that is missing is an error, never replaced by another.

    `ledger` keeps the book of light; only what shows light to no eye may use a MemoryLedger.
    """
    hazard = hazard_of(spec)
    if spec.camera.backend != spec.light.backend:
        raise SpecError(f"a {spec.camera.backend} camera cannot see a {spec.light.backend} lamp")
    if spec.camera.backend == "sim":
        world = World(spec, clock)
        for colour in {spec.light.colour, spec.light.preview_colour}:
            world.electrons_per_s(colour)  # now, not while a lamp is lit
        light = GuardedLight(SimLight(world), clock, spec.light.max_on_s, hazard, ledger)
        return Head(spec, SimCamera(world), light, simulated_calibration(world))
    assert spec.replay is not None
    lamp = ReplayLight()
    camera = ReplayCamera(spec.replay, lamp, clock)
    guarded = GuardedLight(lamp, clock, spec.light.max_on_s, hazard, ledger)
    return Head(spec, camera, guarded, recorded_calibration(camera, spec))


def hazard_of(spec: InstrumentSpec) -> Hazard:
    """What the light of a head does to an eye, by its own measurements or at its worst, and the limits for it."""
    if spec.light.backend == "replay":
        return Hazard(NO_LIGHT, light_limits())
    field_deg = spec.optics.field_deg if spec.optics else FIELD_DEG
    return Hazard(radiometry(spec.light.radiometry, field_deg), light_limits())


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
