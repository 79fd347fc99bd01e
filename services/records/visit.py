"""A visit as a value, and its rules: which picture stands for a slot, what comes next, how it ends."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, cast

from device.values import Eye
from services.records.protocol import VISIONS, Protocol, Vision

SIDE = {"OD": "right", "OS": "left"}
URGENT = {"sudden_loss": "sudden loss of vision", "pain": "pain"}
OutcomeCode = Literal["refer_today", "refer_vision", "refer_picture", "send"]


@dataclass(frozen=True)
class Taken:
    """One capture of a slot, and what was thought of it when it was made (None: nothing)."""

    capture: str
    verdict: dict[str, Any] | None

    @property
    def good(self) -> bool:
        """Whether it was called good."""
        return self.verdict is not None and self.verdict.get("word") == "good"


@dataclass(frozen=True)
class Decided:
    """What somebody decided about a slot: this capture, could not for a reason, or neither: empty again."""

    capture: str | None = None
    reason: str | None = None


@dataclass(frozen=True)
class SlotState:
    """One slot of a visit: everything that was taken, oldest first, and the one that stands for it."""

    taken: tuple[Taken, ...] = ()
    decided: Decided | None = None

    @property
    def state(self) -> Literal["empty", "taken", "could_not"]:
        """Where it stands."""
        if self.decided is not None and self.decided.reason is not None:
            return "could_not"
        return "empty" if self.chosen is None else "taken"

    @property
    def chosen(self) -> Taken | None:
        """What somebody chose; else the newest good one, or the newest of all."""
        if self.decided is not None:
            return next((one for one in self.taken if one.capture == self.decided.capture), None)
        return max(enumerate(self.taken), key=lambda one: (one[1].good, one[0]), default=(0, None))[1]


@dataclass(frozen=True)
class Outcome:
    """How a visit ends: a code for the log, and one sentence for the person in charge."""

    code: OutcomeCode
    sentence: str


@dataclass(frozen=True)
class Visit:
    """One visit of one person, with all that is known of it; moments are in UTC, `day` is the place's own."""

    id: str
    number: str
    day: str
    begun_at: datetime
    fields: Mapping[str, Any]
    slots: Mapping[str, SlotState]
    finished_at: datetime | None = None
    outcome: Outcome | None = None

    @property
    def next_slot(self) -> str | None:
        """The first slot of which there is neither a picture nor a reason."""
        return next((id for id, slot in self.slots.items() if slot.state == "empty"), None)


def decided_after(slot: SlotState, new: Taken) -> Decided | None:
    """What stays of a decision when the slot gets a new capture.

    A better picture is worth more than an earlier choice; a picture ends a "could not"; where the slot had been
    emptied, the new one stands alone.
    """
    before = slot.decided
    if before is None or before.reason is not None:
        return None
    if before.capture is None:
        return Decided(new.capture)
    chosen = slot.chosen
    return None if new.good and not (chosen and chosen.good) else before


def outcome(protocol: Protocol, fields: Mapping[str, Any], slots: Mapping[str, SlotState]) -> Outcome:
    """How a visit ends by the programme's rules, the most urgent first; never a disease, never "normal"."""
    urgent = [words for complaint, words in URGENT.items() if complaint in (fields.get("complaints") or ())]
    if urgent:
        return Outcome("refer_today", f"See the doctor today: {' and '.join(urgent)}.")
    limit = protocol.programme.vision_limit
    weak = [eye for eye in SIDE if _sees_less(fields.get(f"vision_{eye.lower()}"), limit)]
    if weak:
        return Outcome("refer_vision", f"Refer: vision of {_eyes(weak)} below {limit}.")
    if lacking := _lacking(protocol, slots):
        return Outcome("refer_picture", f"Refer: {'; '.join(lacking)}.")
    empty = sum(slot.required and slots[slot.id].state == "empty" for slot in protocol.slots)
    missing = f", {empty} not taken" if empty else ""
    return Outcome("send", f"The pictures are kept{missing}. They are for an eye specialist.")


def _sees_less(vision: Any, limit: Vision) -> bool:
    return vision is not None and VISIONS.index(cast(Vision, vision)) > VISIONS.index(limit)


def _lacking(protocol: Protocol, slots: Mapping[str, SlotState]) -> list[str]:
    """What is said of eyes without a picture, or without a required one; what nobody tried was not impossible."""
    failed = {slot.eye for slot in protocol.slots if slot.required and slots[slot.id].state == "could_not"}
    seen = {slot.eye for slot in protocol.slots if slots[slot.id].state == "taken"}
    said: tuple[tuple[str, list[Eye]], ...] = (
        ("picture of {} not possible", [eye for eye in protocol.eyes if eye in failed and eye not in seen]),
        ("not every picture of {} possible", [eye for eye in protocol.eyes if eye in failed and eye in seen]),
        ("picture of {} not taken", [eye for eye in protocol.eyes if eye not in failed and eye not in seen]),
    )
    return [words.format(_eyes(eyes)) for words, eyes in said if eyes]


def _eyes(eyes: Sequence[str]) -> str:
    return f"the {SIDE[eyes[0]]} eye" if len(eyes) == 1 else "both eyes"
