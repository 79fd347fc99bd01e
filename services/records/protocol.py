"""What a screening consists of, read from a TOML file: its pictures, its retakes, and the programme's own numbers."""

from pathlib import Path
from typing import Literal, Self, get_args

from pydantic import Field, model_validator

from device.errors import NotKept
from device.tables import Table, load_toml
from device.values import EYES, Eye

STANDARD = Path(__file__).parent / "protocol.toml"
CHOOSE = "Choose one of the pictures on the page."

Reason = Literal["lids", "pupil", "cloudy", "still", "refused", "device", "other"]
REASONS: tuple[Reason, ...] = get_args(Reason)
Vision = Literal["6/6", "6/9", "6/12", "6/18", "6/24", "6/36", "6/60", "CF", "HM", "LP", "NLP"]
VISIONS: tuple[Vision, ...] = get_args(Vision)  # the ladder, best first: counts fingers, hand movement, light, none


class Slot(Table):
    """One picture that a visit should have: of which eye, looking where."""

    id: str = Field(pattern="^[A-Za-z0-9-]{1,40}$")
    eye: Eye
    field: str = Field(pattern="^[a-z-]{1,40}$")
    required: bool = True


class Programme(Table):
    """The programme's own numbers: `vision_limit` is the least vision that is not referred."""

    vision_limit: Vision
    prefix: str = Field(pattern="^[A-Z]{0,4}$")
    centre_phone: str | None = Field(default=None, max_length=40)


class Protocol(Table):
    """Slots in the order in which they are taken, the reasons for which one cannot be, and the programme."""

    slots: tuple[Slot, ...] = Field(min_length=1, max_length=16)
    reasons: tuple[Reason, ...] = REASONS
    retakes: int = Field(ge=0, le=10)
    programme: Programme

    @model_validator(mode="after")
    def _slots_differ(self) -> Self:
        if len({slot.id for slot in self.slots}) < len(self.slots):
            raise ValueError("two slots have the same id; give each its own")
        return self

    def slot(self, id: str) -> Slot:
        """The slot of that name; NotKept if there is none."""
        for slot in self.slots:
            if slot.id == id:
                return slot
        raise NotKept(f"there is no picture named {id!r} in the protocol", CHOOSE)

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """The eyes of which it wants a picture."""
        return tuple(eye for eye in EYES if any(slot.eye == eye and slot.required for slot in self.slots))


def load_protocol(path: Path = STANDARD) -> Protocol:
    """Read a protocol; SpecError names the file, the line and the key of the first mistake."""
    return load_toml(path, Protocol)
