"""Frames of a press on their way from the read-out to the disk: name, metadata and dose of each."""

from device.values import Colour, Frame
from services.imaging.raw_metadata import RawMetadata
from services.instrument.capture import colour_name, frame_metadata, lit_name
from services.records.frame_writer import DARK, FrameWriter, TakenFrame


class FrameSink:
    """Receiver of the frames of one press, which it passes to their writer without waiting; head thread only.

    `shared`: metadata of all its frames. `colour`: that of the burst; a lit frame in another colour is named after it.
    """

    def __init__(self, writer: FrameWriter, shared: RawMetadata, colour: Colour) -> None:
        self._writer = writer
        self._shared = shared
        self._colour = colour
        self._lit_frames = 0

    def __call__(self, frame: Frame, dose_j_per_cm2: float, exposed_s: float) -> None:
        """Begin to write a frame of the press; the dose and the duration are those of the press until now."""
        metadata = frame_metadata(self._shared, frame)
        self._writer.write(TakenFrame(self._name(frame), frame, metadata, dose_j_per_cm2, exposed_s))

    def _name(self, frame: Frame) -> str:
        if frame.illumination is None:
            return DARK
        if frame.illumination.colour != self._colour:
            return colour_name(frame.illumination.colour)
        self._lit_frames += 1
        return lit_name(self._lit_frames - 1)
