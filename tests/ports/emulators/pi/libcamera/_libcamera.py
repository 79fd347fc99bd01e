"""Value types of libcamera that picamera2 uses: sizes, formats, controls, requests; no further behaviour."""

from enum import Enum, IntEnum
from types import SimpleNamespace


class Size:
    def __init__(self, width=0, height=0):
        self.width, self.height = width, height

    def to_tuple(self):
        return self.width, self.height


class Rectangle:
    def __init__(self, x=0, y=0, width=0, height=0):
        self.x, self.y, self.width, self.height = x, y, width, height

    def to_tuple(self):
        return self.x, self.y, self.width, self.height


class PixelFormat:
    def __init__(self, name):
        self.name = name

    def __str__(self):
        return self.name

    def __eq__(self, other):
        return str(self) == str(other)

    def __hash__(self):
        return hash(self.name)


class Transform:
    def __init__(self, other=None, hflip=0, vflip=0, transpose=0):
        self.hflip, self.vflip, self.transpose = (
            (other.hflip, other.vflip, other.transpose) if other else (bool(hflip), bool(vflip), bool(transpose))
        )

    def __str__(self):
        return f"hflip {self.hflip}, vflip {self.vflip}, transpose {self.transpose}"

    __hash__ = object.__hash__


class Orientation(Enum):
    Rotate0 = 1
    Rotate0Mirror = 2
    Rotate180 = 3
    Rotate180Mirror = 4
    Rotate90Mirror = 5
    Rotate270 = 6
    Rotate270Mirror = 7
    Rotate90 = 8


class ColorSpace:
    YcbcrEncoding = SimpleNamespace(Null=0)
    Range = SimpleNamespace(Full=0)

    def __init__(self, other=None):
        self.primaries = other.primaries if other else None
        self.transferFunction = other.transferFunction if other else None
        self.ycbcrEncoding = self.range = None

    def __str__(self):
        return str(self.primaries)

    __hash__ = object.__hash__

    @classmethod
    def _named(cls, name):
        space = cls()
        space.primaries = space.transferFunction = name
        return space

    @classmethod
    def Sycc(cls):
        return cls._named("sycc")

    @classmethod
    def Smpte170m(cls):
        return cls._named("smpte170m")

    @classmethod
    def Rec709(cls):
        return cls._named("rec709")

    @classmethod
    def Raw(cls):
        return cls._named("raw")


class ControlType(Enum):
    Integer32 = 1
    Integer64 = 2
    Float = 3
    Rectangle = 4
    Size = 5
    Bool = 6


class ControlId:
    def __init__(self, name, type=ControlType.Integer32):
        self.name, self.type = name, type


class ControlInfo:
    def __init__(self, min, max, default):
        self.min, self.max, self.default = min, max, default


class StreamRole(IntEnum):
    Raw = 0
    StillCapture = 1
    VideoRecording = 2
    Viewfinder = 3


class SensorConfiguration:
    def __init__(self):
        self.bit_depth, self.output_size = 0, Size()


class StreamFormats:
    """Sizes available for each pixel format."""

    def __init__(self, sizes):
        self._sizes = sizes

    @property
    def pixel_formats(self):
        return list(self._sizes)

    def sizes(self, pixel_format):
        return self._sizes[PixelFormat(str(pixel_format))]


class Stream:
    configuration = None


class StreamConfiguration:
    def __init__(self, formats):
        self.formats, self.stream = formats, Stream()
        self.size, self.pixel_format, self.buffer_count = Size(640, 480), PixelFormat("XBGR8888"), 4
        self.stride = self.frame_size = 0
        self.color_space = None
        self.stream.configuration = self


class CameraConfiguration:
    class Status(Enum):
        Valid = 0
        Adjusted = 1
        Invalid = 2

    def __init__(self, streams, settle):
        self._streams, self._settle = streams, settle
        self.orientation, self.sensor_config = Orientation.Rotate0, None

    def at(self, index):
        return self._streams[index]

    def __iter__(self):
        return iter(self._streams)

    def __len__(self):
        return len(self._streams)

    def validate(self):
        changed = [self._settle(stream) for stream in self._streams]
        return self.Status.Adjusted if any(changed) else self.Status.Valid


class FrameMetadata:
    class Status(Enum):
        Success = 0
        Error = 1

    def __init__(self):
        self.status, self.planes = self.Status.Success, [SimpleNamespace(bytes_used=0)]


class FrameBuffer:
    class Plane:
        def __init__(self):
            self.fd, self.offset, self.length = -1, 0, 0

    def __init__(self, planes):
        self.planes, self.metadata = planes, FrameMetadata()


class Request:
    class Status(Enum):
        Pending = 0
        Complete = 1
        Cancelled = 2

    def __init__(self, cookie):
        self.cookie, self.buffers, self.controls, self.metadata = cookie, {}, {}, {}
        self.status = self.Status.Pending

    def add_buffer(self, stream, buffer):
        self.buffers[stream] = buffer

    def set_control(self, control, value):
        self.controls[control] = value

    def reuse(self):
        self.controls, self.metadata, self.status = {}, {}, self.Status.Pending
