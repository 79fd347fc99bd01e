"""A press on real drivers gives the picture of the simulated head: the world is the same, the way to it is not."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import libcamera
import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.clock import SystemClock, VirtualClock
from device.errors import BusFault, HeadMismatch, PowerLow, TooHot
from device.head import Head, open_head
from device.ledger import MemoryLedger
from device.recon.metrics import Judge
from device.recon.plan import Planner
from device.recon.reconstructor import Reconstructor
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import decide
from device.sim.world import World
from device.spec import BusSpec, CalibrationTable, ChainSpec, InstrumentSpec, LightSpec
from device.values import Glow, Identity, Image, Shot
from tests.ports.conftest import small_head
from tests.ports.emulators.memory import MemoryAllocator
from tests.ports.emulators.sensor import Sensor
from tests.ports.emulators.wires import wires

EXPOSURE_S = 0.1
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
