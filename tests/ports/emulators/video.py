"""Emulated /dev/video0 that exposes a simulated world: the system calls of the V4L2 driver."""

import ctypes
import errno
import mmap
import os
import time
from typing import Any

import numpy as np

from device.drivers import v4l2
from device.sim.world import World

PAGE = mmap.PAGESIZE


def os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


class EmulatedVideo:
    """A `Transport` with one camera; its frames are in an anonymous file, with random bytes in the row padding.

    `grants` is the only format that it grants; faults: "camera.missing" and "camera.stalled" of the world, `silent`
    (until it is reopened), `stamped` False (no monotonic timestamps), `streams` False (no streaming capability).
    """

    def __init__(self, world: World, grants: str = "Y12 ") -> None:
        self.world, self.grants = world, grants
        self.silent, self.stamped, self.streams = False, True, True
        self.controls = {v4l2.EXPOSURE_AUTO: 3, v4l2.EXPOSURE_100US: 100}
        self.rows, self.cols = world.shape
        self.width = 1 if grants == "GREY" else 2
        self.stride = self.cols * self.width + 26
        self.length = -(-self.stride * self.rows // PAGE) * PAGE
        self.queue: list[int] = []
        self.frames = 0
        self.memory = -1

    def open(self, path: str) -> int:
        if self.world.has_fault("camera.missing"):
            raise os_error(errno.ENOENT)
        self.silent, self.queue = False, []
        self.memory = os.memfd_create("video")
        os.truncate(self.memory, 8 * self.length)
        return self.memory

    def close(self, fd: int) -> None:
        os.close(fd)

    def map(self, fd: int, length: int, offset: int) -> Any:
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)

    def wait(self, fd: int, limit_s: float) -> bool:
        if self.silent or not self.queue or self.world.has_fault("camera.stalled"):
            time.sleep(limit_s)
            return False
        return True

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        if self.world.has_fault("camera.missing"):
            raise os_error(errno.ENODEV)
        match request, argument:
            case v4l2.QUERYCAP, v4l2.Capability():
                argument.card = b"emulated"
                argument.device_caps = v4l2.CAN_CAPTURE | v4l2.CAN_STREAM if self.streams else v4l2.CAN_CAPTURE
            case v4l2.S_FMT, v4l2.Format():
                argument.fourcc, argument.width, argument.height = self.grants.encode(), self.cols, self.rows
                argument.bytesperline, argument.sizeimage = self.stride, self.length
            case v4l2.QUERYBUF, v4l2.Buffer():
                argument.length, argument.offset = self.length, argument.index * self.length
            case v4l2.QBUF, v4l2.Buffer():
                self.queue.append(argument.index)
            case v4l2.DQBUF, v4l2.Buffer():
                self._frame(argument)
            case ((v4l2.S_CTRL | v4l2.G_CTRL), v4l2.Control()):
                self._control(request, argument)

    def _control(self, request: int, control: v4l2.Control) -> None:
        if control.id not in self.controls:
            raise os_error(errno.EINVAL)
        if request == v4l2.S_CTRL:
            self.controls[control.id] = control.value
        control.value = self.controls[control.id]

    def _frame(self, buffer: v4l2.Buffer) -> None:
        """Expose now, in real time, and write the counts in the granted format."""
        begin_s, exposure_s = time.perf_counter(), self.controls[v4l2.EXPOSURE_100US] * 1e-4
        electrons = self.world.electrons(exposure_s)
        time.sleep(exposure_s)
        self.frames += 1
        counts = self.world.sensor.read(electrons, (self.world.scene.seed, 9, self.frames))
        raw = np.random.default_rng(self.frames).integers(0, 256, (self.rows, self.stride), np.uint8)
        words = counts.astype(np.uint8 if self.width == 1 else np.uint16)
        raw[:, : self.width * self.cols] = words.view(np.uint8)
        buffer.index = self.queue.pop(0)
        os.pwrite(self.memory, raw.tobytes(), buffer.index * self.length)
        buffer.seconds, buffer.microseconds = divmod(int((begin_s + exposure_s) * 1e6) + 1, 1_000_000)
        buffer.flags = v4l2.STAMP_MONOTONIC if self.stamped else 0
