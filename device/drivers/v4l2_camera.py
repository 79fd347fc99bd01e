"""UVC or industrial camera through Linux's V4L2: GREY, Y10, Y12 or Y16, streamed through memory-mapped buffers.

V4L2 frames carry a timestamp but no exposure time: a frame is accepted by the start of its exposure, and the exposure
control is read back. (Raspberry Pi sensors are not plain V4L2 devices: see `pi_camera.py`.)
"""

import ctypes
import errno
from typing import Any

import numpy as np

from device.clock import Clock
from device.config.head_file import CameraSpec
from device.drivers import v4l2
from device.drivers.exposure_retry import FRAME_TIMEOUT_S, LampState, RetryingCamera
from device.drivers.raw_counts import V4L2_BITS, RawLayout, v4l2_layout
from device.errors import CameraMismatch, CameraMissing, CameraStalled, HardwareError
from device.values import Counts, ExposureSettings

BUFFERS = 4
DELAY = 2  # frames after a change of exposure time that may still have the previous one
MAX_FRAMES = 16
NO_CAMERA_REMEDY = "Plug the camera in, or name another device in the head's file; see `ls /dev/video*`."


class V4l2Camera(RetryingCamera):
    """V4L2 driver that implements `ports.Camera` on one /dev/video*: a fixed mode, manual exposure in steps of 100 us.

    `light` is the source of each frame's illumination. `clock` must be the clock of the frame timestamps:
    CLOCK_MONOTONIC, which SystemClock reads on Linux. `patience_s` is the timeout for a frame after its exposure.
    Raises CameraMissing, CameraMismatch, CameraPacked or CameraStalled.
    """

    def __init__(
        self,
        spec: CameraSpec,
        light: LampState,
        clock: Clock,
        *,
        simulated: bool = False,
        patience_s: float = FRAME_TIMEOUT_S,
        transport: v4l2.Transport | None = None,
    ) -> None:
        super().__init__(spec, light, simulated, patience_s)
        self._clock = clock
        self._kernel = transport or v4l2.KernelTransport()
        self._fd: int | None = None
        self._memory: list[Any] = []
        self._stride = self._exposure_100us = 0
        self._layout: RawLayout
        self.open(ExposureSettings(spec.exposure_s))

    # Opening

    def _open(self, shot: ExposureSettings) -> None:
        try:
            self._fd = self._kernel.open(self._spec.device)
            self._set_up(shot)
        except HardwareError:
            raise
        except OSError as error:
            raise CameraMissing(f"{self._spec.device} cannot be used: {error.strerror}", NO_CAMERA_REMEDY) from error

    def _set_up(self, shot: ExposureSettings) -> None:
        can = v4l2.Capability()
        self._ioctl(v4l2.QUERYCAP, can)
        if ~(can.device_caps or can.capabilities) & (v4l2.CAN_CAPTURE | v4l2.CAN_STREAM):
            raise CameraMismatch(f"{self._spec.device} ({can.card.decode(errors='replace')}) does not stream pictures")
        self._layout = self._granted_layout()
        self._set_control(v4l2.EXPOSURE_AUTO, v4l2.MANUAL)
        self._set_control(v4l2.AUTOGAIN, 0, optional=True)
        self._exposure_100us = 0
        self._set_exposure(shot)
        asked = v4l2.Buffers(count=BUFFERS, type=v4l2.CAPTURE, memory=v4l2.MMAP)
        self._ioctl(v4l2.REQBUFS, asked)
        for index in range(asked.count):
            buffer = self._buffer(index)
            self._ioctl(v4l2.QUERYBUF, buffer)
            self._memory.append(self._kernel.map(self._handle, buffer.length, buffer.offset & 0xFFFFFFFF))
            self._ioctl(v4l2.QBUF, buffer)
        self._ioctl(v4l2.STREAMON, v4l2.Integer(v4l2.CAPTURE))

    def _granted_layout(self) -> RawLayout:
        """Return the layout of the first format granted with the sensor's bits or 16; CameraMismatch, CameraPacked."""
        spec = self._spec
        granted = v4l2.Format()
        deep = sorted((bits, name) for name, bits in V4L2_BITS.items() if bits in (spec.bit_depth, 16))
        for _, name in deep:
            granted = v4l2.Format(
                type=v4l2.CAPTURE, width=spec.cols, height=spec.rows, fourcc=name.encode(), field=v4l2.ANY_FIELD
            )
            self._ioctl(v4l2.S_FMT, granted)
            if granted.fourcc.decode(errors="replace") == name:
                break
        layout = v4l2_layout(granted.fourcc.decode(errors="replace"), spec.rows, spec.cols, spec.bit_depth)
        if (granted.height, granted.width) != self.shape:
            raise CameraMismatch(
                f"{spec.device} has no mode of {spec.rows} x {spec.cols}: it grants {granted.height} x {granted.width}"
            )
        self._stride = granted.bytesperline
        return layout

    # Controls and frames

    def _set_exposure(self, shot: ExposureSettings) -> bool:
        """Set the exposure time (100 us steps) and return whether it changed; CameraMismatch if another is read."""
        wanted = max(1, round(shot.exposure_s * 1e4))
        if wanted == self._exposure_100us:
            return False
        self._set_control(v4l2.EXPOSURE_100US, wanted)
        now = v4l2.Control(id=v4l2.EXPOSURE_100US)
        self._ioctl(v4l2.G_CTRL, now)
        if abs(now.value - wanted) > 1:
            raise CameraMismatch(f"{self._name} exposes for {now.value / 10:g} ms where {wanted / 10:g} ms were asked")
        self._exposure_100us = wanted
        return True

    def _take(self, shot: ExposureSettings, counts: Counts | None) -> None:
        """Write the next whole frame begun after this call to `counts` (None: check). TimeoutError, CameraStalled."""
        begin_s = self._clock.now_s()
        try:
            late = DELAY if self._set_exposure(shot) else 0
            for _ in range(MAX_FRAMES):
                if not self._kernel.wait(self._handle, self._timeout_s(shot, counts)):
                    raise TimeoutError
                buffer = self._buffer(0)
                self._ioctl(v4l2.DQBUF, buffer)
                try:
                    if self._began_s(buffer, shot) >= begin_s and not buffer.flags & v4l2.FRAME_BROKEN:
                        late -= 1
                        if late < 0:
                            self._read(buffer, counts)
                            return
                finally:
                    self._ioctl(v4l2.QBUF, buffer)
        except (HardwareError, TimeoutError):
            raise
        except OSError as error:
            if error.errno == errno.EIO:  # a frame was lost on the bus, and later ones may be lost too
                raise TimeoutError from error
            raise CameraMissing(f"{self._name} has gone: {error.strerror}", NO_CAMERA_REMEDY) from error
        raise CameraStalled(f"{MAX_FRAMES} frames passed, all of them broken or too old")

    def _began_s(self, buffer: v4l2.Buffer, shot: ExposureSettings) -> float:
        """Return the clock time, s, of the exposure's start; the timestamp is its end unless flags mark its start."""
        if not buffer.flags & v4l2.STAMP_MONOTONIC:
            raise CameraMismatch(f"{self._name} does not say when its frames were taken, so that old ones would pass")
        stamp_s = float(buffer.seconds + buffer.microseconds * 1e-6)
        return stamp_s if buffer.flags & v4l2.STAMP_AT_START else stamp_s - shot.exposure_s

    def _read(self, buffer: v4l2.Buffer, counts: Counts | None) -> None:
        raw = np.frombuffer(self._memory[buffer.index], np.uint8, self._spec.rows * self._stride)
        rows = raw.reshape(self._spec.rows, self._stride)
        if counts is None:
            self._layout.check(rows)
        else:
            self._layout.counts(rows, counts)

    def _close_device(self) -> None:
        fd = self._fd
        self._fd = None
        memory = self._memory
        self._memory = []
        for part in memory:
            part.close()
        if fd is not None:
            self._kernel.close(fd)  # closing also ends the streaming

    # Kernel requests

    @property
    def _handle(self) -> int:
        if self._fd is None:
            raise CameraMissing(f"{self._name} is not open")
        return self._fd

    def _ioctl(self, request: int, argument: ctypes.Structure) -> None:
        self._kernel.ioctl(self._handle, request, argument)

    def _set_control(self, control: int, value: int, optional: bool = False) -> None:
        try:
            self._ioctl(v4l2.S_CTRL, v4l2.Control(id=control, value=value))
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTTY):
                raise
            if not optional:
                raise CameraMismatch(f"{self._name} does not let its exposure time be chosen") from error

    def _buffer(self, index: int) -> v4l2.Buffer:
        return v4l2.Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
