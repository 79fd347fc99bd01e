"""HTTP transcripts of every endpoint, good and refused, one per chapter, and the OpenAPI document."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from device.clock import boot_id
from services.delivery.upload_worker import BACKOFF_FIRST_S
from services.identity.setup_code import FILE
from services.identity.ssh_keys import fingerprint
from tests.golden import compare
from tests.golden.instrument import Refusing, instrument, until
from tests.golden.transcript import Transcript

Chapter = Callable[[], list[dict[str, Any]]]
UNKNOWN_CAPTURE, UNKNOWN_VISIT = "20260101T000000-OD-ffffff", "20260101T000000-ffffff"
RACING = ("error", "progress", "stand", "state", "steps")  # of the wizard, which measures in another thread
LENSES = "/api/calibration/trial-lenses"
ASHA, STANDS = {"name": "Asha", "secret": "274913"}, ("cap", "screen", "point")
CODE = "ABCDEFGH"
SSH_KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJcPFbe5hVKaLZ4yKkYbCzW1Sxd0hNnT0y0vN3hX4bQ me@laptop"
NO_USER: dict[str, Any] = {"note": "no user: sent through a proxy", "headers": {"X-Forwarded-For": "10.42.0.7"}}


def captures() -> list[dict[str, Any]]:
    """Record test pictures without a visit: press, list, files, live picture, events, a camera failure."""
    with instrument() as device:
        log = Transcript(device)
        log.ask("GET /api/status", note="before the first picture")
        press = log.key(eye="OD")
        made = log.ask("POST /api/captures", json=press)
        log.ask("POST /api/captures", json=press, note="the same key again: the same capture")
        log.ask("POST /api/captures", json=press | {"eye": "OS"}, note="the same key with another eye")
        log.ask("POST /api/captures", json={"eye": "left"})
        log.ask("POST /api/captures", json={"eye": "OD", "lamp": 1})
        log.ask("POST /api/captures", json={"eye": "OD", "slot": "R-centre"})
        log.ask("POST /api/captures", content=b"{half", headers={"Content-Type": "application/json"})
        log.ask("POST /api/captures", content=b" " * 20_000)
        log.ask("GET /api/captures")
        log.ask("GET /api/captures", f"/api/captures?before={made['id']}&limit=2")
        log.ask("GET /api/captures", "/api/captures?limit=0")
        log.ask("GET /api/captures", f"/api/captures?before={UNKNOWN_CAPTURE}")
        log.ask("GET /api/captures/{id}", f"/api/captures/{made['id']}")
        log.ask("GET /api/captures/{id}", f"/api/captures/{UNKNOWN_CAPTURE}")
        for name in ("picture.png", "colour.png", "raw.tiff", "raw-red.tiff", "dark.tiff", "report.json", "quick.jpg"):
            log.ask("GET /api/captures/{id}/{name}", f"/api/captures/{made['id']}/{name}")
        log.ask("GET /api/captures/{id}/{name}", f"/api/captures/{made['id']}/other.png")
        log.ask("GET /api/captures/{id}/{name}", f"/api/captures/{made['id']}/RAW.TIFF")
        log.events(
            lambda event: event["event"] == "state" and event["data"] == {"state": "aim"} and int(event["id"]) > 2, 0
        )
        log.ask("GET /api/events", headers={"Last-Event-ID": "yesterday"})
        log.ask_for_live("GET /api/preview", "/api/preview?after=0&eye=OD")
        log.ask("GET /api/preview", "/api/preview?after=-1")
        log.ask("GET /api/preview", "/api/preview?eye=left")
        log.ask("GET /api/preview", headers={"Sec-Fetch-Site": "cross-site"})
        _failures(log, made["id"])
        return log.exchanges


def _failures(log: Transcript, id: str) -> None:
    """Record press, status and checks after a camera failure and after damage to a file."""
    until(lambda: bool(log.instrument.owner.findings))
    log.ask("GET /api/health")
    (camera,) = log.instrument.cameras
    camera.broken = True
    log.ask("POST /api/captures", json={"eye": "OD"}, note="the camera was unplugged")
    camera.broken = False
    (log.instrument.store.folder / "captures" / id / "picture.png").write_bytes(b"not what was stored")
    log.ask("GET /api/captures/{id}/{name}", f"/api/captures/{id}/picture.png", note="the file was changed on the disk")


def visits() -> list[dict[str, Any]]:
    """Record a visit from number to outcome, the control lease, and every refusal of both."""
    with instrument() as device:
        log = Transcript(device)
        log.ask("GET /api/programme")
        begin = log.key()
        visit = log.ask("POST /api/visits", json=begin)
        log.ask("POST /api/visits", json=begin, note="the same key again: the same visit")
        log.ask("POST /api/visits", json=log.key(number="A00010"), note="a wrong check digit")
        log.ask("POST /api/visits", json={"key": "short"})
        at = f"/api/visits/{visit['id']}"
        press = {"eye": "OD", "visit": visit["id"], "slot": "R-centre"}
        log.ask("POST /api/captures", json=log.key(**press), note="no consent is recorded")
        log.ask("GET /api/preview", f"/api/preview?visit={visit['id']}", note="no consent is recorded")
        _answers(log, at)
        first = log.ask("POST /api/captures", json=log.key(**press))
        second = log.ask("POST /api/captures", json=log.key(**press), note="a retake")
        log.ask("POST /api/captures", json=log.key(**press | {"eye": "OS"}), note="the slot is of the other eye")
        log.ask("POST /api/captures", json=log.key(**press | {"slot": "nose"}))
        log.ask_for_live("GET /api/preview", f"/api/preview?eye=OD&visit={visit['id']}")
        _slots(log, at, first["id"], second["id"])
        _listing(log, visit)
        _ends(log, at, visit["id"])
        _controllers(log)
        return log.exchanges


def _answers(log: Transcript, at: str) -> None:
    fields = {
        "name": "Meena K.",
        "village": "Nowhere",
        "phone": "12345",
        "age": 54,
        "sex": "woman",
        "vision_od": "6/12",
    }
    answer = "PATCH /api/visits/{id}"
    for name, value in fields.items():
        log.ask(answer, at, json=log.key(field=name, value=value))
    log.ask(answer, at, json=log.key(field="consent", value="declined"))
    log.ask("GET /api/preview", f"/api/preview?visit={at.rsplit('/', 1)[1]}", note="consent was declined")
    log.ask(answer, at, json=log.key(field="consent", value="agreed"))
    log.ask(answer, at, json=log.key(field="phone", value=None), note="an answer is taken back")
    log.ask(answer, at, json=log.key(field="age", value=-1))
    log.ask(answer, at, json=log.key(field="shoe size", value=42))
    log.ask(answer, f"/api/visits/{UNKNOWN_VISIT}", json=log.key(field="age", value=1))


def _slots(log: Transcript, at: str, first: str, second: str) -> None:
    """Record the capture chosen for a slot, its eye, and the reason for a missing picture."""
    log.ask("POST /api/captures/{id}/accept", f"/api/captures/{first}/accept", json=log.key())
    log.ask("POST /api/captures/{id}/accept", f"/api/captures/{UNKNOWN_CAPTURE}/accept", json=log.key())
    log.ask("POST /api/visits/{id}/slots", f"{at}/slots", json=log.key(slot="R-centre", capture=None))
    log.ask("POST /api/visits/{id}/slots", f"{at}/slots", json=log.key(slot="R-centre", capture=second))
    log.ask("POST /api/visits/{id}/slots", f"{at}/slots", json=log.key(slot="R-centre", capture=UNKNOWN_CAPTURE))
    log.ask("POST /api/captures/{id}/eye", f"/api/captures/{first}/eye", json=log.key(eye="OS"))
    log.ask("POST /api/captures/{id}/eye", f"/api/captures/{first}/eye", json=log.key(eye="left"))
    log.ask("POST /api/captures/{id}/eye", f"/api/captures/{UNKNOWN_CAPTURE}/eye", json=log.key(eye="OS"))
    log.ask("POST /api/visits/{id}/not-possible", f"{at}/not-possible", json=log.key(slot="L-nerve", reason="lids"))
    log.ask("POST /api/visits/{id}/not-possible", f"{at}/not-possible", json=log.key(slot="L-nerve", reason="boredom"))


def _listing(log: Transcript, visit: dict[str, Any]) -> None:
    log.ask("GET /api/visits")
    log.ask("GET /api/visits", f"/api/visits?day={visit['day']}&open=true&q={visit['number']}&limit=1")
    log.ask("GET /api/visits", "/api/visits?day=yesterday")
    log.ask("GET /api/visits", "/api/visits?q=%25")
    log.ask("GET /api/visits/{id}", f"/api/visits/{visit['id']}")
    log.ask("GET /api/visits/{id}", f"/api/visits/{UNKNOWN_VISIT}")


def _ends(log: Transcript, at: str, id: str) -> None:
    """Record the finish of a visit, the refusals of a finished visit, and the undo until the end of the day."""
    finish, reopen = "POST /api/visits/{id}/finish", "POST /api/visits/{id}/reopen"
    order = log.key()
    log.ask(finish, f"{at}/finish", json=order)
    log.ask(finish, f"{at}/finish", json=order, note="the same key again")
    log.ask(finish, f"/api/visits/{UNKNOWN_VISIT}/finish", json=log.key())
    log.ask("PATCH /api/visits/{id}", at, json=log.key(field="age", value=55), note="the visit is finished")
    log.ask("POST /api/captures", json=log.key(eye="OD", visit=id, slot="R-centre"), note="the visit is finished")
    log.ask(reopen, f"{at}/reopen", json=log.key(), note="without a reason")
    log.ask(reopen, f"{at}/reopen", json=log.key(reason="answer"))
    log.ask("GET /api/visits/{id}/changes", f"{at}/changes")
    log.ask("GET /api/visits/{id}/changes", f"/api/visits/{UNKNOWN_VISIT}/changes")
    log.ask(finish, f"{at}/finish", json=log.key())
    log.instrument.clock.elapsed_s += 3 * 86400
    log.ask(reopen, f"{at}/reopen", json=log.key(reason="answer"), note="three days later")


def _controllers(log: Transcript) -> None:
    """Record the control lease between two screens."""
    mine, other = {"key": "00000000000000aa"}, {"key": "00000000000000bb"}
    log.ask("POST /api/controller", json=mine)
    log.ask("POST /api/controller", json=other, note="another screen holds it")
    log.ask("POST /api/visits", json=log.key(), headers={"X-Controller": other["key"]})
    log.ask("POST /api/controller", json=other | {"take": True})
    log.ask("POST /api/controller", json=other | {"release": True})
    log.ask("POST /api/controller", json={"take": True})


def exports() -> list[dict[str, Any]]:
    """Record the exports of a visit: a ZIP file, a copy on a USB drive, and the event log."""
    with instrument() as device:
        log = Transcript(device)
        visit = _finished_visit(log)
        log.exchanges.clear()
        log.ask("GET /api/exports")
        log.ask("GET /api/visits/{id}/export.zip", f"/api/visits/{visit}/export.zip")
        log.ask("GET /api/visits/{id}/export.zip", f"/api/visits/{UNKNOWN_VISIT}/export.zip")
        copy, at = "POST /api/visits/{id}/export", f"/api/visits/{visit}/export"
        order = log.key(folder=device.stick_id)
        log.ask(copy, at, json=order)
        log.ask(copy, at, json=order, note="the same key again: no second copy")
        log.ask(copy, at, json=log.key(folder=device.stick_id), note="a second copy")
        log.ask(copy, at, json=log.key(folder="/etc"))
        log.ask(copy, f"/api/visits/{UNKNOWN_VISIT}/export", json=log.key(folder=device.stick_id))
        _event_log(log)
        _backups(log)
        _montages(log)
        return log.exchanges


def _montages(log: Transcript) -> None:
    """Record the montage of two fields of view of one eye, and of an eye without pictures."""
    send, montage = log.instrument.send, "GET /api/visits/{id}/montage/{eye}"
    picture, visit = f"{montage}/picture.png", send("POST", "/api/visits", json=log.key()).json()["id"]
    at = f"/api/visits/{visit}"
    send("PATCH", at, json=log.key(field="consent", value="agreed"))
    for slot in ("L-centre", "L-nerve"):
        assert send("POST", "/api/captures", json=log.key(eye="OS", visit=visit, slot=slot)).status_code == 201
    log.ask(montage, f"{at}/montage/OD", note="no picture of this eye")
    log.ask(picture, f"{at}/montage/OD/picture.png")
    until(lambda: send("GET", f"{at}/montage/OS").json()["state"] != "computing")
    log.ask(montage, f"{at}/montage/OS")
    log.ask(picture, f"{at}/montage/OS/picture.png", racing=("size",), note="its size follows the measured shift")
    log.ask(montage, f"/api/visits/{UNKNOWN_VISIT}/montage/OS")
    log.ask(montage, f"{at}/montage/left")


def _backups(log: Transcript) -> None:
    """Record a backup; the technician is logged in."""
    at, passphrase = "/api/technician/backup", "POST /api/technician/backup/passphrase"
    log.ask(f"GET {at}")
    log.ask(passphrase, json={"passphrase": "short"})
    log.ask(passphrase, json={"passphrase": "four plain words here"})
    log.ask(f"POST {at}", json={"folder": "/etc"})
    log.ask(f"POST {at}", json={"folder": log.instrument.stick_id})
    removal = "/api/technician/removal"
    for operation in (f"GET {removal}", f"POST {removal}", f"POST {removal}/undo"):
        log.ask(operation)
    log.ask(f"GET {at}", **NO_USER)
    for operation in (f"GET {removal}", f"POST {removal}", f"POST {removal}/undo"):
        log.ask(operation, **NO_USER)


def _event_log(log: Transcript) -> None:
    paths = ("/api/technician/event-log", "/api/technician/event-log.txt")
    for path in paths:
        log.ask(f"GET {path}", **NO_USER)
    export = "POST /api/technician/event-log/export"
    log.ask(export, json={"folder": log.instrument.stick_id}, **NO_USER)
    for path in paths:
        log.ask(f"GET {path}")
    log.ask("GET /api/technician/event-log", "/api/technician/event-log?limit=0")
    log.ask(export, json={"folder": log.instrument.stick_id})
    log.ask(export, json={"folder": "/etc"})


def _finished_visit(log: Transcript) -> str:
    visit: str = log.ask("POST /api/visits", json=log.key())["id"]
    at = f"/api/visits/{visit}"
    for name, value in {"consent": "agreed", "name": "Meena K.", "age": 54}.items():
        log.ask("PATCH /api/visits/{id}", at, json=log.key(field=name, value=value))
    log.ask("POST /api/captures", json=log.key(eye="OD", visit=visit, slot="R-centre"))
    log.ask("POST /api/visits/{id}/finish", f"{at}/finish", json=log.key())
    return visit


def access() -> list[dict[str, Any]]:
    """Record the set-up, wrong attempts with their lock-out, the users, signing out, and the idle lock."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        (device.folder / "access").mkdir()
        (device.folder / "access" / FILE).write_text(f"{CODE} {boot_id()} inf")  # otherwise a random one
        log.ask("GET /api/login", note="the demonstration user")
        log.ask("POST /api/login", json=ASHA, note="no user exists yet")
        log.ask("POST /api/setup", json=ASHA | {"code": "AAAAAAAA"})
        device.clock.elapsed_s += 2
        log.ask("POST /api/setup", json=ASHA | {"code": CODE, "secret": "123456"})
        log.ask("POST /api/setup", json=ASHA | {"code": CODE})
        log.ask("GET /api/login")
        _users(log)
        log.ask("GET /api/audit", "/api/audit?action=sign-in&limit=2")
        _clock(log)
        _ssh_keys(log)
        _erasure(log)
        log.ask("POST /api/login/activity")
        log.ask("POST /api/login/confirm", json={"secret": "000000"})
        device.clock.elapsed_s += 2
        log.ask("POST /api/login/confirm", json={"secret": ASHA["secret"]})
        log.ask("PUT /api/login/secret", json={"secret": ASHA["secret"], "new": "111111"})
        log.ask("PUT /api/login/secret", json={"secret": ASHA["secret"], "new": "918274"})
        log.ask("DELETE /api/login")
        for operation in (
            "GET /api/visits",
            "GET /api/users",
            "GET /api/audit",
            "GET /api/ssh-keys",
            "POST /api/login/activity",
            "GET /api/preview",
        ):
            log.ask(operation, note="no user is signed in")
        log.ask("POST /api/login", json=ASHA, note="the PIN before the change")
        log.ask("POST /api/login", json=ASHA | {"secret": "918274"}, note="too soon after a wrong PIN")
        device.clock.elapsed_s += 2
        log.ask("POST /api/login", json=ASHA | {"secret": "918274"})
        device.clock.elapsed_s += 400
        log.ask("GET /api/login", note="after the idle lock")
        return log.exchanges


