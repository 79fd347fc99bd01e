"""JSON form of a visit in exports and uploads."""

from services.records.json_values import JsonValue
from services.records.visit import SlotState, Visit


def visit_as_json(visit: Visit) -> dict[str, JsonValue]:
    """Return a visit as a JSON object, with identifying fields; timestamps are ISO 8601."""
    finished = visit.finished_at
    ending = visit.outcome
    fields: dict[str, JsonValue] = {
        name: [*value] if isinstance(value, list) else value for name, value in visit.fields.items()
    }
    return {
        "id": visit.id,
        "number": visit.number,
        "begun_at": visit.begun_at.isoformat(),
        "day": visit.day,
        "fields": fields,
        "slots": {id: _shown_slot(slot) for id, slot in visit.slots.items()},
        "next_slot": visit.next_slot,
        "outcome": {"code": ending.code, "sentence": ending.sentence} if ending else None,
        "finished_at": finished.isoformat() if finished else None,
    }


def _shown_slot(slot: SlotState) -> dict[str, JsonValue]:
    chosen = slot.chosen
    verdict = chosen.verdict if chosen else None
    return {
        "state": slot.state,
        "capture": chosen.capture if chosen else None,
        "captures": [one.capture for one in slot.captures],
        "verdict": verdict.as_json() if verdict else None,
        "reason": slot.decision.reason if slot.decision else None,
        "tries": len(slot.captures),
    }
