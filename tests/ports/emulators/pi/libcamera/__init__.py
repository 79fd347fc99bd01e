"""Emulation of libcamera's Python binding: enough for an unmodified picamera2, over an emulated sensor.

libcamera.plugged      the sensors that are attached now (see `sensor.Sensor`)
"""

import os
import threading
from collections import deque

from libcamera import _libcamera, controls, properties
from libcamera._libcamera import (
    CameraConfiguration,
    ColorSpace,
    ControlInfo,
    ControlType,
    FrameBuffer,
    FrameMetadata,
    Orientation,
    PixelFormat,
    Rectangle,
    Request,
    SensorConfiguration,
    Size,
    StreamConfiguration,
    StreamFormats,
    StreamRole,
    Transform,
)

__all__ = [
    "Camera",
    "CameraConfiguration",
    "CameraManager",
    "ColorSpace",
    "ControlInfo",
    "ControlType",
    "FrameBuffer",
    "FrameBufferAllocator",
    "FrameMetadata",
    "Orientation",
    "PixelFormat",
    "Rectangle",
    "Request",
    "SensorConfiguration",
    "Size",
    "StreamConfiguration",
    "StreamFormats",
    "StreamRole",
    "Transform",
    "_libcamera",
    "controls",
    "plugged",
    "properties",
]

plugged = []


class FrameBufferAllocator:
    """Unused: buffers come from the allocator passed to picamera2."""


class CameraManager:
    """Cameras, and the queue of completed requests with an eventfd that wakes its reader."""

    _one = None

    @classmethod
    def singleton(cls):
        if cls._one is None:
            cls._one = cls()
        return cls._one

    def __init__(self):
        self.event_fd = os.eventfd(0, os.EFD_NONBLOCK)
        self._ready, self._lock = deque(), threading.Lock()
        self._cameras = {}

    @property
    def cameras(self):
        for sensor in plugged:
            if sensor not in self._cameras:
                self._cameras[sensor] = Camera(sensor, self.complete, len(self._cameras))
        return [self._cameras[sensor] for sensor in plugged]

    def complete(self, request):
        """Queue a completed request and signal the eventfd."""
        with self._lock:
            self._ready.append(request)
        os.eventfd_write(self.event_fd, 1)

    def get_ready_requests(self):
        with self._lock:
            found, self._ready = list(self._ready), deque()
        try:
            os.eventfd_read(self.event_fd)
        except BlockingIOError:
            return found
        return found


class Camera:
    """One camera: configurations, requests, and a thread that fills them while the camera is started."""

    def __init__(self, sensor, complete, number):
        self.sensor, self._complete = sensor, complete
        self.id = f"/base/soc/i2c0mux/i2c@1/sensor@{number:05}"  # picamera2's first camera is the last of these
        self._queue, self._wake, self._running = deque(), threading.Condition(), False
        self._thread = None
        self._raw = None

    @property
    def properties(self):
        arrangement = properties.draft.ColorFilterArrangementEnum(self.sensor.arrangement)
        return {
            properties.Model: self.sensor.model,
            properties.Location: 2,
            properties.Rotation: 0,
            properties.PixelArraySize: self.sensor.size,
            properties.ColorFilterArrangement: arrangement,
        }

    @property
    def controls(self):
        whole = Rectangle(0, 0, self.sensor.size.width, self.sensor.size.height)
        return {
            controls.AeEnable: ControlInfo(False, True, True),
            controls.ExposureTime: ControlInfo(29, 0, None),  # as some builds report for the IMX296: no maximum
            controls.AnalogueGain: ControlInfo(self.sensor.lowest_gain, 16.0, self.sensor.lowest_gain),
            controls.FrameDurationLimits: ControlInfo(self.sensor.shortest_frame_us, 15_534_385, None),
            controls.NoiseReductionMode: ControlInfo(0, 4, 0),
            controls.ScalerCrop: ControlInfo(whole, whole, whole),
        }

    def acquire(self):
        self.sensor.refuse_if_held()

    def release(self):
        self.sensor.held = False

    def generate_configuration(self, roles):
        raw = {PixelFormat(name): [self.sensor.size] for name in self.sensor.formats}
        streams = [
            StreamConfiguration(StreamFormats(raw if role == StreamRole.Raw else {PixelFormat("XBGR8888"): []}))
            for role in roles
        ]
        return CameraConfiguration(streams, self._settle)

    def _settle(self, stream):
        """Adjust a stream to the sensor: granted formats, sizes and strides may differ from the request."""
        asked = str(stream.pixel_format), stream.size.to_tuple()
        if not str(stream.pixel_format).startswith(("R", "S", "MONO")):
            stream.stride = stream.size.width * 4
        else:
            stream.pixel_format = PixelFormat(self.sensor.granted(str(stream.pixel_format)))
            stream.size = self.sensor.size
            stream.stride = self.sensor.stride(str(stream.pixel_format))
        stream.frame_size = stream.stride * stream.size.height
        return asked != (str(stream.pixel_format), stream.size.to_tuple())

    def configure(self, configuration):
        self._raw = next((s for s in configuration if str(s.pixel_format) in self.sensor.known), None)
        return 0

    def create_request(self, cookie):
        return Request(cookie)

    def queue_request(self, request):
        with self._wake:
            self._queue.append(request)
            self._wake.notify()

    def start(self, first):
        self.sensor.begin({control.name: value for control, value in first.items()})
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self):
        with self._wake:
            self._running = False
            self._wake.notify()
        self._thread.join()
        for request in self._queue:
            request.status = Request.Status.Cancelled
            self._complete(request)
        self._queue.clear()

    def _run(self):
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._queue or not self._running)
                if not self._running:
                    return
                request = self._queue.popleft()
            asked = {control.name: value for control, value in request.controls.items()}
            metadata = self.sensor.expose(asked, request.buffers[self._raw.stream].planes[0].fd, self._raw)
            if metadata is None:  # the sensor has stalled: the request never comes back
                continue
            for buffer in request.buffers.values():
                buffer.metadata.planes[0].bytes_used = buffer.planes[0].length
            request.metadata = {getattr(controls, name): value for name, value in metadata.items()}
            request.status = Request.Status.Complete
            self._complete(request)