def _clock(log: Transcript) -> None:
    """Record the acceptance of a tablet's time, at a device that has one and at a device that has none."""
    later, earlier = {"now": "2027-01-01T12:00:00+05:30"}, {"now": "2026-01-01T05:30:00+05:30"}
    log.ask("POST /api/clock", json=log.key(**later), note="nothing sets the clock")
    log.ask("POST /api/clock/back", json=log.key(**earlier), note="nothing sets the clock")
    (log.instrument.folder / "system/run/diffuscope-clock").mkdir(parents=True)
    log.ask("POST /api/clock", json=log.key(**earlier), note="before the time of the device")
    log.ask("POST /api/clock", json=log.key(**later))
    log.ask("POST /api/clock/back", json=log.key(**earlier))


def _ssh_keys(log: Transcript) -> None:
    """Record the decision on a key of the card, at a device without a button by its own screen."""
    file = log.instrument.folder / "system/run/diffuscope-settings/ssh-keys.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps([SSH_KEY]))
    log.ask("GET /api/ssh-keys")
    log.ask("POST /api/ssh-keys", json={"fingerprint": "SHA256:other", "confirmed": True})
    log.ask("POST /api/ssh-keys", json={"fingerprint": fingerprint(SSH_KEY), "confirmed": True})


def _erasure(log: Transcript) -> None:
    """Record the erasure of a patient by an administrator."""
    log.ask("POST /api/visits", json=log.key(number="X1"))
    log.ask("GET /api/patients", "/api/patients?number=X2")
    log.ask("GET /api/patients", "/api/patients?number=X1")
    log.ask("POST /api/patients/erase", json={"number": "X2", "reason": "requested"})
    log.ask("POST /api/patients/erase", json={"number": "X1", "reason": "requested"})
    log.ask("GET /api/patients", "/api/patients?number=X1", note="erased")


