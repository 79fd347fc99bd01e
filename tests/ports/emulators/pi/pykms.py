"""Stub of the display module, which picamera2 imports and this project never uses."""


class PixelFormat:
    """Stub: each attribute is its own name."""

    def __getattr__(self, name):
        return name


PixelFormat = PixelFormat()
