"""Controls of the emulated sensors."""

from enum import IntEnum
from types import SimpleNamespace

from libcamera._libcamera import ControlId, ControlType


class _NoiseReductionMode(IntEnum):
    Off = 0
    Fast = 1
    HighQuality = 2
    Minimal = 3


draft = SimpleNamespace(NoiseReductionModeEnum=_NoiseReductionMode)
AeEnable = ControlId("AeEnable", ControlType.Bool)
ExposureTime = ControlId("ExposureTime")
ExposureTimeMode = ControlId("ExposureTimeMode")
AnalogueGain = ControlId("AnalogueGain", ControlType.Float)
AnalogueGainMode = ControlId("AnalogueGainMode")
FrameDurationLimits = ControlId("FrameDurationLimits", ControlType.Integer64)
NoiseReductionMode = ControlId("NoiseReductionMode")
ScalerCrop = ControlId("ScalerCrop", ControlType.Rectangle)
SensorTimestamp = ControlId("SensorTimestamp", ControlType.Integer64)
SensorBlackLevels = ControlId("SensorBlackLevels")
DigitalGain = ControlId("DigitalGain", ControlType.Float)
FrameDuration = ControlId("FrameDuration", ControlType.Integer64)
