"""Properties of the emulated sensors."""

from enum import IntEnum
from types import SimpleNamespace

from libcamera._libcamera import ControlId


class _ColorFilterArrangement(IntEnum):
    RGGB = 0
    RGB = 4
    MONO = 5


draft = SimpleNamespace(ColorFilterArrangementEnum=_ColorFilterArrangement)
Model = ControlId("Model")
Location = ControlId("Location")
Rotation = ControlId("Rotation")
PixelArraySize = ControlId("PixelArraySize")
ColorFilterArrangement = ControlId("ColorFilterArrangement")
