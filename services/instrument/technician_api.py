"""The technician's addresses: the door with its PIN, and the calibration wizard behind it."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Cookie, Depends, FastAPI, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from device.calibration.archive import Archive, Kept
from device.errors import Busy, CalibrationError, DiffuscopeError, HeadMismatch
from device.head import kind_of
from device.sim.mishaps import MISHAPS
from services.instrument.calibrating import WORK, Wish
from services.instrument.owner import Owner
from services.instrument.technician import IDLE_S, Door
from services.instrument.wizard import STANDS

COOKIE = "technician"
LISTED = 8  # earlier calibrations that the page offers
STEP_FILES = {"cap": "darks.npz", "screen": "flats.npz", "point": "point.npz"}

Token = Annotated[str | None, Cookie(alias=COOKIE)]


class Body(BaseModel):
    """What a button sends: nothing else than it may."""

    model_config = ConfigDict(extra="forbid")


class Pin(Body):
    """A PIN, as it was typed."""

    pin: str = Field(max_length=40)


class Start(Body):
    """Who calibrates which head, through which source."""

    by: str = Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    serial: str | None = Field(default=None, min_length=1, max_length=60, pattern=r"^[^\x00-\x1f]*\S[^\x00-\x1f]*$")
    source_deg: float | None = Field(default=None, ge=0, le=5)


class Ready(Body):
    """What stands before the head now; on a simulated head also what goes wrong with it."""

    stand: str = Field(max_length=40)
    mishap: str | None = Field(default=None, max_length=40)


class Use(Body):
    """The calibration to go back to."""

    id: str = Field(pattern="^[0-9a-f]{16}$")


def technician_routes(app: FastAPI, owner: Owner, door: Door, rooms: Sequence[APIRouter] = ()) -> None:
    """Put the technician's addresses on the application, and `rooms` behind the same door."""

    def inside(token: Token = None) -> None:
        door.refuse_strangers(token)

    def acting(token: Token = None) -> None:
        door.touch(token)

    app.include_router(_door(door, Depends(acting)))
    app.include_router(_sights(owner, Depends(inside)))
    app.include_router(_acts(owner, Depends(acting)))
    for room in rooms:
        app.include_router(room, dependencies=[Depends(inside)])


def _door(door: Door, acting: Any) -> APIRouter:
    router = APIRouter(prefix="/api/technician")

    def answer(response: Response, token: str) -> dict[str, Any]:
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/api")
        return {"open": True}

    @router.get("")
    def door_state(token: Token = None) -> dict[str, Any]:
        """Whether it is open for who asks, whether a PIN was ever set, and how long the next try has to wait."""
        return {"open": door.knows(token), "has_pin": door.has_pin, "wait_s": round(door.wait_s, 1), "idle_s": IDLE_S}

    @router.post("/pin")
    def set_pin(pin: Pin, response: Response, token: Token = None) -> dict[str, Any]:
        """Choose a PIN: the first by anybody, another from inside."""
        return answer(response, door.set_pin(pin.pin, token))

    @router.post("/unlock")
    def unlock(pin: Pin, response: Response) -> dict[str, Any]:
        """Come in."""
        return answer(response, door.unlock(pin.pin))

    @router.post("/here", dependencies=[acting])
    def here() -> dict[str, Any]:
        """The technician does something on the page."""
        return {"open": True}

    @router.post("/lock", dependencies=[acting])
    def lock() -> dict[str, Any]:
        """Go out."""
        door.lock()
        return {"open": False}

    return router


def _sights(owner: Owner, inside: Any) -> APIRouter:
    router = APIRouter(prefix="/api/calibration")

    @router.get("", dependencies=[inside])
    def state() -> dict[str, Any]:
        """What the wizard does, which steps are done, what it found, and which calibrations are kept."""
        return told(owner)

    @router.get("/preview", dependencies=[inside])
    def preview(after: int = Query(0, ge=0)) -> Response:
        """The next raw picture after number `after`, with its levels; 204 when none comes in 2 s."""
        wizard = owner.wizard
        sight = wizard.look(after) if wizard is not None else None
        if sight is None:
            return Response(status_code=204)
        age_ms = max(0, round((owner.house.clock.now_s() - sight.seen_s) * 1000))
        headers = {
            "X-Frame": str(sight.number), "X-Age-Ms": str(age_ms), "X-Exposure-Ms": f"{sight.exposure_s * 1000:.3g}",
            "X-Brightest": f"{sight.brightest_dn:.0f}", "X-Mean": f"{sight.mean_dn:.1f}", "X-Full": f"{sight.full:.4f}",
        }  # fmt: skip
        return Response(sight.jpeg, media_type="image/jpeg", headers=headers)

    return router


