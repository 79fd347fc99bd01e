"""Tests of a whole calibration on the simulated head: order of the steps, faults, and checkpoints after each fault."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.calibration.procedure.calibration_sequence import (
    CalibrationJob,
    CalibrationSequence,
    CalibrationTarget,
    Operator,
)
from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import (
    CalibrationMissing,
    CalibrationModeMismatch,
    CalibrationRefused,
    CameraStalled,
    HeadMismatch,
    SpecError,
)
from device.head import Head, HeadOpener, is_simulated, open_head, target_placer
from device.light_safety.dose_ledger import MemoryLedger
from device.sim import calibration_targets
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Calibration, Illumination, Psf, Sensor
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate
from tests import scenes
from tests.bench.calibration import pictures, true_calibration
from tests.unit.test_calibration_measurements import FLAWS, small_world

HEADS = Path(__file__).parents[2] / "hardware" / "heads"


class CalibrationBench:
    """Simulated head on a bench: records the requested targets, and can spoil one of them."""

    def __init__(self, root: Path, world: World) -> None:
        self.world, self.archive, self.work = world, Archive(root / "archive"), root / "work"
        self.requested: list[CalibrationTarget] = []
        self.messages: list[str] = []
        self.wrong: dict[CalibrationTarget, Callable[[World], None]] = {}

    def put(self, stand: CalibrationTarget) -> None:
        self.requested.append(stand)
        target_placer(self.world)(stand)
        if stand in self.wrong:
            self.wrong[stand](self.world)

    def run(self, serial: str = "D-1") -> str:
        return self.calibrate(CalibrationJob(self.world.spec, serial, "a technician", "0.1.0"))

    def calibrate(self, job: CalibrationJob) -> str:
        self.requested.clear()
        operator = Operator(self.put, self.messages.append)
        return CalibrationSequence(job, SimCamera(self.world), operator, self.world.clock, self.work).run(self.archive)


@pytest.fixture
def bench(tmp_path: Path) -> CalibrationBench:
    return CalibrationBench(tmp_path, small_world(**FLAWS))


@pytest.fixture
def small_bench(tmp_path: Path) -> CalibrationBench:
    """Return the flawed simulated head with a quarter of the pixels, for fault tests."""
    return CalibrationBench(tmp_path, small_world(coarser=8, **FLAWS))


def finger(world: World) -> None:
    world.target = calibration_targets.screen(world, 160_000)
    world.target[100:, 200:260] *= np.float32(0.7)


def lamp(world: World) -> None:
    world.illumination = Illumination("green")


def stand_of(kind: str) -> Callable[[World], None]:
    return lambda world: target_placer(world)(kind)  # type: ignore[arg-type]


def power_cut(world: World) -> None:
    raise KeyboardInterrupt


def stalled(world: World) -> None:
    world.faults.add("camera.stalled")


def dim(world: World) -> None:
    world.target = calibration_targets.point(world, 100.0)


def blinding(world: World) -> None:
    world.target = calibration_targets.point(world, 1e10)


def test_a_whole_calibration_is_activated_with_its_figures(bench: CalibrationBench) -> None:
    kept = bench.archive.load(bench.run())
    world, found, camera = bench.world, kept.calibration, bench.world.spec.camera
    assert bench.requested == ["cap", "screen", "point"]
    assert found.simulated
    assert found.sensor.gain_e_per_dn == pytest.approx(camera.gain_e_per_dn, rel=0.01)
    assert found.sensor.read_noise_e == pytest.approx(camera.read_noise_e, rel=0.05)
    assert found.sensor.black_dn == pytest.approx(camera.black_dn, abs=0.2)
    assert found.sensor.bend_per_dn * (camera.white_dn - camera.black_dn) == pytest.approx(-0.01, rel=0.05)
    assert found.geometry == world.geometry
    assert kept.provenance.serial == "D-1"
    assert dict(kept.provenance.figures)["dark_e_per_s"] == pytest.approx(50, rel=0.02)
    assert not list(bench.work.glob("*.npz"))


def test_the_measured_calibration_costs_no_picture_quality(bench: CalibrationBench) -> None:
    measured = bench.archive.load(bench.run()).calibration
    world = bench.world
    world.target = None
    by_measured, by_truth = pictures(world, measured, true_calibration(world), scenes.PLANNER)
    assert by_truth > 15
    assert by_measured > by_truth - 0.2  # required limit


@pytest.mark.parametrize(
    ("stand", "fault", "error", "again"),
    [
        ("cap", lamp, CalibrationRefused, ["cap", "screen", "point"]),
        ("cap", stand_of("screen"), CalibrationRefused, ["cap", "screen", "point"]),
        ("cap", stalled, CameraStalled, ["cap", "screen", "point"]),
        ("cap", power_cut, KeyboardInterrupt, ["cap", "screen", "point"]),
        ("screen", stand_of("cap"), CalibrationRefused, ["screen", "point"]),
        ("screen", stand_of("point"), CalibrationRefused, ["screen", "point"]),
        ("screen", finger, CalibrationRefused, ["screen", "point"]),
        ("screen", lamp, CalibrationRefused, ["screen", "point"]),
        ("screen", power_cut, KeyboardInterrupt, ["screen", "point"]),
        ("point", stand_of("cap"), CalibrationRefused, ["point"]),
        ("point", stand_of("screen"), CalibrationRefused, ["point"]),
        ("point", dim, CalibrationRefused, ["point"]),
        ("point", blinding, CalibrationRefused, ["point"]),
        ("point", lamp, CalibrationRefused, ["point"]),
        ("point", stalled, CameraStalled, ["point"]),
        ("point", power_cut, KeyboardInterrupt, ["point"]),
    ],
)
def test_a_fault_keeps_earlier_checkpoints_and_the_active_calibration(
    small_bench: CalibrationBench,
    stand: CalibrationTarget,
    fault: Callable[[World], None],
    error: type[BaseException],
    again: list[CalibrationTarget],
) -> None:
    old = small_bench.run()
    small_bench.wrong[stand] = fault
    with pytest.raises(error):
        small_bench.run()
    assert small_bench.archive.active_id() == old
    small_bench.wrong.clear()
    small_bench.world.faults.clear()
    small_bench.world.illumination = None
    new = small_bench.run()
    assert small_bench.requested == again
    assert small_bench.archive.active_id() == new != old  # noise differs between runs


class PowerCutArchive(Archive):
    """Archive that simulates a power cut when a calibration is stored."""

    def add_and_activate(self, calibration: Calibration, provenance: Provenance) -> str:
        raise KeyboardInterrupt


def test_a_power_cut_before_the_archive_write_loses_no_step_and_keeps_the_simulated_flag(
    small_bench: CalibrationBench,
) -> None:
    archive, small_bench.archive = small_bench.archive, PowerCutArchive(small_bench.archive.root)
    with pytest.raises(KeyboardInterrupt):
        small_bench.run()
    small_bench.archive = archive
    id = small_bench.run()
    assert small_bench.requested == []
    assert archive.load(id).calibration.simulated
    assert not small_bench.work.exists()


def test_foreign_expired_or_damaged_checkpoints_are_measured_again(small_bench: CalibrationBench) -> None:
    small_bench.wrong["point"] = power_cut

    def requested(serial: str = "D-1") -> list[CalibrationTarget]:
        with pytest.raises(KeyboardInterrupt):
            small_bench.run(serial)
        return small_bench.requested

    assert requested() == ["cap", "screen", "point"]
    assert requested() == ["point"]
    assert requested("D-2") == ["cap", "screen", "point"]
    path = small_bench.work / "darks.npz"
    path.write_bytes(path.read_bytes()[:-100])
    assert requested("D-2") == ["cap", "point"]
    small_bench.world.clock.sleep(13 * 3600)
    assert requested("D-2") == ["cap", "screen", "point"]


def test_calibrate_accepts_a_simulated_head_and_refuses_a_recorded_one(tmp_path: Path) -> None:
    messages: list[str] = []
    spec = small_world().spec
    kept = calibrate(
        spec, CalibrationRequest(tmp_path, None, "me", None), VirtualClock(), messages.append, messages.append
    )
    assert kept.provenance.serial == "simulated"
    assert messages[:2] == ["darks: done", "flats: done"]
    recorded = replayed(spec)
    with pytest.raises(SpecError):
        calibrate(
            recorded,
            CalibrationRequest(tmp_path / "b", None, "me", None),
            VirtualClock(),
            messages.append,
            messages.append,
        )
    with pytest.raises(CalibrationMissing):
        Archive(tmp_path / "b").active_id()


def test_a_source_that_is_stated_out_of_focus_is_refused_before_any_step(
    small_bench: CalibrationBench,
) -> None:
    job = CalibrationJob(small_bench.world.spec, "D-1", "a technician", "0.1.0", source_mm=25.5)
    with pytest.raises(CalibrationRefused, match=r"an eye of -0.78 dpt \(at most 0.25\)"):
        small_bench.calibrate(job)
    assert small_bench.requested == []


def replayed(spec: InstrumentSpec) -> InstrumentSpec:
    return spec.model_copy(update={"camera": spec.camera.model_copy(update={"backend": "replay"})})


# A head file that names an archive


def opened(spec: InstrumentSpec) -> Head:
    clock = VirtualClock()
    return open_head(spec, clock, MemoryLedger(clock))


def head_file(folder: Path, camera: str) -> InstrumentSpec:
    """Return a head whose file names the archive beside it."""
    text = (HEADS / camera).read_text(encoding="utf-8").replace("rows = 1080", "rows = 135")
    text = text.replace("cols = 1920", "cols = 240").replace("pitch_um = 5.04", "pitch_um = 40.32")
    path = folder / "head.toml"
    path.write_text(text + '\n[calibration]\narchive = "archive"\n', encoding="utf-8")
    return load_head(path)


def test_a_head_opens_with_the_active_calibration(small_bench: CalibrationBench, tmp_path: Path) -> None:
    spec = head_file(tmp_path, "sim.toml")
    with pytest.raises(CalibrationMissing):
        opened(spec)
    id = small_bench.run()
    head = opened(spec)
    assert head.calibration.id == id
    assert head.kind == "simulated"


def test_a_real_head_refuses_a_simulated_calibration(small_bench: CalibrationBench, tmp_path: Path) -> None:
    spec = head_file(tmp_path, "imx296.toml").model_copy(update={"sim": None})
    assert not is_simulated(spec)
    archive = small_bench.archive
    made = archive.load(small_bench.run())
    with HeadOpener(spec, VirtualClock()) as opening:
        with pytest.raises(CalibrationModeMismatch, match="pixels"):
            opening.calibration()
        psf = Psf(np.ones((spec.camera.rows, spec.camera.cols), np.float32))
        archive.add_and_activate(Calibration((psf,), Sensor(), simulated=True), made.provenance)
        with pytest.raises(HeadMismatch, match="simulated"):
            opening.calibration()
        id = archive.add_and_activate(Calibration((psf,), Sensor(black_dn=60.0)), made.provenance)
        assert opening.calibration().id == id
