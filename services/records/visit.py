"""Visit as an immutable value, and its rules: chosen capture of a slot, next empty slot, outcome."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, cast

from pydantic import BaseModel, ConfigDict

from device.values import EYES, ChannelUse, Eye
from services.records.capture import NO_METHOD, StoredVerdict
from services.records.json_values import FormValue
from services.records.programme import VISIONS, Programme, Slot, Vision

GREEN_ONLY = "colour.none"  # no other colour was asked for, or the head has none
URGENT_COMPLAINTS = frozenset({"sudden_loss", "pain"})
ReopenReason = Literal["answer", "picture", "mistake"]  # a wrong answer, a missing picture, finished by mistake
# consent withdrawn, erasure asked for, retention over, begun by mistake
EraseReason = Literal["withdrawn", "requested", "retention", "mistake"]
OutcomeCode = Literal["refer_today", "refer_vision", "refer_picture", "declined", "send"]
Urgency = Literal["today", "soon", "none"]
URGENCIES: Mapping[OutcomeCode, Urgency] = {
    "refer_today": "today",
    "refer_vision": "soon",
    "refer_picture": "soon",
    "declined": "none",
    "send": "none",
}
ReasonCode = Literal["complaint", "vision", "declined", "not_possible", "not_taken", "quality"]


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


class OutcomeReason(BaseModel):
    """One reason of an outcome: a code with its values, which the page and the letter translate.

    `complaint`: its name is `value`. `vision`: `value` of `eye` is below the limit. `declined`: no consent to pictures.
    `not_possible`, `not_taken`, `quality`: picture of `field` of `eye`; `value` is why it was not possible, or the code
    of its verdict. `not_taken` without a field: no picture of that eye.
    """

    model_config = ConfigDict(frozen=True)

    code: ReasonCode
    eye: Eye | None = None
    field: str | None = None
    value: str | None = None


class Outcome(BaseModel):
    """Outcome of a visit: code of its headline, urgency of the referral, all reasons, most urgent first."""

    model_config = ConfigDict(frozen=True)

    code: OutcomeCode
    urgency: Urgency
    reasons: tuple[OutcomeReason, ...] = ()


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
    """Return the outcome of a visit by the rules of the programme: all reasons, and the most urgent as headline.

    Order: urgent complaint (`refer_today`), vision below the programme's limit (`refer_vision`), no consent to pictures
    or every picture refused (`declined`, no referral), an eye without a picture or with a required one not possible
    (`refer_picture`), else `send`. A picture that the patient refused is a reason, and no referral.
    """
    reasons = (
        *_complaints(fields),
        *_low_visions(fields, programme.referral.vision_limit),
        *_pictures(programme, slots, has_consent=fields.get("consent") != "declined"),
    )
    code = _headline(programme, reasons, any(slot.chosen for slot in slots.values()))
    return Outcome(code=code, urgency=URGENCIES[code], reasons=reasons)


def _complaints(fields: Mapping[str, FormValue]) -> list[OutcomeReason]:
    complaints = fields.get("complaints")
    named = [name for name in complaints if name != "none"] if isinstance(complaints, list) else []
    named.sort(key=lambda name: name not in URGENT_COMPLAINTS)
    return [OutcomeReason(code="complaint", value=name) for name in named]


def _low_visions(fields: Mapping[str, FormValue], limit: Vision) -> list[OutcomeReason]:
    seen = [(eye, cast(Vision | None, fields.get(f"vision_{eye.lower()}"))) for eye in EYES]
    low = [(eye, vision) for eye, vision in seen if vision is not None and VISIONS.index(vision) > VISIONS.index(limit)]
    return [OutcomeReason(code="vision", eye=eye, value=vision) for eye, vision in low]


def _pictures(programme: Programme, slots: Mapping[str, SlotState], has_consent: bool) -> list[OutcomeReason]:
    """Return the reasons of pictures; without consent, of those which are not taken only that."""
    reasons = [] if has_consent else [OutcomeReason(code="declined")]
    states = {slot: slots[slot.id].state for slot in programme.slots}
    tried = {slot.eye for slot, state in states.items() if state == "taken" or (state != "empty" and slot.required)}
    for slot in programme.slots:
        if states[slot] != "empty":
            reasons += _of_slot(slot, slots[slot.id])
        elif has_consent and slot.required:
            untaken = OutcomeReason(code="not_taken", eye=slot.eye, field=slot.field if slot.eye in tried else None)
            reasons += [] if untaken in reasons else [untaken]
    return reasons


def _of_slot(slot: Slot, state: SlotState) -> list[OutcomeReason]:
    decision, chosen = state.decision, state.chosen
    if decision is not None and decision.reason is not None:
        return [OutcomeReason(code="not_possible", eye=slot.eye, field=slot.field, value=decision.reason)]
    if chosen is None or chosen.verdict is None or chosen.is_good:
        return []
    return [OutcomeReason(code="quality", eye=slot.eye, field=slot.field, value=chosen.verdict.code)]


def _headline(programme: Programme, reasons: Sequence[OutcomeReason], has_picture: bool) -> OutcomeCode:
    codes = {reason.code for reason in reasons}
    required = {(slot.eye, slot.field) for slot in programme.slots if slot.required}
    failed = [reason for reason in reasons if reason.code == "not_possible" and (reason.eye, reason.field) in required]
    if any(reason.value in URGENT_COMPLAINTS for reason in reasons if reason.code == "complaint"):
        return "refer_today"
    if "vision" in codes:
        return "refer_vision"
    if "declined" in codes:
        return "declined"
    has_unseen_eye = any(reason.code == "not_taken" and reason.field is None for reason in reasons)
    if has_unseen_eye or any(reason.value != "refused" for reason in failed):
        return "refer_picture"
    return "declined" if failed and not has_picture else "send"