def _users(log: Transcript) -> None:
    """Record the changes of users by an administrator."""
    ravi = {"name": "Ravi", "secret": "274913", "roles": ["reader"]}
    log.ask("GET /api/users")
    log.ask("POST /api/users", json=ravi)
    log.ask("POST /api/users", json=ravi, note="the name is used")
    log.ask("PATCH /api/users/{name}", "/api/users/Ravi", json={"roles": ["screener", "reader"]})
    log.ask("PATCH /api/users/{name}", "/api/users/Eve", json={"roles": ["screener"]})
    log.ask("DELETE /api/users/{name}", "/api/users/Asha", note="the last administrator")
    log.ask("DELETE /api/users/{name}", "/api/users/Ravi")


def calibration() -> list[dict[str, Any]]:
    """Record two calibrations of a new head: each step, a fault, a stop, and the return to the first."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        log.ask("GET /api/status", note="without a calibration")
        log.ask("POST /api/captures", json={"eye": "OD"}, note="without a calibration")
        locked = {"": {"by": "Eve"}, "/ready": {"stand": "cap"}, "/cancel": {}, "/use": {"id": "0" * 16}}
        for path, body in locked.items():
            log.ask(f"POST /api/calibration{path}", json=body, **NO_USER)
        for path, body in {"": {}, "/ready": {"lens": 0}}.items():
            log.ask(f"POST {LENSES}{path}", json=body, **NO_USER)
        for path in ("", "/preview"):
            log.ask(f"GET /api/calibration{path}", **NO_USER)
        log.ask("GET /api/calibration")
        log.ask("GET /api/calibration/preview", note="nothing is being calibrated")
        log.ask("GET /api/calibration/preview", "/api/calibration/preview?after=-1")
        log.ask("POST /api/calibration", json={"by": ""})
        log.ask(f"POST {LENSES}", json={}, note="without a calibration")
        made = _calibrated(log)
        use = "POST /api/calibration/use"
        log.ask(use, json={"id": made}, racing=("state",))
        log.ask(use, json={"id": "0" * 16})
        log.ask(use, json={"id": "../data"})
        _stopped(log)
        _trial_lenses(log)
        return log.exchanges


def _trial_lenses(log: Transcript) -> None:
    """Record the start of a run with trial lenses, its refusals, the first lens, and a stop."""
    _settled(log, "idle")
    log.ask(f"POST {LENSES}/ready", json={"lens": 0}, note="no lenses are being measured")
    log.ask(f"POST {LENSES}", json={"vertex_mm": 40})
    log.ask(f"POST {LENSES}", json={}, racing=("lenses",))
    until(lambda: log.instrument.send("GET", "/api/calibration").json()["lenses"]["state"] == "asking")
    log.ask("GET /api/calibration", note="the first lens is asked for")
    log.ask(f"POST {LENSES}/ready", json={"lens": 1}, note="another lens is asked for")
    log.ask("POST /api/calibration/ready", json={"stand": "cap"}, note="trial lenses are under way")
    log.ask(f"POST {LENSES}/ready", json={"lens": 0}, racing=("lenses",))
    log.ask("POST /api/calibration/cancel", racing=("lenses", "state"))


def _calibrated(log: Transcript) -> str:
    """Measure every step, the first one twice because the lamp is on the first time; return the id of the result."""
    ready = "POST /api/calibration/ready"
    _settled(log, "begin")
    log.ask("POST /api/calibration", json={"by": "Ada"}, racing=RACING)
    _settled(log, "asking")
    log.ask(ready, json={"stand": "point"}, note="another step is under way")
    log.ask("POST /api/calibration", json={"by": "Bob"}, note="another calibration is under way")
    log.ask(ready, json={"stand": "cap", "mishap": "lamp on"}, racing=RACING)
    _settled(log, "asking", failed=True)
    log.ask("GET /api/calibration", note="the step failed, and is asked for again", racing=("progress",))
    log.ask_for_live("GET /api/calibration/preview")
    for stand in STANDS:
        _settled(log, "asking", stand=stand)
        assert log.instrument.send("POST", "/api/calibration/ready", json={"stand": stand}).status_code == 200
    _settled(log, "idle")
    log.ask("GET /api/calibration", note="measured and in force")
    made: str = log.instrument.send("GET", "/api/calibration").json()["made"]["id"]
    return made


def _stopped(log: Transcript) -> None:
    _settled(log, "idle")
    log.ask("POST /api/calibration/ready", json={"stand": "cap"}, note="nothing is being calibrated")
    log.ask("POST /api/calibration", json={"by": "Ada"}, racing=RACING)
    _settled(log, "asking")
    log.ask("POST /api/captures", json={"eye": "OD"}, note="the technician has the head")
    log.ask("POST /api/calibration/ready", json={"stand": "cap", "mishap": "earthquake"})
    log.ask("GET /api/status", note="the technician has the head")
    log.ask("GET /api/health", note="the technician has the head")
    log.ask("POST /api/calibration/cancel", racing=("state",))


def _settled(log: Transcript, state: str, stand: str | None = None, failed: bool = False) -> None:
    """Wait, in real time, until the head's thread is in this state."""

    def is_there() -> bool:
        now = log.instrument.send("GET", "/api/calibration").json()
        return now["state"] == state and stand in (None, now["stand"]) and (now["error"] is not None or not failed)

    until(is_there)


