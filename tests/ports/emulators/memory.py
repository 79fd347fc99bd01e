"""Buffer allocator for picamera2 without a dma-heap: anonymous files, through picamera2's own allocator interface."""

import os

import libcamera
import picamera2.dma_heap
from picamera2.allocators.allocator import Allocator

picamera2.dma_heap.heapNames[:] = [os.devnull]  # picamera2 opens a heap again when it closes, and does not use it


class MemoryAllocator(Allocator):
    """Equivalent of picamera2's DmaAllocator without a heap: buffers exist until the next configuration."""

    def __init__(self) -> None:
        super().__init__()
        self._fds: list[int] = []
        self._buffers: dict = {}

    def allocate(self, libcamera_config, use_case) -> None:
        self.close()
        for config in libcamera_config:
            self._buffers[config.stream] = [self._buffer(config.frame_size) for _ in range(config.buffer_count)]

    def _buffer(self, size):
        plane = libcamera.FrameBuffer.Plane()
        plane.fd, plane.length = os.memfd_create("frame"), size
        os.ftruncate(plane.fd, size)
        self._fds.append(plane.fd)
        return libcamera.FrameBuffer([plane])

    def buffers(self, stream):
        return self._buffers[stream]

    def close(self) -> None:
        for fd in self._fds:
            os.close(fd)
        self._fds, self._buffers = [], {}


def allocate_in_memory() -> None:
    """Let each Picamera2 of this process allocate here by default, as it does from a kernel's dma-heap on a Pi."""
    picamera2.picamera2.DmaAllocator = MemoryAllocator
