"""External probe of the running instrument over HTTP: availability, version, health checks, and a live picture.

The probe does not use the unit state: systemd calls a release "running" even if its server crashes in a restart loop.
"""

import json
import secrets
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version

import httpx
from pydantic import BaseModel

from services.health.checks import Check

BASE_URL = "http://127.0.0.1:8000"
TIMEOUT_S = 15.0  # timeout of one answer; a restarting instrument accepts connections and does not answer
RESTART_REMEDY = "Turn the device off and on. If it does not come back, go back to the version before."


class ReportedUploads(BaseModel):
    """Counts of the upload queue, as reported: `waiting` visits."""

    waiting: int = 0


class ReportedStatus(BaseModel):
    """Status of an instrument of any release, as reported: version, state, and counts of the upload queue.

    None where the release does not report it, and for `sending` if upload is not set up.
    """

    version: str | None = None
    state: str | None = None
    sending: ReportedUploads | None = None


def http_get(base_url: str, path: str, timeout_s: float = TIMEOUT_S) -> tuple[int, bytes]:
    """Send a GET request; return status code and body of a successful answer.

    httpx.HTTPError without an answer, and for an error status (400 or above). Each wait for the network takes at most
    `timeout_s` seconds.
    """
    with _client(base_url, timeout_s) as client:
        answer = client.get(path).raise_for_status()
    return answer.status_code, answer.content


def _client(base_url: str, timeout_s: float) -> httpx.Client:
    return httpx.Client(base_url=base_url, timeout=timeout_s, trust_env=False)  # this device: no proxy


def status(base_url: str = BASE_URL, timeout_s: float = TIMEOUT_S) -> ReportedStatus | None:
    """Return the status of the instrument, from `/api/status`; None without a valid answer within `timeout_s`."""
    try:
        return ReportedStatus.model_validate_json(http_get(base_url, "/api/status", timeout_s)[1])
    except (httpx.HTTPError, ValueError):
        return None


def probe_instrument(base_url: str = BASE_URL, with_picture: bool = False, timeout_s: float = TIMEOUT_S) -> list[Check]:
    """Return the checks of the probe (`page`, `version`), and those of the instrument; only `page` without an answer.

    `with_picture` adds the check `picture`, unless the instrument is starting: one live picture, which lights the lamp
    for a moment as aiming does, and tests lamp, camera and computation. For this moment the probe takes the control
    lease, so that a screen shows that another one takes pictures.
    """
    reply = status(base_url, timeout_s)
    answers = Check(
        "page",
        reply is not None,
        "answers" if reply else "does not answer",
        f"in {timeout_s:g} s",
        RESTART_REMEDY,
        True,
    )
    if reply is None:
        return [answers]
    installed = version("diffuscope")
    version_check = Check(
        "version",
        reply.version == installed,
        f"{reply.version}",
        f"{installed}, as installed",
        RESTART_REMEDY,
        True,
    )
    own = _instrument_checks(base_url, timeout_s)
    ready = reply.state != "starting"
    return [answers, version_check, *own, *([_picture(base_url, timeout_s)] if with_picture and ready else [])]


def _instrument_checks(at: str, patience_s: float) -> list[Check]:
    try:
        return [Check(**fields) for fields in json.loads(http_get(at, "/api/health", patience_s)[1])["checks"]]
    except (httpx.HTTPError, ValueError, KeyError, TypeError) as error:
        return [Check("checks", False, f"cannot be read: {error}", "a list", RESTART_REMEDY, True)]


def _picture(at: str, patience_s: float) -> Check:
    """Request one live picture and return the check `picture`: ok if the answer is a JPEG."""
    try:
        code, body = _live_picture(at, patience_s)
    except httpx.HTTPError as error:
        return Check("picture", False, f"does not come: {error}", "a live picture", RESTART_REMEDY, True)
    ok = code == 200 and body.startswith(b"\xff\xd8")
    value = f"{len(body)} bytes" if ok else "none came"
    return Check("picture", ok, value, "a live picture", RESTART_REMEDY, True)


def _live_picture(at: str, patience_s: float) -> tuple[int, bytes]:
    """Take the control lease, request one live picture and release the lease; return status code and body.

    httpx.HTTPError as for `http_get`. A lease that cannot be released expires.
    """
    key = secrets.token_hex(8)
    with _client(at, patience_s) as client:
        client.post("/api/controller", json={"key": key, "take": True}).raise_for_status()
        try:
            answer = client.get("/api/preview", headers={"X-Controller": key}).raise_for_status()
        finally:
            with suppress(httpx.HTTPError):
                client.post("/api/controller", json={"key": key, "release": True})
    return answer.status_code, answer.content


def table(checks: Sequence[Check]) -> str:
    """Return the checks as a text table: result, name, value, limit, and the remedy below each failed check.

    Result: `ok`, `FAIL`, or `-` for a check that is ok only because there were no data.
    """
    lines = []
    for check in checks:
        mark = "FAIL" if not check.ok else "ok  " if check.known else "-   "
        lines.append(f"{mark}  {check.name:<12} {check.value:<56}  {check.limit}")
        if not check.ok and check.remedy:
            lines.append(f"{'':<19}{check.remedy}")
    return "\n".join(lines)


def as_json(checks: Sequence[Check]) -> list[dict[str, object]]:
    """Return the checks as objects for JSON, one dict of the fields of `Check` each."""
    return [asdict(check) for check in checks]