def _acts(owner: Owner, acting: Any) -> APIRouter:
    router = APIRouter(prefix="/api/calibration")

    @router.post("", dependencies=[acting])
    def start(start: Start) -> dict[str, Any]:
        """Begin a calibration, or go on with one."""
        owner.calibrate(Wish(owner.house.archive.root, start.serial, start.by, start.source_deg))
        return told(owner)

    @router.post("/ready", dependencies=[acting])
    def ready(ready: Ready) -> dict[str, Any]:
        """What was asked for stands there: measure it."""
        wizard = owner.wizard
        if wizard is None:
            raise Busy("nothing is being calibrated", "Start the calibration first.")
        wizard.ready(ready.stand, ready.mishap)
        return told(owner)

    @router.post("/cancel", dependencies=[acting])
    def cancel() -> dict[str, Any]:
        """End the calibration under way; what was measured is kept for half a day."""
        owner.stop()
        return told(owner)

    @router.post("/use", dependencies=[acting])
    def use(use: Use) -> dict[str, Any]:
        """Go back to an earlier calibration."""
        owner.use(use.id)
        return told(owner)

    return router


def told(owner: Owner) -> dict[str, Any]:
    """The wizard's state as JSON."""
    spec, archive, problem = owner.house.spec, owner.house.archive, owner.problem
    wizard = owner.wizard
    now = wizard.told() if wizard is not None else _IDLE | {"state": owner.idle_state}
    kept = _listed(archive)
    in_force = next((one for one in kept if one["in_force"]), None)
    needed = problem if isinstance(problem, CalibrationError | HeadMismatch) else None
    simulated = spec.camera.backend == "sim"
    return {
        "state": now["state"], "stand": now["stand"], "progress": now["progress"],
        "error": _words(now["error"] or owner.trouble), "needed": _words(needed),
        "steps": [_step(stand, now) for stand in STANDS],
        "unfinished": [stand for stand, name in STEP_FILES.items() if (archive.root / WORK / name).is_file()],
        "made": next((one for one in kept if one["id"] == owner.made), None), "in_force": in_force, "kept": kept,
        "name": spec.name, "kind": kind_of(spec), "white_dn": spec.camera.white_dn, "shape": [spec.camera.rows,
        spec.camera.cols], "mishaps": sorted(MISHAPS) if simulated else [], "idle_s": IDLE_S,
    }  # fmt: skip


_IDLE: dict[str, Any] = {"stand": None, "found": {}, "error": None, "progress": None}


def _words(error: DiffuscopeError | None) -> dict[str, str] | None:
    return None if error is None else {"code": error.code, "message": error.message, "remedy": error.remedy}


def _step(stand: str, now: dict[str, Any]) -> dict[str, Any]:
    found = now["found"].get(stand)
    return {"stand": stand, "state": "now" if stand == now["stand"] else "done" if found else "todo", "found": found}


def _listed(archive: Archive) -> list[dict[str, Any]]:
    """The calibrations that are kept, newest first; one that is damaged says so."""
    try:
        current = archive.current()
    except CalibrationError:
        current = None
    ids = archive.ids()[::-1][:LISTED]
    if current is not None and current not in ids and current in archive.ids():
        ids = (*ids, current)
    return [_described(archive, id) | {"in_force": id == current} for id in ids]


def _described(archive: Archive, id: str) -> dict[str, Any]:
    try:
        return _read(archive, id)
    except CalibrationError as error:
        return {"id": id, "damaged": _words(error), "numbers": {}}


@lru_cache(maxsize=32)  # by the archive as an object: reading one checks every byte, and the page asks each second
def _read(archive: Archive, id: str) -> dict[str, Any]:
    return described(archive.load(id))


def described(kept: Kept) -> dict[str, Any]:
    """A calibration for people: who, when, and its numbers; `psf_spread_px` pixels share a point's light."""
    found, said = kept.calibration, kept.provenance
    psf = found.psfs[0].pixels
    numbers = dict(said.figures) | asdict(found.sensor)
    numbers |= {"psf_spread_px": float(psf.sum(dtype=np.float64) ** 2 / np.square(psf, dtype=np.float64).sum())}
    return {
        "id": found.id, "serial": said.serial, "made_at": said.made_at.isoformat(), "made_by": said.made_by,
        "software": said.software, "temperature_c": said.temperature_c, "simulated": found.simulated,
        "numbers": numbers, "damaged": None,
    }  # fmt: skip
