"""The head's memory and the archive name the same calibration, or the instrument refuses and says what to do."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.calibration.procedure import Operator
from device.errors import BusFault, HeadMismatch, MemoryDamaged, SettingError
from device.guard import GuardedLight
from device.head import Bench, Chips, Head, hazard_of, refuse_another_head
from device.ledger import MemoryLedger
from device.sim.camera import SimCamera
from device.sim.chips import SimHeadMemory
from device.sim.light import SimLight
from device.sim.world import World
from device.spec import BusSpec, CalibrationTable
from device.values import Identity
from services.instrument.calibrating import Wish, calibrate_on, staging
from services.instrument.calibrations import put_in_force
from tests.unit.test_archive import WHO, calibration
from tests.unit.test_measure import FLAWS, small_world


class TornMemory(SimHeadMemory):
    """One whose first reading finds what a power cut has torn."""

    torn = True

    def read(self) -> Identity | None:
        if self.torn:
            raise MemoryDamaged("the head's memory is damaged: its checksum does not fit")
        return super().read()

    def write(self, identity: Identity) -> None:
        self.torn = False
        super().write(identity)


@pytest.fixture(scope="module")
def world() -> World:
    return small_world(coarser=8, **FLAWS)


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(tmp_path / "archive")


def started(world: World, archive: Archive, bus: BusSpec | None = None) -> Head:
    """The simulated head as `open_head` opens it, with a world and so a memory that outlive it."""
    spec = world.spec.model_copy(update={"calibration": CalibrationTable(archive=archive.root), "bus": bus})
    lamp = GuardedLight(SimLight(world), world.clock, 1.0, hazard_of(spec), MemoryLedger(world.clock))
    head = Head(spec, SimCamera(world), lamp, archive.load().calibration, Chips(memory=SimHeadMemory(world)))
    refuse_another_head(head)
    return head


def test_a_calibrated_head_knows_itself_and_one_that_was_not_told_is_noticed(world, archive):
    world.identity = None
    bench = Bench(SimCamera(world), Chips(memory=SimHeadMemory(world)), world, ExitStack())
    wish, said = Wish(archive.root, "DS-0042", "a technician", None), []
    kept = calibrate_on(bench, world.spec, wish, world.clock, Operator(staging(world), said.append))
    assert SimHeadMemory(world).read() == Identity("DS-0042", kept.calibration.id)
    assert started(world, archive).calibration.id == kept.calibration.id

    with pytest.raises(SettingError, match="no serial number"):
        calibrate_on(
            bench, world.spec, replace(wish, serial="x" * 65), world.clock, Operator(lambda _: None, said.append)
        )
    world.faults = {"bus.silent"}
    with pytest.raises(BusFault):  # now, not after minutes of work
        calibrate_on(bench, world.spec, wish, world.clock, Operator(lambda _: None, said.append))
    world.faults = set()

    newer = archive.keep(calibration(65.0), replace(WHO, serial="DS-0042"))  # and here the power goes away
    with pytest.raises(HeadMismatch, match=kept.calibration.id) as told:
        started(world, archive)
    assert f"diffuscope calibrations use {newer} --archive DIR --head HEAD" in told.value.remedy
    put_in_force(archive, archive.load(newer), SimHeadMemory(world))
    assert started(world, archive).calibration.id == newer


def test_a_head_whose_memory_is_blank_is_not_believed_to_be_the_one_that_was_measured(world, archive):
    world.identity = None
    id = archive.keep(calibration(), WHO)
    with pytest.raises(HeadMismatch, match="knows none"):
        started(world, archive)
    put_in_force(archive, archive.load(id), SimHeadMemory(world))
    assert world.identity == Identity(WHO.serial, id)
    started(world, archive)


def test_the_calibration_of_another_head_is_refused_and_nothing_changes(world, archive):
    mine = archive.keep(calibration(), WHO)
    other = archive.add(calibration(65.0), replace(WHO, serial="DS-0043"))
    world.identity = Identity(WHO.serial, mine)
    with pytest.raises(HeadMismatch, match=r"this head is DS-0042, and .* was measured on DS-0043"):
        put_in_force(archive, archive.load(other), SimHeadMemory(world))
    assert archive.current() == mine
    assert world.identity == Identity(WHO.serial, mine)


def test_a_psf_from_others_leaves_the_head_its_name(world, archive):
    world.identity = Identity("DS-0001", "0" * 16)
    id = archive.add(calibration(), replace(WHO, serial="unknown", origin="imported"))
    put_in_force(archive, archive.load(id), SimHeadMemory(world))
    assert world.identity == Identity("DS-0001", id)


def test_a_memory_that_a_power_cut_has_torn_is_written_anew(world, archive):
    id, memory = archive.add(calibration(), WHO), TornMemory(world)
    put_in_force(archive, archive.load(id), memory)
    assert memory.read() == Identity(WHO.serial, id)


def test_a_silent_memory_changes_nothing(world, archive):
    first = archive.keep(calibration(), WHO)
    second = archive.add(calibration(65.0), WHO)
    world.faults = {"bus.silent"}
    with pytest.raises(BusFault):
        put_in_force(archive, archive.load(second), SimHeadMemory(world))
    world.faults = set()
    assert archive.current() == first


def test_a_simulated_memory_that_ended_with_its_process_stops_nobody(world, archive):
    world.identity = None
    archive.keep(calibration(), WHO)
    bus = BusSpec(backend="sim", memory=0x50)
    head = started(world, archive, bus=bus)
    assert head.chips.memory.read() is None
