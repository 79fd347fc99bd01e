"""A UVC or industrial camera over Linux's V4L2: GREY, Y10, Y12 or Y16, streamed from memory that the kernel shares.

Its frames carry no exposure time, only their moment: a frame counts from when its exposure began, and the control is
read back. (The sensors of a Raspberry Pi are not plain V4L2 devices: `pi_camera.py`.)
"""

import ctypes
import errno
from typing import Any

import numpy as np

from device.clock import Clock
from device.drivers import v4l2
from device.drivers.exposing import Exposing, Shining
from device.drivers.raw_counts import V4L2_BITS, RawLayout, v4l2_layout
from device.errors import CameraMissing, CameraStalled, CameraWrong, HardwareError
from device.spec import CameraSpec
from device.values import Counts, Shot

BUFFERS = 4
DELAY = 2  # frames after a change of exposure time that may still have the old one
MOST_FRAMES = 16
PATIENCE_S = 2.0
NO_CAMERA = "Plug the camera in, or name another device in the head's file; see `ls /dev/video*`."


class V4l2Camera(Exposing):
    """One /dev/video*: a fixed mode, memory-mapped buffers, manual exposure in steps of 100 us.

    `clock` must be the one that stamps the frames: CLOCK_MONOTONIC, which SystemClock reads on Linux. Raises
    CameraMissing, CameraWrong, CameraPacked or CameraStalled.
    """

    def __init__(
        self,
        spec: CameraSpec,
        light: Shining,
        clock: Clock,
        *,
        simulated: bool = False,
        patience_s: float = PATIENCE_S,
        transport: v4l2.Transport | None = None,
    ) -> None:
        super().__init__(spec, light, simulated)
        self._clock, self._patience_s, self._kernel = clock, patience_s, transport or v4l2.Kernel()
        self._fd: int | None = None
        self._memory: list[Any] = []
        self._stride = self._exposure_100us = 0
        self._layout: RawLayout
        self.open(Shot(spec.exposure_s))

    # Opening

    def _open(self, shot: Shot) -> None:
        try:
            self._fd = self._kernel.open(self._spec.device)
            self._set_up(shot)
        except HardwareError:
            raise
        except OSError as error:
            raise CameraMissing(f"{self._spec.device} cannot be used: {error.strerror}", NO_CAMERA) from error

    def _set_up(self, shot: Shot) -> None:
        can = v4l2.Capability()
        self._ioctl(v4l2.QUERYCAP, can)
        if ~(can.device_caps or can.capabilities) & (v4l2.CAN_CAPTURE | v4l2.CAN_STREAM):
            raise CameraWrong(f"{self._spec.device} ({can.card.decode(errors='replace')}) does not stream pictures")
        self._layout = self._granted()
        self._control(v4l2.EXPOSURE_AUTO, v4l2.MANUAL)
        self._control(v4l2.AUTOGAIN, 0, optional=True)
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

    def _granted(self) -> RawLayout:
        """Ask for the mode in each plain format that holds the sensor's bits, and read back what was made of it."""
        spec, granted = self._spec, v4l2.Format()
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
            raise CameraWrong(
                f"{spec.device} has no mode of {spec.rows} x {spec.cols}: it grants {granted.height} x {granted.width}"
            )
        self._stride = granted.bytesperline
        return layout

    # Controls and frames

    def _set_exposure(self, shot: Shot) -> bool:
        """Whether the exposure time had to be changed; CameraWrong if the camera makes another one of it."""
        wanted = max(1, round(shot.exposure_s * 1e4))
        if wanted == self._exposure_100us:
            return False
        self._control(v4l2.EXPOSURE_100US, wanted)
        now = v4l2.Control(id=v4l2.EXPOSURE_100US)
        self._ioctl(v4l2.G_CTRL, now)
        if abs(now.value - wanted) > 1:
            raise CameraWrong(f"{self._name} exposes for {now.value / 10:g} ms where {wanted / 10:g} ms were asked")
        self._exposure_100us = wanted
        return True

    def _take(self, shot: Shot, counts: Counts | None) -> None:
        """The next whole frame that began after this call. Raises TimeoutError when none comes."""
        begin_s = self._clock.now_s()
        try:
            late = DELAY if self._set_exposure(shot) else 0
            for _ in range(MOST_FRAMES):
                if not self._kernel.wait(self._handle, shot.exposure_s + self._patience_s):
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
            if error.errno == errno.EIO:  # a frame was lost on the bus, and perhaps the next one too
                raise TimeoutError from error
            raise CameraMissing(f"{self._name} has gone: {error.strerror}", NO_CAMERA) from error
        raise CameraStalled(f"{MOST_FRAMES} frames passed, all of them broken or too old")

    def _began_s(self, buffer: v4l2.Buffer, shot: Shot) -> float:
        """When the exposure of a frame began; its stamp is its end unless it says otherwise."""
        if not buffer.flags & v4l2.STAMP_MONOTONIC:
            raise CameraWrong(f"{self._name} does not say when its frames were taken, so that old ones would pass")
        stamp_s = float(buffer.seconds + buffer.microseconds * 1e-6)
        return stamp_s if buffer.flags & v4l2.STAMP_AT_START else stamp_s - shot.exposure_s

    def _read(self, buffer: v4l2.Buffer, counts: Counts | None) -> None:
        raw = np.frombuffer(self._memory[buffer.index], np.uint8, self._spec.rows * self._stride)
        rows = raw.reshape(self._spec.rows, self._stride)
        if counts is None:
            self._layout.check(rows)
        else:
            self._layout.counts(rows, counts)

    def _let_go(self) -> None:
        fd, self._fd = self._fd, None
        memory, self._memory = self._memory, []
        for part in memory:
            part.close()
        if fd is not None:
            self._kernel.close(fd)  # which also ends the streaming

    # Words to the kernel

    @property
    def _handle(self) -> int:
        if self._fd is None:
            raise CameraMissing(f"{self._name} is not open")
        return self._fd

    def _ioctl(self, request: int, argument: ctypes.Structure) -> None:
        self._kernel.ioctl(self._handle, request, argument)

    def _control(self, control: int, value: int, optional: bool = False) -> None:
        try:
            self._ioctl(v4l2.S_CTRL, v4l2.Control(id=control, value=value))
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTTY):
                raise
            if not optional:
                raise CameraWrong(f"{self._name} does not let its exposure time be chosen") from error

    def _buffer(self, index: int) -> v4l2.Buffer:
        return v4l2.Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