def updates() -> list[dict[str, Any]]:
    """Record an update from a USB drive and one from a tablet, with the updater and its stand-in for RAUC."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        for call, body in {"GET ": None, "POST /check": None, "POST /restart": None}.items():
            method, path = call.split(" ")
            log.ask(
                f"{method} /api/update{path}",
                **NO_USER,
                **({} if body is None else {"json": body}),
            )
        log.ask("POST /api/update/install", json={"id": "0" * 16}, **NO_USER)
        log.ask("PUT /api/update/file", content=b"x", **NO_USER)
        log.ask("GET /api/update")
        device.board.bundle("two.raucb", padding_bytes=1000)
        device.board.bundle("foreign.raucb", signer="a stranger", padding_bytes=1000)
        log.ask("POST /api/update/check")
        log.ask("POST /api/update/restart", note="another request waits")
        device.board.updater("1.0").answer()
        found = log.ask("GET /api/update", note="what was found")["found"]
        log.ask("POST /api/update/install", json={"id": "two"})
        (two,) = [bundle["id"] for bundle in found if bundle["name"] == "two.raucb"]
        log.ask("POST /api/update/install", json={"id": two})
        log.ask("POST /api/update/check", note="another request waits")
        device.board.updater("1.0", restart=("true",)).answer()
        log.ask("GET /api/update", note="installed, and restarting")
        log.ask("PUT /api/update/file", content=b"whole", note="while it restarts")
        return log.exchanges


def tablets() -> list[dict[str, Any]]:
    """Record uploads from a tablet, an installed update that is tried later, and a computer without an updater."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        log.ask("PUT /api/update/file", content=b"no bundle")
        log.ask("PUT /api/update/file", content=b"", headers={"Content-Length": "0"})
        log.ask("PUT /api/update/file", content=b"half", headers={"Content-Length": "8"})
        log.ask("POST /api/update/check", content=b"x" * 20_000)
        bundle = device.board.bundle("two.raucb", padding_bytes=1000)
        device.board.updater("1.0").install(bundle, restart=False)
        log.ask("GET /api/update", note="installed, and not tried yet")
        log.ask("POST /api/update/restart")
        for folder in (device.board.requests, device.board.state):
            folder.rename(folder.with_name(f"{folder.name}.gone"))
        log.ask("GET /api/update", note="no updater")
        log.ask("POST /api/update/restart", note="no updater")
        return log.exchanges


