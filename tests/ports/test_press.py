"""Press on the real drivers over emulated buses gives the picture of the simulated head."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import libcamera
import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.calibration.signing import create_key_pair, export
from device.clock import SystemClock, VirtualClock
from device.config.head_file import BusSpec, CalibrationTable, ChainSpec, InstrumentSpec, LightSpec, load_head
from device.errors import BusFault, HeadMismatch, PowerLow, TooHot
from device.head import Head, head_memory, open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.recon.assessment.metrics import PictureScorer
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import decide
from device.sim.world import World
from device.values import Calibration, ExposureSettings, HeadIdentity, Illumination, Image, Psf
from device.values import Sensor as CountsOf
from services.cli import main
from services.workshop.calibration_archive import activate
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.wires import emulated_buses

EXPOSURE_S = 0.1
HEADS = Path(__file__).parents[2] / "hardware" / "heads"
QUIET = partial(decide, without=("shot",))


def head_with_real_drivers(**bus: object) -> InstrumentSpec:
    """Return the small simulated head's optics and object behind picamera2, spidev and smbus2."""
    spec = small_head()
    camera = spec.camera.model_copy(update={"backend": "picamera2", "sensor": "imx296", "exposure_s": EXPOSURE_S})
    light = LightSpec(backend="apa102", chain=ChainSpec())
    table = BusSpec(backend="smbus", thermometer=0x48, battery=0x36, memory=0x50, **bus)
    return spec.model_copy(update={"camera": camera, "light": light, "bus": table})


@pytest.fixture
def head() -> Iterator[Head]:
    emulated_buses().set_faults("memory.blank")
    attach_sensor()
    opened = reopened_head()
    emulated_buses().set_faults()
    yield opened
    emulated_buses().set_faults()
    opened.close()


def reopened_head(calibration: CalibrationTable | None = None) -> Head:
    spec = head_with_real_drivers().model_copy(update={"calibration": calibration})
    return open_head(spec, SystemClock(), MemoryLedger(SystemClock()), MemoryAllocator())


def attach_sensor() -> None:
    """Attach a new emulated sensor without shot noise, which differs between frames."""
    libcamera.plugged.append(Sensor(World(small_head(), SystemClock(), choose=QUIET), emulated_buses()))


def picture(head: Head) -> Image:
    """Return the picture of a press without its page: lit frame, dark frame, reconstruction."""
    with head.light.on(Illumination("green")):
        lit = head.camera.expose(ExposureSettings(EXPOSURE_S))
    assert lit.illumination == Illumination("green")
    assert lit.simulated
    dark = head.camera.expose(ExposureSettings(EXPOSURE_S))
    make = Reconstructor(head.calibration, head.camera.shape, Planner(None, effort="FFTW_ESTIMATE"), SystemClock())
    return make(lit.counts, dark.counts).picture


def test_a_press_on_real_drivers_gives_the_picture_of_the_simulated_head(head, record_property):
    world = World(small_head(), VirtualClock(), choose=QUIET)
    simulated = replace(head, camera=SimCamera(world), light=SimLight(world))
    expected, found = picture(simulated), picture(head)
    inside = expected > 0
    pcc = PictureScorer(expected, inside, 16.0)(found).pcc
    record_property("pcc", f"{pcc:.5f}")
    assert pcc >= 0.999  # an exposure of whole rows is slightly shorter
    assert head.kind == "simulated"


def test_a_preview_lights_the_ring_in_red_and_turns_it_off_afterwards(head):
    head.camera.prepare(ExposureSettings(0.05))
    for _ in range(5):
        with head.light.on(Illumination("red", 0.5)):
            assert {tuple(levels) for levels in emulated_buses().lit.values()} == {(128, 0, 0)}
            mean = np.mean(head.camera.expose(ExposureSettings(0.05)).counts)
            was_lit_throughout = bool(emulated_buses().lit)
        assert not emulated_buses().lit
        if was_lit_throughout:  # on a busy computer the guard may end a light before its frame
            break
    assert was_lit_throughout
    assert mean > 70


def test_a_hot_head_or_a_low_battery_takes_no_picture(head):
    head.check()
    for changed, error in (({"warmest_c": 20.0}, TooHot), ({"emptiest": 0.9}, PowerLow)):
        limits = head.spec.bus.model_copy(update=changed)
        with pytest.raises(error):
            replace(head, spec=head.spec.model_copy(update={"bus": limits})).check()


