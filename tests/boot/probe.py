"""Run on the booted card, in the instrument's sandbox and as its user: opens each device, prints what it found as JSON.

Camera and thermometer are read through the instrument's drivers. The virtual camera of the kernel (vivid) has no
exposure time: the two controls of it are kept here, all other requests go to the kernel.
"""

import ctypes
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyfftw

from device.clock import SystemClock
from device.config.head_file import CameraSpec
from device.drivers import v4l2
from device.drivers.chips import I2cBus, Tmp117
from device.drivers.no_light import NoLight
from device.drivers.v4l2_camera import V4l2Camera
from device.errors import BusFault
from device.values import ExposureSettings

PATTERNS = ("/dev/spidev*", "/dev/i2c-*", "/dev/gpiochip*", "/dev/video*", "/dev/media*", "/dev/dma_heap/*")
FORBIDDEN = ("/dev/vda", "/dev/kmsg", "/dev/mem")
ROWS, COLS = 720, 1280


class WithExposure(v4l2.KernelTransport):
    """System calls of the kernel, with an exposure time for a camera that has none."""

    def __init__(self) -> None:
        self._values: dict[int, int] = {}

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        if isinstance(argument, v4l2.Control) and argument.id in (v4l2.EXPOSURE_AUTO, v4l2.EXPOSURE_100US):
            if request == v4l2.S_CTRL:
                self._values[argument.id] = argument.value
            argument.value = self._values[argument.id]
        else:
            super().ioctl(fd, request, argument)


def opened(path: Path) -> str:
    """Return "opens", or the reason why the file does not open for reading and writing."""
    try:
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
    except OSError as error:
        return str(error.strerror)
    return "opens"


def frame() -> dict[str, Any]:
    """Return shape and number of different counts of one frame of /dev/video0."""
    spec = CameraSpec(
        backend="v4l2",
        rows=ROWS,
        cols=COLS,
        pitch_um=3.0,
        bit_depth=16,
        full_well_e=1e4,
        read_noise_e=1.0,
        black_dn=0.0,
        exposure_s=0.02,
    )
    camera = V4l2Camera(spec, NoLight(), SystemClock(), transport=WithExposure(), patience_s=60.0)
    try:
        counts = camera.expose(ExposureSettings(spec.exposure_s)).counts
    finally:
        camera.close()
    return {"shape": counts.shape, "levels": len(np.unique(counts)), "max": int(counts.max())}


def temperature_c(address: int = 0x48) -> float | None:
    """Return what the thermometer's driver reads on the bus that has a chip at that address; None without one."""
    for path in sorted(Path("/dev").glob("i2c-*")):
        bus = I2cBus(str(path))
        try:
            return Tmp117(bus, address).read_c()
        except BusFault as error:  # no chip there: the next bus
            sys.stderr.write(f"{path}: {error}\n")
        finally:
            bus.close()
    return None


def fft_pair_s(rows: int = 1080, cols: int = 1920) -> float:
    """Return the median time, s, of one planned pair of real FFTs in float32."""
    frame = pyfftw.zeros_aligned((rows, cols), "float32")
    spectrum = pyfftw.zeros_aligned((rows, cols // 2 + 1), "complex64")
    forward = pyfftw.FFTW(frame, spectrum, axes=(0, 1), flags=("FFTW_ESTIMATE",))
    back = pyfftw.FFTW(spectrum, frame, axes=(0, 1), direction="FFTW_BACKWARD", flags=("FFTW_ESTIMATE",))
    times = []
    for _ in range(3):
        begin_s = time.perf_counter()
        forward()
        back()
        times.append(time.perf_counter() - begin_s)
    return sorted(times)[1]


if __name__ == "__main__":
    if sys.argv[1:] == ["fft"]:
        sys.stdout.write(f"{fft_pair_s():.4f}\n")
        sys.exit()
    paths = sorted(path for pattern in PATTERNS for path in Path("/").glob(pattern.lstrip("/")))
    found = {
        "user": os.getuid(),
        "nodes": {str(path): opened(path) for path in paths},
        "forbidden": {path: opened(Path(path)) for path in FORBIDDEN},
        "frame": frame(),
        "temperature_c": temperature_c(),
    }
    sys.stdout.write(json.dumps(found) + "\n")
