"""Visit as an immutable value, and its rules: chosen capture of a slot, next empty slot, outcome."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, cast

from device.values import ChannelUse, Eye
from services.records.capture import NO_METHOD, StoredVerdict
from services.records.json_values import FormValue
from services.records.programme import VISIONS, Programme, Vision

GREEN_ONLY = "colour.none"  # no other colour was asked for, or the head has none
EYE_WORDS = {"OD": "right", "OS": "left"}
URGENT_COMPLAINTS = {"sudden_loss": "sudden loss of vision", "pain": "pain"}
ReopenReason = Literal["answer", "picture", "mistake"]  # a wrong answer, a missing picture, finished by mistake
# consent withdrawn, erasure asked for, retention over, begun by mistake
EraseReason = Literal["withdrawn", "requested", "retention", "mistake"]
OutcomeCode = Literal["refer_today", "refer_vision", "refer_picture", "declined", "send"]


@dataclass(frozen=True)
class SlotCapture:
    """One capture of a slot: capture id, and the verdict on its image quality (None: no verdict).

    `no_colour`: code of the reason why it has no picture in colour; None if it has one, or no picture at all.
    """

    capture: str
    verdict: StoredVerdict | None
    no_colour: str | None = None

    @property
    def is_good(self) -> bool:
        """Return whether the verdict is "good"."""
        return self.verdict is not None and self.verdict.is_good


@dataclass(frozen=True)
class SlotDecision:
    """A user's decision on a slot: chosen capture id, or reason why a picture is not possible, or neither (emptied)."""

    capture: str | None = None
    reason: str | None = None


