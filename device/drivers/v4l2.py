"""Subset of Linux's <linux/videodev2.h> for streaming from one camera on 64-bit machines, through ctypes."""

import ctypes
import fcntl
import mmap
import os
import select
from typing import Any, Protocol

U32 = ctypes.c_uint32
S32 = ctypes.c_int32
CAPTURE, MMAP, ANY_FIELD = 1, 1, 0
CAN_CAPTURE, CAN_STREAM = 0x1, 0x04000000
FRAME_BROKEN, STAMP_MONOTONIC, STAMP_AT_START = 0x40, 0x2000, 0x10000
EXPOSURE_AUTO, EXPOSURE_100US, GAIN, AUTOGAIN = 0x009A0901, 0x009A0902, 0x00980913, 0x00980912
MANUAL = 1


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", U32),
        ("capabilities", U32),
        ("device_caps", U32),
        ("reserved", U32 * 3),
    )


class Format(ctypes.Structure):
    """struct v4l2_format with its struct v4l2_pix_format."""

    _fields_ = (
        ("type", U32),
        ("_pad", U32),
        ("width", U32),
        ("height", U32),
        ("fourcc", ctypes.c_char * 4),
        ("field", U32),
        ("bytesperline", U32),
        ("sizeimage", U32),
        ("_rest", ctypes.c_uint8 * 176),
    )


class Buffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (("count", U32), ("type", U32), ("memory", U32), ("capabilities", U32), ("flags", U32))


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", U32),
        ("type", U32),
        ("bytesused", U32),
        ("flags", U32),
        ("field", U32),
        ("_pad", U32),
        ("seconds", ctypes.c_int64),
        ("microseconds", ctypes.c_int64),
        ("timecode", ctypes.c_uint8 * 16),
        ("sequence", U32),
        ("memory", U32),
        ("offset", ctypes.c_uint64),
        ("length", U32),
        ("_rest", U32 * 3),
    )


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", U32), ("value", S32))


class Integer(ctypes.Structure):
    """The int argument of STREAMON and STREAMOFF."""

    _fields_ = (("value", ctypes.c_int),)


def _code(direction: int, number: int, struct: type[ctypes.Structure]) -> int:
    """Return the request code of Linux's _IOC macro: direction 1 writes to the kernel, 2 reads from it, 3 does both."""
    return direction << 30 | ctypes.sizeof(struct) << 16 | ord("V") << 8 | number


QUERYCAP = _code(2, 0, Capability)
S_FMT = _code(3, 5, Format)
REQBUFS = _code(3, 8, Buffers)
QUERYBUF = _code(3, 9, Buffer)
QBUF = _code(3, 15, Buffer)
DQBUF = _code(3, 17, Buffer)
STREAMON = _code(1, 18, Integer)
STREAMOFF = _code(1, 19, Integer)
G_CTRL = _code(3, 27, Control)
S_CTRL = _code(3, 28, Control)


class Transport(Protocol):
    """System calls of the V4L2 driver; tests pass an emulated device here."""

    def open(self, path: str) -> int:
        """Return a file descriptor; OSError."""

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        """Send one request; the driver writes its answer, if any, into `argument`. OSError."""

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Return the memory of one buffer, with the buffer protocol and `close`; OSError."""

    def wait(self, fd: int, limit_s: float) -> bool:
        """Return True once a frame is ready; False if none is ready within `limit_s` seconds."""

    def close(self, fd: int) -> None:
        """Close the file descriptor."""


class KernelTransport:
    """Transport to the Linux kernel: the real system calls."""

    def open(self, path: str) -> int:
        """Return a file descriptor; OSError."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure) -> None:
        """Send one request; the driver writes its answer, if any, into `argument`. OSError."""
        fcntl.ioctl(fd, request, argument)

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Return the read-only memory map of one buffer."""
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)

    def wait(self, fd: int, limit_s: float) -> bool:
        """Return True once a frame is ready; False if none is ready within `limit_s` seconds."""
        return bool(select.select([fd], [], [], max(0.0, limit_s))[0])

    def close(self, fd: int) -> None:
        """Close the file descriptor."""
        os.close(fd)
