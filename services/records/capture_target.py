"""Target of a capture: visit and slot, or a test picture, with the rows that are written together with it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

from sqlalchemy.orm import Session

from services.records.capture import Capture, OtherColour

OTHER_COLOURS: tuple[OtherColour, ...] = get_args(OtherColour)
RowWriter = Callable[[Session, Capture], None]
Permit = Callable[[], None]
FRAMES = 4  # of one press: the burst for which the instrument plans
COLOURS: tuple[OtherColour, ...] = ("red",)  # of one press besides green; blue has 45 times the hazard of green


def permit_test_picture() -> None:
    """Permit light without a visit, for a test picture or for aiming: do nothing."""


@dataclass(frozen=True)
class CaptureTarget:
    """Target of a capture: visit id, slot id and field of view; without a visit the capture is a test picture.

    `tries`: number of earlier captures of the slot; `retakes`: permitted number of retakes. `write_rows` adds rows in
    the transaction that stores the capture, whose record holds `request`, the reference of the press
    (`IdempotentRequests.reference`). `permit` is called right before each light and raises ConsentMissing or
    ConsentDeclined if the visit does not allow light. `frames`: number of exposures in the picture's colour, 1 to
    FRAMES, each of which may be split into several frames; not used for a resumed capture. `colours`: other colours of
    light, of which one frame each is taken.
    """

    visit: str | None = None
    slot: str | None = None
    tries: int = 0
    retakes: int = 2
    field: str | None = None
    write_rows: RowWriter | None = None
    request: str | None = None
    permit: Permit = permit_test_picture
    frames: int = FRAMES
    colours: tuple[OtherColour, ...] = COLOURS


TEST_PICTURE = CaptureTarget()
