"""Tests of the head's memory: it and the archive must name the same calibration, else the head refuses to open."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.calibration.procedure.calibration_sequence import Operator
from device.config.head_file import BusSpec, CalibrationTable
from device.errors import BusFault, HeadMismatch, MemoryDamaged, SettingError
from device.head import Bench, Head, hazard_of, refuse_mismatched_head, target_placer
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.ports import Chips
from device.sim.camera import SimCamera
from device.sim.chips import SimHeadMemory
from device.sim.light import SimLight
from device.sim.world import World
from device.values import HeadIdentity
from services.instrument.calibration_request import CalibrationRequest
from services.workshop.calibrate_head import calibrate_on
from services.workshop.calibration_archive import activate
from tests.unit.test_archive import WHO, calibration
from tests.unit.test_calibration_measurements import FLAWS, small_world


class TornMemory(SimHeadMemory):
    """Memory whose first read finds the damage of a power cut."""

    torn = True

    def read(self) -> HeadIdentity | None:
        if self.torn:
            raise MemoryDamaged("the head's memory is damaged: its checksum does not fit")
        return super().read()

    def write(self, identity: HeadIdentity) -> None:
        self.torn = False
        super().write(identity)


@pytest.fixture(scope="module")
def world() -> World:
    return small_world(coarser=8, **FLAWS)


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(tmp_path / "archive")


def started(world: World, archive: Archive, bus: BusSpec | None = None) -> Head:
    """Return the simulated head as `open_head` opens it, with a world (and memory) that outlives it."""
    spec = world.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root), "bus": bus})
    lamp = GuardedLight(SimLight(world), world.clock, 1.0, hazard_of(spec), MemoryLedger(world.clock))
    head = Head(spec, SimCamera(world), lamp, archive.load().calibration, Chips(memory=SimHeadMemory(world)))
    refuse_mismatched_head(head)
    return head


def test_calibration_writes_the_head_memory_and_an_outdated_memory_is_refused(world, archive):
    world.identity = None
    bench = Bench(SimCamera(world), Chips(memory=SimHeadMemory(world)), world, ExitStack())
    request, messages = CalibrationRequest(archive.root, "DS-0042", "a technician", None), []
    kept = calibrate_on(bench, world.spec, request, world.clock, Operator(target_placer(world), messages.append))
    assert SimHeadMemory(world).read() == HeadIdentity("DS-0042", kept.calibration.id)
    assert started(world, archive).calibration.id == kept.calibration.id

    with pytest.raises(SettingError, match="no serial number"):
        calibrate_on(
            bench, world.spec, replace(request, serial="x" * 65), world.clock, Operator(lambda _: None, messages.append)
        )
    world.faults = {"bus.silent"}
    with pytest.raises(BusFault):  # at the start, not after minutes of work
        calibrate_on(bench, world.spec, request, world.clock, Operator(lambda _: None, messages.append))
    world.faults = set()

    newer = archive.add_and_activate(
        calibration(65.0), replace(WHO, serial="DS-0042")
    )  # simulated power cut before the memory is written
    with pytest.raises(HeadMismatch, match=kept.calibration.id) as caught:
        started(world, archive)
    assert f"diffuscope calibrations use {newer} --archive DIR --head HEAD" in caught.value.remedy
    activate(archive, archive.load(newer), SimHeadMemory(world))
    assert started(world, archive).calibration.id == newer


def test_a_blank_memory_is_refused(world, archive):
    world.identity = None
    id = archive.add_and_activate(calibration(), WHO)
    with pytest.raises(HeadMismatch, match="knows none"):
        started(world, archive)
    activate(archive, archive.load(id), SimHeadMemory(world))
    assert world.identity == HeadIdentity(WHO.serial, id)
    started(world, archive)


def test_the_calibration_of_another_head_is_refused_and_nothing_changes(world, archive):
    mine = archive.add_and_activate(calibration(), WHO)
    other = archive.add(calibration(65.0), replace(WHO, serial="DS-0043"))
    world.identity = HeadIdentity(WHO.serial, mine)
    with pytest.raises(HeadMismatch, match=r"this head is DS-0042, and .* was measured on DS-0043"):
        activate(archive, archive.load(other), SimHeadMemory(world))
    assert archive.active_id() == mine
    assert world.identity == HeadIdentity(WHO.serial, mine)


def test_an_imported_psf_keeps_the_serial_number_of_the_head(world, archive):
    world.identity = HeadIdentity("DS-0001", "0" * 16)
    id = archive.add(calibration(), replace(WHO, serial="unknown", origin="imported"))
    activate(archive, archive.load(id), SimHeadMemory(world))
    assert world.identity == HeadIdentity("DS-0001", id)


def test_a_memory_damaged_by_a_power_cut_is_written_again(world, archive):
    id, memory = archive.add(calibration(), WHO), TornMemory(world)
    activate(archive, archive.load(id), memory)
    assert memory.read() == HeadIdentity(WHO.serial, id)


def test_a_silent_memory_changes_nothing(world, archive):
    first = archive.add_and_activate(calibration(), WHO)
    second = archive.add(calibration(65.0), WHO)
    world.faults = {"bus.silent"}
    with pytest.raises(BusFault):
        activate(archive, archive.load(second), SimHeadMemory(world))
    world.faults = set()
    assert archive.active_id() == first


def test_a_blank_simulated_memory_is_accepted(world, archive):
    world.identity = None
    archive.add_and_activate(calibration(), WHO)
    bus = BusSpec(backend="sim", memory=0x50)
    head = started(world, archive, bus=bus)
    assert head.chips.memory.read() is None
