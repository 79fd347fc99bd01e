"""The stand-in's people: visits, their four slots, and what a press, a retake or a "could not" does to them."""

from datetime import UTC, datetime, timedelta
from typing import Any

SLOTS = [
    {"id": f"{side}-{field}", "eye": eye, "field": field, "required": True}
    for side, eye in (("R", "OD"), ("L", "OS"))
    for field in ("centre", "nerve")
]
PROTOCOL = {
    "slots": SLOTS,
    "reasons": ["lids", "pupil", "cloudy", "still", "refused", "device", "other"],
    "retakes": 2,
    "programme": {"vision_limit": "6/18", "prefix": "A", "centre_phone": "+91 44 5550 0142"},
}
SENTENCES = {
    "refer_today": "See the doctor today.",
    "refer_vision": "Refer: vision of the left eye below 6/18.",
    "refer_picture": "Refer: picture not possible.",
    "send": "The pictures are kept. They are for an eye specialist.",
}


def now() -> datetime:
    return datetime.now(UTC)


def empty_slot() -> dict[str, Any]:
    return {"state": "empty", "capture": None, "captures": [], "verdict": None, "reason": None, "tries": 0}


def unsent(visit: dict[str, Any], code: str | None = None, tries: int = 0) -> dict[str, Any]:
    """A visit as the outbox lists it; `code` says why it was not sent."""
    error = {"code": code, "message": "The receiver says no.", "remedy": "Call the technician."} if code else None
    return {
        "visit": visit["id"], "number": visit["number"], "since": now().isoformat(), "size_bytes": 8_200_000,
        "tries": tries, "failing_since": now().isoformat() if code else None, "error": error,
        "stuck": code not in (None, "send.link"),
    }  # fmt: skip


class Visits:
    """All the visits of the pretended shelf."""

    def __init__(self) -> None:
        self.kept: dict[str, dict[str, Any]] = {}
        self.keys: dict[str, dict[str, Any]] = {}

    def begin(self, number: str | None = None, **fields: Any) -> dict[str, Any]:
        count = len(self.kept) + 142
        visit = {
            "id": f"v{count}", "number": number or f"A{count:04d}", "begun_at": now().isoformat(),
            "day": now().date().isoformat(), "fields": dict(fields),
            "slots": {slot["id"]: empty_slot() for slot in SLOTS}, "next_slot": "R-centre",
            "outcome": None, "finished_at": None, "undo_until": None,
        }  # fmt: skip
        self.kept[visit["id"]] = visit
        return visit

    def seen(self, visit: dict[str, Any]) -> dict[str, Any]:
        """The visit with its next missing slot."""
        missing = [name for name, slot in visit["slots"].items() if slot["state"] == "empty"]
        return visit | {"next_slot": missing[0] if missing else None}

    def listed(self, day: str | None, still_open: bool, q: str) -> dict[str, Any]:
        every = [self.seen(visit) for visit in reversed(self.kept.values())]
        today = [v for v in every if v["day"] == (day or now().date().isoformat())]
        counts = {
            "done": sum(v["finished_at"] is not None for v in today),
            "to_finish": sum(v["finished_at"] is None for v in today),
            "referred": sum((v["outcome"] or {}).get("code", "").startswith("refer") for v in today),
        }
        chosen = [
            v
            for v in every
            if (not day or v["day"] == day) and (not still_open or v["finished_at"] is None) and q in v["number"]
        ]
        return {"visits": chosen, "counts": counts}

    def taken(self, visit: str, slot: str, capture: str, verdict: dict[str, Any]) -> None:
        """A kept picture: an accepted one stays in the slot, a better or a later one takes its place."""
        place = self.kept[visit]["slots"][slot]
        place["captures"].append(capture)
        place["tries"] += 1
        place |= {"state": "taken", "capture": capture, "verdict": verdict, "reason": None}

    def change(
        self, visit: dict[str, Any], what: str, wish: dict[str, Any], verdicts: dict[str, Any]
    ) -> dict[str, Any]:
        """What somebody decided: a slot, the end of the visit, or that it is not the end."""
        if what == "could-not":
            visit["slots"][wish["slot"]] |= {"state": "could_not", "reason": wish["reason"]}
        elif what == "slots" and wish["capture"] is None:
            visit["slots"][wish["slot"]] |= {"state": "empty", "capture": None, "verdict": None, "reason": None}
        elif what == "slots":
            slot, name = visit["slots"][wish["slot"]], wish["capture"]
            slot |= {"state": "taken", "capture": name, "verdict": verdicts[name]}
            slot["captures"] = [*{*slot["captures"], name}]
        elif what == "finish":
            self.finish(visit)
        elif what == "reopen":
            visit |= {"outcome": None, "finished_at": None, "undo_until": None}
        return self.seen(visit)

    def move(self, capture: dict[str, Any], eye: str) -> dict[str, Any]:
        """A picture goes to the same part of the other eye."""
        visit, name = self.kept[capture["visit"]], capture["id"]
        old = visit["slots"][capture["slot"]]
        old["captures"].remove(name)
        rest = old["captures"][-1] if old["captures"] else None
        old |= {"capture": rest, "state": "taken" if rest else "empty", "tries": len(old["captures"])}
        slot = capture["slot"].replace(*("R-", "L-") if eye == "OS" else ("L-", "R-"))
        capture |= {"eye": eye, "slot": slot}
        self.taken(visit["id"], slot, name, capture["verdict"])
        return self.seen(visit)

    def finish(self, visit: dict[str, Any]) -> None:
        urgent = {"sudden_loss", "pain"} & set(visit["fields"].get("complaints", []))
        taken = {name[0] for name, s in visit["slots"].items() if s["state"] == "taken"}
        poor = any(s["state"] == "could_not" for s in visit["slots"].values()) or (taken and len(taken) < 2)
        code = "refer_today" if urgent else "refer_picture" if poor else "send"
        visit["outcome"] = {"code": code, "sentence": SENTENCES[code]}
        visit["finished_at"] = now().isoformat()
        visit["undo_until"] = (now() + timedelta(hours=5)).isoformat()
