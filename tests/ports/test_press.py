"""A press on real drivers gives the picture of the simulated head: the world is the same, the way to it is not."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import libcamera
import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.calibration.signed import export, new_key
from device.clock import SystemClock, VirtualClock
from device.errors import BusFault, HeadMismatch, PowerLow, TooHot
from device.head import Head, head_memory, open_head
from device.ledger import MemoryLedger
from device.recon.metrics import Judge
from device.recon.plan import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import decide
from device.sim.world import World
from device.spec import BusSpec, CalibrationTable, ChainSpec, InstrumentSpec, LightSpec, load_head
from device.values import Calibration, Glow, Identity, Image, Psf, Shot
from device.values import Sensor as CountsOf
from services.cli import main
from services.instrument.calibrations import put_in_force
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.wires import wires

EXPOSURE_S = 0.1
HEADS = Path(__file__).parents[2] / "hardware" / "heads"
QUIET = partial(decide, without=("shot",))


def real_parts(**bus: object) -> InstrumentSpec:
    """The small simulated head's optics and object behind picamera2, spidev and smbus2."""
    spec = small_head()
    camera = spec.camera.model_copy(update={"backend": "picamera2", "sensor": "imx296", "exposure_s": EXPOSURE_S})
    light = LightSpec(backend="apa102", chain=ChainSpec())
    said = BusSpec(backend="smbus", thermometer=0x48, battery=0x36, memory=0x50, **bus)
    return spec.model_copy(update={"camera": camera, "light": light, "bus": said})


@pytest.fixture
def head() -> Iterator[Head]:
    wires().break_("memory.blank")
    plug_in()
    opened = opened_again()
    wires().break_()
    yield opened
    wires().break_()
    opened.close()


def opened_again(calibration: CalibrationTable | None = None) -> Head:
    spec = real_parts().model_copy(update={"calibration": calibration})
    return open_head(spec, SystemClock(), MemoryLedger(SystemClock()), MemoryAllocator())


def plug_in() -> None:
    """A sensor of its own, without the photons' noise, which every frame draws anew."""
    libcamera.plugged.append(Sensor(World(small_head(), SystemClock(), choose=QUIET), wires()))


def picture(head: Head) -> Image:
    """A press without its page: lit, dark, reconstructed."""
    with head.light.on(Glow("green")):
        lit = head.camera.expose(Shot(EXPOSURE_S))
    assert lit.glow == Glow("green")
    assert lit.simulated
    dark = head.camera.expose(Shot(EXPOSURE_S))
    make = Reconstructor(head.calibration, head.camera.shape, Planner(None, effort="FFTW_ESTIMATE"), SystemClock())
    return make(lit.counts, dark.counts).picture


def test_a_press_on_real_drivers_gives_the_picture_of_the_simulated_head(head, record_property):
    world = World(small_head(), VirtualClock(), choose=QUIET)
    simulated = replace(head, camera=SimCamera(world), light=SimLight(world))
    expected, found = picture(simulated), picture(head)
    inside = expected > 0
    pcc = Judge(expected, inside, 16.0)(found).pcc
    record_property("pcc", f"{pcc:.5f}")
    assert pcc >= 0.999  # an exposure of whole rows is a little shorter
    assert head.kind == "simulated"


def test_a_preview_is_lit_in_red_by_the_ring_and_the_eye_is_dark_after_it(head):
    with head.light.on(Glow("red", 0.5)):
        assert {tuple(levels) for levels in wires().lit.values()} == {(128, 0, 0)}
        assert np.mean(head.camera.expose(Shot(0.05)).counts) > 70
    assert not wires().lit


def test_a_head_that_is_too_warm_or_too_empty_takes_no_picture(head):
    head.check()
    for changed, error in (({"warmest_c": 20.0}, TooHot), ({"emptiest": 0.9}, PowerLow)):
        limits = head.spec.bus.model_copy(update=changed)
        with pytest.raises(error):
            replace(head, spec=head.spec.model_copy(update={"bus": limits})).check()