@dataclass(frozen=True)
class SlotState:
    """One slot of a visit: all its captures, oldest first, and the user's decision (None: no decision)."""

    captures: tuple[SlotCapture, ...] = ()
    decision: SlotDecision | None = None

    @property
    def state(self) -> Literal["empty", "taken", "not_possible"]:
        """Return `not_possible` for a decision with a reason, `taken` if there is a chosen capture, else `empty`."""
        if self.decision is not None and self.decision.reason is not None:
            return "not_possible"
        return "empty" if self.chosen is None else "taken"

    @property
    def chosen(self) -> SlotCapture | None:
        """Return the capture that the user chose; None if the decision names no capture of this slot.

        Without a decision: the newest good capture, else the newest of all, None without captures.
        """
        if self.decision is not None:
            return next((taken for taken in self.captures if taken.capture == self.decision.capture), None)
        return max(enumerate(self.captures), key=lambda pair: (pair[1].is_good, pair[0]), default=(0, None))[1]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a visit: a code for programs, and the same as one sentence for the health worker."""

    code: OutcomeCode
    sentence: str


@dataclass(frozen=True)
class Visit:
    """One visit of the patient with that opaque id and number; timestamps are UTC, `day` is the local date (ISO 8601).

    `fields`: answers by form field; `slots`: state by slot id. `finished_at`, `outcome`: None in an unfinished visit.
    """

    id: str
    patient_id: str
    number: str
    day: str
    begun_at: datetime
    fields: Mapping[str, FormValue]
    slots: Mapping[str, SlotState]
    finished_at: datetime | None = None
    outcome: Outcome | None = None

    @property
    def next_slot(self) -> str | None:
        """Return the id of the first empty slot in the order of the programme; None if there is none."""
        return next((id for id, slot in self.slots.items() if slot.state == "empty"), None)

    @property
    def no_colour(self) -> str | None:
        """Return why the pictures of the visit are shown in green light: the code of a capture that has no colour.

        None if every capture is in colour: a visit is shown in colour as a whole, or not at all.
        """
        codes = [
            taken.no_colour for slot in self.slots.values() for taken in slot.captures if taken.no_colour is not None
        ]
        return next((code for code in codes if code != GREEN_ONLY), codes[0] if codes else None)


def no_colour_of(method: str, channels: Sequence[ChannelUse]) -> str | None:
    """Return the code of the reason why a capture has no picture in colour; None if it has one, or no picture.

    `method`, `channels`: of its report.
    """
    others = [channel for channel in channels if channel.name != "green" and not channel.predicted]
    if method == NO_METHOD or any(channel.reason is None for channel in others):
        return None
    return next((channel.code or GREEN_ONLY for channel in others), GREEN_ONLY)


def decision_after(slot: SlotState, new: SlotCapture) -> SlotDecision | None:
    """Return the decision that is valid for a slot after a new capture; `slot` is its state before, without `new`.

    None, so that the newest good capture counts: without a decision, after a decision with a reason, or if `new` is
    good and the chosen capture is not. In an emptied slot `new` is chosen. Otherwise the decision stays.
    """
    before = slot.decision
    if before is None or before.reason is not None:
        return None
    if before.capture is None:
        return SlotDecision(new.capture)
    chosen = slot.chosen
    return None if new.is_good and not (chosen and chosen.is_good) else before


def decide_outcome(programme: Programme, fields: Mapping[str, FormValue], slots: Mapping[str, SlotState]) -> Outcome:
    """Return the outcome of a visit by the rules of the programme: the first that applies, most urgent first.

    Order: urgent complaint (`refer_today`), vision below the programme's limit (`refer_vision`), no consent to pictures
    (`declined`, no referral), an eye without a picture or with a required one not possible (`refer_picture`),
    else `send`. The sentence names no disease.
    """
    complaints = fields.get("complaints")
    named = complaints if isinstance(complaints, list) else ()
    urgent = [words for complaint, words in URGENT_COMPLAINTS.items() if complaint in named]
    if urgent:
        return Outcome("refer_today", f"See the doctor today: {' and '.join(urgent)}.")
    limit = programme.referral.vision_limit
    low_vision = [eye for eye in EYE_WORDS if _is_below(fields.get(f"vision_{eye.lower()}"), limit)]
    if low_vision:
        return Outcome("refer_vision", f"Refer: vision of {_eyes(low_vision)} below {limit}.")
    if fields.get("consent") == "declined":
        taken = any(slot.captures for slot in slots.values())
        kept = " to more. Those taken before are saved." if taken else " to pictures. None were taken."
        return Outcome("declined", f"The patient did not agree{kept}")
    if missing_phrases := _missing_pictures(programme, slots):
        return Outcome("refer_picture", f"Refer: {'; '.join(missing_phrases)}.")
    empty = sum(slot.required and slots[slot.id].state == "empty" for slot in programme.slots)
    missing = f", {empty} not taken" if empty else ""
    return Outcome("send", f"The pictures are saved{missing}. They are for an eye doctor.")


def _is_below(vision: FormValue, limit: Vision) -> bool:
    return vision is not None and VISIONS.index(cast(Vision, vision)) > VISIONS.index(limit)


def _missing_pictures(programme: Programme, slots: Mapping[str, SlotState]) -> list[str]:
    """Return a phrase for each group of eyes without any picture, or with a required picture that was not possible.

    Not possible: the slot has the state `not_possible`. A required slot that is only empty adds no phrase if the eye
    has another picture.
    """
    failed = {slot.eye for slot in programme.slots if slot.required and slots[slot.id].state == "not_possible"}
    seen = {slot.eye for slot in programme.slots if slots[slot.id].state == "taken"}
    phrases: tuple[tuple[str, list[Eye]], ...] = (
        ("picture of {} not possible", [eye for eye in programme.eyes if eye in failed and eye not in seen]),
        ("not every picture of {} possible", [eye for eye in programme.eyes if eye in failed and eye in seen]),
        ("picture of {} not taken", [eye for eye in programme.eyes if eye not in failed and eye not in seen]),
    )
    return [words.format(_eyes(eyes)) for words, eyes in phrases if eyes]


def _eyes(eyes: Sequence[str]) -> str:
    return f"the {EYE_WORDS[eyes[0]]} eye" if len(eyes) == 1 else "both eyes"