def uploads() -> list[dict[str, Any]]:
    """Record the upload queue: not set up, a waiting visit, a refused one, and a delivered one."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        log.ask("GET /api/upload-queue", note="no receiver is set up")
        log.ask("POST /api/upload-queue/retry", json=log.key(), note="no receiver is set up")
        first = log.exchanges
    receiver = Refusing()
    with instrument(carrier=receiver) as device:
        log = Transcript(device)
        _finished_visit(log)
        log.exchanges.clear()
        device.clock.elapsed_s += BACKOFF_FIRST_S
        log.ask("GET /api/upload-queue", note="one visit waits")
        sender = device.application.upload_worker
        assert sender is not None
        assert sender.step()
        log.ask("GET /api/upload-queue", note="the receiver refused it")
        log.ask("GET /api/status", note="the receiver refused it")
        log.ask("POST /api/upload-queue/retry", json=log.key(visit="no such/visit"))
        log.ask("POST /api/upload-queue/retry", json=log.key())
        receiver.refuses = False
        assert sender.step()
        log.ask("GET /api/upload-queue", note="it arrived")
        return first + log.exchanges


def accuracy() -> list[dict[str, Any]]:
    """Record accuracy against time: measurement, choice, and a capture reconstructed by another method."""
    with instrument() as device:
        log = Transcript(device)
        made = log.ask("POST /api/captures", json={"eye": "OD"})["id"]
        log.exchanges.clear()
        again, at = "GET /api/technician/captures/{id}/again.png", f"/api/technician/captures/{made}/again.png"
        log.ask("GET /api/technician/accuracy", **NO_USER)
        log.ask("POST /api/technician/accuracy", **NO_USER)
        log.ask("PUT /api/technician/pace", json={"pace": "quick"}, **NO_USER)
        log.ask(again, f"{at}?method=gradient", **NO_USER)
        log.ask("GET /api/technician/accuracy")
        log.ask("GET /api/technician/accuracy.svg", note="nothing is measured")
        log.ask("PUT /api/technician/pace", json={"pace": "quick"})
        log.ask("PUT /api/technician/pace", json={"pace": "never"})
        log.ask(again, f"{at}?method=gradient&bin=2&rounds=3")
        log.ask(again, f"{at}?method=guess")
        log.ask(again, f"{at}?method=gradient&bin=17")
        log.ask(again, f"/api/technician/captures/{UNKNOWN_CAPTURE}/again.png?method=gradient")
        log.ask("POST /api/technician/accuracy", note="a measurement begins")
        log.ask("POST /api/technician/accuracy", note="a measurement is under way")
        until(lambda: not device.explorer.state().busy)
        log.ask("GET /api/technician/accuracy", note="measured")
        log.ask("GET /api/technician/accuracy.svg", note="measured")
        return log.exchanges


def security() -> list[dict[str, Any]]:
    """Record host, origin, method and path checks and the pages; then every operation with a foreign host name."""
    with instrument(calibrated_before=False) as device:
        log = Transcript(device)
        foreign, json_type = {"Host": "evil.example"}, {"Content-Type": "application/json"}
        log.ask("GET /", note="the page")
        log.ask("GET /technician", note="the page of the technician")
        log.ask("GET /web/nowhere.js")
        log.ask("GET /api/nowhere")
        log.ask("DELETE /api/captures")
        log.ask("POST /api/visits", json=log.key(), headers={"Origin": "http://evil.example"})
        log.ask("POST /api/visits", json=log.key(), headers={"Origin": "http://eye.local"})
        log.ask("POST /api/visits", content=b"{}", headers=json_type | {"Content-Length": "-1"})
        for operation in operations(device.app.openapi()):
            path = operation.split(" ")[1].format(id="x", name="x.png", eye="OD")
            log.ask(operation, path, note="a foreign host name", headers=foreign)
        return log.exchanges


CHAPTERS: dict[str, Chapter] = {
    chapter.__name__: chapter
    for chapter in (captures, visits, exports, access, calibration, updates, tablets, uploads, accuracy, security)
}


def openapi() -> dict[str, Any]:
    """Return the OpenAPI document of the application, with its version number replaced."""
    with instrument(calibrated_before=False) as device:
        document: dict[str, Any] = device.send("GET", "/api/openapi.json").json()
    return document | {"info": document["info"] | {"version": "<version>"}}


def operations(document: dict[str, Any]) -> list[str]:
    """Return every operation of an OpenAPI document as `METHOD /path`."""
    return [f"{method.upper()} {path}" for path, methods in document["paths"].items() for method in methods]


def write() -> Path:
    """Write the OpenAPI document and the transcript of every chapter."""
    compare.write("openapi", openapi())
    for name, chapter in CHAPTERS.items():
        compare.write(f"http-{name}", chapter())
    return compare.RECORDS