def test_the_memory_of_another_head_is_refused_and_everything_is_closed_again(head):
    head.chips.memory.write(Identity("DS-0001", head.calibration.id))
    head.close()
    plug_in()
    same = opened_again()
    same.chips.memory.write(Identity("DS-0002", "another"))
    same.close()
    with pytest.raises(HeadMismatch, match="DS-0002"):
        opened_again()
    assert not libcamera.plugged[-1].held
    assert not wires().lit


def test_a_head_that_was_not_told_of_its_calibration_refuses_until_it_is(head, tmp_path):
    """Over the real smbus2: blank, told, forgotten by a power cut after the archive, told again."""
    archive = Archive(tmp_path / "archive")
    said = Provenance("DS-0042", SystemClock().wall(), "a technician", "0.1.0")
    first = archive.keep(head.calibration, said)
    calibrated = real_parts().model_copy(update={"calibration": CalibrationTable(archive=archive.root)})
    head.close()

    def started() -> str:
        plug_in()
        opened = open_head(calibrated, SystemClock(), MemoryLedger(SystemClock()), MemoryAllocator())
        opened.close()
        return opened.calibration.id

    def told(id: str) -> None:
        with head_memory(calibrated, SystemClock()) as memory:
            put_in_force(archive, archive.load(id), memory)

    wires().break_("memory.blank")
    with pytest.raises(HeadMismatch, match="knows none"):
        started()
    wires().break_()
    told(first)
    assert started() == first
    newer = archive.keep(replace(head.calibration, field_deg=30.0), said)  # and here the power goes away
    with pytest.raises(HeadMismatch, match=f"DS-0042 was calibrated as {first}, loaded is {newer}") as mismatch:
        started()
    assert f"calibrations use {newer}" in mismatch.value.remedy
    told(newer)
    assert started() == newer
    told(first)
    assert started() == first


def test_a_signed_file_of_another_head_is_refused_by_what_the_memory_says(tmp_path, capsys):
    """The command itself, over the real smbus2: refused for DS-0001, taken in and told for DS-0042."""
    spec = load_head(HEADS / "imx296.toml")
    psf = Psf(np.ones((spec.camera.rows, spec.camera.cols), np.float32))
    said = Provenance("DS-0042", SystemClock().wall(), "a technician", "0.1.0")
    sender, there, sent = Archive(tmp_path / "sender"), Archive(tmp_path / "there"), tmp_path / "sent"
    id = sender.add(Calibration((psf,), CountsOf(60.0)), said)
    new_key(tmp_path / "key", "Service centre")
    export(sender.files(id), sent, tmp_path / "key")
    words = ["calibrations", "import", sent, "--archive", there.root, "--trust", tmp_path / "key.pub", "--use"]

    def imported() -> int:
        with pytest.raises(SystemExit) as ended:
            main([*map(str, words), "--head", str(HEADS / "imx296.toml")])
        return ended.value.code or 0

    wires().break_()
    with head_memory(spec, SystemClock()) as memory:
        memory.write(Identity("DS-0001", "0" * 16))
    assert imported() == 2
    assert f"this head is DS-0001, and {id} was measured on DS-0042" in capsys.readouterr().err
    assert not there.root.exists()
    with head_memory(spec, SystemClock()) as memory:
        memory.write(Identity("DS-0042", "0" * 16))
    assert imported() == 0
    assert f"{id} is in force in {there.root}, and head DS-0042 knows it" in capsys.readouterr().out
    with head_memory(spec, SystemClock()) as memory:
        assert memory.read() == Identity("DS-0042", id)


def test_the_calibration_of_another_serial_number_is_refused(head, tmp_path):
    archive = Archive(tmp_path)
    id = archive.keep(head.calibration, Provenance("DS-0001", SystemClock().wall(), "a technician", "0.1.0"))
    head.chips.memory.write(Identity("DS-0002", id))
    head.close()
    plug_in()
    with pytest.raises(HeadMismatch, match="DS-0002"):
        opened_again(CalibrationTable(archive=tmp_path))


def test_a_silent_bus_stops_the_head_from_opening(head):
    head.close()
    wires().break_("i2c.silent")
    with pytest.raises(BusFault):
        opened_again()