def test_the_memory_of_another_head_is_refused_and_all_parts_are_closed(head):
    head.chips.memory.write(HeadIdentity("DS-0001", head.calibration.id))
    head.close()
    attach_sensor()
    same = reopened_head()
    same.chips.memory.write(HeadIdentity("DS-0002", "another"))
    same.close()
    with pytest.raises(HeadMismatch, match="DS-0002"):
        reopened_head()
    assert not libcamera.plugged[-1].held
    assert not emulated_buses().lit


def test_a_head_whose_memory_lacks_its_calibration_refuses_until_it_is_written(head, tmp_path):
    """Over the real smbus2: memory blank, written, outdated after a power cut, and written again."""
    archive = Archive(tmp_path / "archive")
    provenance = Provenance("DS-0042", SystemClock().wall(), "a technician", "0.1.0")
    first = archive.add_and_activate(head.calibration, provenance)
    calibrated = head_with_real_drivers().model_copy(update={"calibration": CalibrationTable(archive=archive.root)})
    head.close()

    def started() -> str:
        attach_sensor()
        opened = open_head(calibrated, SystemClock(), MemoryLedger(SystemClock()), MemoryAllocator())
        opened.close()
        return opened.calibration.id

    def write_memory(id: str) -> None:
        with head_memory(calibrated, SystemClock()) as memory:
            activate(archive, archive.load(id), memory)

    emulated_buses().set_faults("memory.blank")
    with pytest.raises(HeadMismatch, match="knows none"):
        started()
    emulated_buses().set_faults()
    write_memory(first)
    assert started() == first
    newer = archive.add_and_activate(
        replace(head.calibration, field_deg=30.0), provenance
    )  # simulated power cut before the memory is written
    with pytest.raises(HeadMismatch, match=f"DS-0042 was calibrated as {first}, loaded is {newer}") as mismatch:
        started()
    assert f"calibrations use {newer}" in mismatch.value.remedy
    write_memory(newer)
    assert started() == newer
    write_memory(first)
    assert started() == first


def test_a_signed_file_of_another_head_is_refused_by_the_identity_in_memory(tmp_path, capsys):
    """The command line over the real smbus2: refused for DS-0001, imported and activated for DS-0042."""
    spec = load_head(HEADS / "imx296.toml")
    psf = Psf(np.ones((spec.camera.rows, spec.camera.cols), np.float32))
    provenance = Provenance("DS-0042", SystemClock().wall(), "a technician", "0.1.0")
    sender, there, sent = Archive(tmp_path / "sender"), Archive(tmp_path / "there"), tmp_path / "sent"
    id = sender.add(Calibration((psf,), CountsOf(60.0)), provenance)
    create_key_pair(tmp_path / "key", "Service centre")
    export(sender.files(id), sent, tmp_path / "key")
    arguments = ["calibrations", "import", sent, "--archive", there.root, "--trust", tmp_path / "key.pub", "--use"]

    def imported() -> int:
        with pytest.raises(SystemExit) as ended:
            main([*map(str, arguments), "--head", str(HEADS / "imx296.toml")])
        return ended.value.code or 0

    emulated_buses().set_faults()
    with head_memory(spec, SystemClock()) as memory:
        memory.write(HeadIdentity("DS-0001", "0" * 16))
    assert imported() == 2
    assert f"this head is DS-0001, and {id} was measured on DS-0042" in capsys.readouterr().err
    assert not there.root.exists()
    with head_memory(spec, SystemClock()) as memory:
        memory.write(HeadIdentity("DS-0042", "0" * 16))
    assert imported() == 0
    assert f"{id} is in force in {there.root}, and head DS-0042 knows it" in capsys.readouterr().out
    with head_memory(spec, SystemClock()) as memory:
        assert memory.read() == HeadIdentity("DS-0042", id)


def test_a_calibration_of_another_serial_number_is_refused(head, tmp_path):
    archive = Archive(tmp_path)
    id = archive.add_and_activate(
        head.calibration, Provenance("DS-0001", SystemClock().wall(), "a technician", "0.1.0")
    )
    head.chips.memory.write(HeadIdentity("DS-0002", id))
    head.close()
    attach_sensor()
    with pytest.raises(HeadMismatch, match="DS-0002"):
        reopened_head(CalibrationTable(archive=tmp_path))


def test_a_silent_bus_stops_the_head_from_opening(head):
    head.close()
    emulated_buses().set_faults("i2c.silent")
    with pytest.raises(BusFault):
        reopened_head()
