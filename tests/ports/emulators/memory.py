"""Buffers for picamera2 where there is no dma-heap: anonymous files, through picamera2's own allocator seam."""

import os

import libcamera
import picamera2.dma_heap
from picamera2.allocators.allocator import Allocator

picamera2.dma_heap.heapNames[:] = [os.devnull]  # picamera2 opens a heap once more when it closes, and uses it no more


class MemoryAllocator(Allocator):
    """As picamera2's DmaAllocator, without a heap: buffers live as long as their configuration."""

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
