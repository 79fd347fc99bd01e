"""Screening programme, read from a TOML file: picture slots, reasons, referral, numbers, retention, exports."""

from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from device.config.toml_file import Table, load_toml
from device.values import EYES, Eye
from services.errors import RecordNotFound
from services.records.age_encryption import PublicKey
from services.records.capture import OtherColour
from services.records.capture_target import COLOURS, FRAMES

DEFAULT_PROGRAMME = Path(__file__).parent / "programme.toml"
CHOOSE_REMEDY = "Choose one of the pictures on the page."

Reason = Literal["lids", "pupil", "cloudy", "still", "refused", "device", "other"]
REASONS: tuple[Reason, ...] = get_args(Reason)
Vision = Literal["6/6", "6/9", "6/12", "6/18", "6/24", "6/36", "6/60", "CF", "HM", "LP", "NLP"]
VISIONS: tuple[Vision, ...] = get_args(
    Vision
)  # visual acuity, best first; CF counting fingers, HM hand motion, LP and NLP light perception and none
# by language, such as "en" or "hi"; English, where it is given, serves a language without a text
Texts = dict[Annotated[str, Field(pattern="^[a-z]{2,3}$")], Annotated[str, Field(min_length=1, max_length=200)]]


class Slot(Table):
    """One picture slot: id, eye, name of the field of view, and whether its picture is required."""

    id: str = Field(pattern="^[A-Za-z0-9-]{1,40}$")
    eye: Eye
    field: str = Field(pattern="^[a-z-]{1,40}$")
    required: bool = True


class Referral(Table):
    """Rules of referral, and where the patient goes.

    `vision_limit`: the lowest visual acuity that is not referred. `centre_phone`: telephone. `within_days`: days after
    the visit within which a referral that is not urgent is to be seen. `where`: place to go, by language.
    """

    vision_limit: Vision
    centre_phone: str | None = Field(default=None, max_length=40)
    within_days: int = Field(default=30, ge=1, le=365)
    where: Texts = Field(default={})


class LetterTexts(Table):
    """Texts of slips and letters: name and address of the programme, to whom letters are addressed, a note by language.

    Without a name slips and letters have no heading of the programme.
    """

    name: str | None = Field(default=None, min_length=1, max_length=80)
    address: str | None = Field(default=None, min_length=1, max_length=200)
    to: str | None = Field(default=None, min_length=1, max_length=120)
    note: Texts = Field(default={})


class PatientNumbers(Table):
    """Automatic patient numbers: their prefix.

    `device_in_number`: the letters of the device follow the prefix, so that no two devices give the same number.
    """

    prefix: str = Field(pattern="^[A-Z]{0,4}$")
    device_in_number: bool = True


class Retention(Table):
    """Days after the last visit for which data of a patient are kept, 1 to 36500; without a number, always.

    `raw_days`: raw frames. `pictures_days`: pictures. `identity_days`: identifying fields and patient number.
    """

    raw_days: int | None = Field(default=None, ge=1, le=36500)
    pictures_days: int | None = Field(default=None, ge=1, le=36500)
    identity_days: int | None = Field(default=None, ge=1, le=36500)

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        given = [days for days in (self.raw_days, self.pictures_days, self.identity_days) if days is not None]
        if given != sorted(given):
            raise ValueError("keep raw frames no longer than pictures, and pictures no longer than the identity")
        return self


class Exports(Table):
    """Encryption of exports: `recipients`, public keys of age; without one they are not encrypted."""

    recipients: tuple[PublicKey, ...] = ()


class Programme(Table):
    """Screening programme: picture slots in their order, permitted reasons why a picture is not possible, rules.

    `version`: version of this schema. `retakes`: number of permitted retakes of a slot. `frames`: number of frames of
    one picture; more frames give more light, so less noise, and take longer. `colours`: other colours of light, of
    which one frame each is taken; blue only if it is listed.
    """

    version: Literal[1]
    slots: tuple[Slot, ...] = Field(min_length=1, max_length=16)
    reasons: tuple[Reason, ...] = REASONS
    retakes: int = Field(ge=0, le=10)
    frames: int = Field(default=FRAMES, ge=1, le=FRAMES)
    colours: tuple[OtherColour, ...] = COLOURS
    referral: Referral
    letter: LetterTexts = LetterTexts()
    numbers: PatientNumbers
    # Not on the wire: the page has no use for them.
    retention: Retention = Field(default=Retention(), exclude=True)
    exports: Exports = Field(default=Exports(), exclude=True)

    @model_validator(mode="after")
    def _slots_differ(self) -> Self:
        if len({slot.id for slot in self.slots}) < len(self.slots):
            raise ValueError("two slots have the same id; give each its own")
        if len(set(self.colours)) < len(self.colours):
            raise ValueError("a colour is listed twice; list it once")
        return self

    def for_device(self, letters: str) -> Self:
        """Return the programme with the letters of a device behind the prefix of its numbers, if it wants them."""
        if not self.numbers.device_in_number:
            return self
        numbers = self.numbers.model_copy(update={"prefix": self.numbers.prefix + letters})
        return self.model_copy(update={"numbers": numbers})

    def slot(self, id: str) -> Slot:
        """Return the slot with that id; RecordNotFound if there is none."""
        for slot in self.slots:
            if slot.id == id:
                return slot
        raise RecordNotFound(f"there is no picture named {id!r} in the programme", CHOOSE_REMEDY)

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """Return the eyes that have a required slot, OD first."""
        return tuple(eye for eye in EYES if any(slot.eye == eye and slot.required for slot in self.slots))


def load_programme(path: Path = DEFAULT_PROGRAMME) -> Programme:
    """Return the programme in a TOML file; SpecError with file, line and key of the first mistake."""
    return load_toml(path, Programme)
