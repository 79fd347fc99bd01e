"""Launcher of `diffuscope` over emulated buses: `python -m tests.ports.emulators.launch run --head FILE`.

It takes the words of the command line. Camera, ring and chips of the head file are those of the real drivers; an
emulated sensor exposes the eye of its table [sim]. The bytes on the buses are printed in plain words.
"""

import argparse
import sys
from importlib.metadata import version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "pi"))  # modules that exist only on Raspberry Pi OS

from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.sim.world import World
from services.cli import main as diffuscope
from services.research.named_files import head_file
from tests.ports.emulators.bus_words import BusPrinter, write
from tests.ports.emulators.wires import EmulatedBuses, emulated_buses


def attach_sensor(spec: InstrumentSpec, buses: EmulatedBuses) -> None:
    """Attach an emulated sensor that the emulated ring lights, and give picamera2 buffers without a dma-heap."""
    import libcamera

    from tests.ports.emulators.memory import allocate_in_memory
    from tests.ports.emulators.sensor import Sensor

    allocate_in_memory()
    camera = spec.camera
    world = World(spec, SystemClock())
    libcamera.plugged.append(Sensor(world, buses, model=str(camera.sensor), bits=camera.bit_depth))


def real_drivers(spec: InstrumentSpec) -> str:
    """Return the driver packages of the parts that are not simulated, with their versions."""
    used = {"picamera2": spec.camera.backend, "spidev": spec.light.backend, "smbus2": spec.bus.backend}
    return ", ".join(f"{name} {version(name)}" for name, backend in used.items() if backend != "sim")


def main(words: list[str]) -> None:
    """Run a command of diffuscope whose head has real drivers."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--head", type=Path, required=True)
    spec = load_head(head_file(parser.parse_known_args(words)[0].head))
    buses = emulated_buses()
    write([f"Emulated buses: the drivers are real ({real_drivers(spec)}), the eye is simulated"])
    if spec.camera.backend == "picamera2":
        attach_sensor(spec, buses)
    printer = BusPrinter(buses.folder)
    printer.start()
    try:
        diffuscope(words)
    finally:
        printer.stop()


if __name__ == "__main__":
    main(sys.argv[1:])
