"""Stands for the display's module, which picamera2 imports and this project never uses."""


class PixelFormat:
    """Nothing is ever shown."""

    def __getattr__(self, name):
        return name


PixelFormat = PixelFormat()
