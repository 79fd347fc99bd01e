"""Ask the running instrument from outside, over HTTP, as a page does: does it serve, and what do its checks say.

Never unit state: a release whose server dies and is started anew for ever is "running" to systemd.
"""

import json
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict
from http.client import HTTPException
from importlib.metadata import version
from typing import Any

from services.health.checks import Check

AT = "http://127.0.0.1:8000"
PATIENCE_S = 15.0  # for one answer; while the instrument starts anew its address accepts, and nobody answers
BACK = "Turn the device off and on. If it does not come back, go back to the version before."


def ask(at: str, path: str, patience_s: float = PATIENCE_S) -> tuple[int, bytes]:
    """The status and the body of one answer; OSError or HTTPException if there is none."""
    request = urllib.request.Request(at + path, headers={"X-Controller": "health"})  # the lamp shines for no stranger
    with urllib.request.urlopen(request, timeout=patience_s) as answer:  # the caller's own device, plain HTTP
        return answer.status, answer.read()


def status(at: str = AT, patience_s: float = PATIENCE_S) -> dict[str, Any] | None:
    """What the instrument says it does; None if it does not answer."""
    try:
        return dict(json.loads(ask(at, "/api/status", patience_s)[1]))
    except (OSError, HTTPException, ValueError):
        return None


def examine(at: str = AT, look: bool = False, patience_s: float = PATIENCE_S) -> list[Check]:
    """Every check: those from outside first, then the instrument's own.

    `look` also asks for one live picture, which shines for a moment as aiming does: lamp, camera and computation.
    """
    said = status(at, patience_s)
    answers = Check(
        "page", said is not None, "answers" if said else "does not answer", f"in {patience_s:g} s", BACK, True
    )
    if said is None:
        return [answers]
    here = version("diffuscope")
    runs = Check("version", said.get("version") == here, f"{said.get('version')}", f"{here}, as installed", BACK, True)
    own = _own(at, patience_s)
    ready = said.get("state") != "starting"
    return [answers, runs, *own, *([_picture(at, patience_s)] if look and ready else [])]


def _own(at: str, patience_s: float) -> list[Check]:
    try:
        return [Check(**one) for one in json.loads(ask(at, "/api/health", patience_s)[1])["checks"]]
    except (OSError, HTTPException, ValueError, KeyError, TypeError) as error:
        return [Check("checks", False, f"cannot be read: {error}", "a list", BACK, True)]


def _picture(at: str, patience_s: float) -> Check:
    """A live picture went all the way from the lamp to a JPEG."""
    try:
        code, body = ask(at, "/api/preview", patience_s)
    except (OSError, HTTPException) as error:
        return Check("picture", False, f"does not come: {error}", "a live picture", BACK, True)
    ok = code == 200 and body.startswith(b"\xff\xd8")
    value = f"{len(body)} bytes" if ok else "none came"
    return Check("picture", ok, value, "a live picture", BACK, True)


def table(checks: Sequence[Check]) -> str:
    """The list for people: what is well, what is not, and what to do."""
    lines = []
    for check in checks:
        mark = "FAIL" if not check.ok else "ok  " if check.known else "-   "
        lines.append(f"{mark}  {check.name:<12} {check.value:<56}  {check.limit}")
        if not check.ok and check.remedy:
            lines.append(f"{'':<19}{check.remedy}")
    return "\n".join(lines)


def as_json(checks: Sequence[Check]) -> list[dict[str, object]]:
    """The list for machines."""
    return [asdict(check) for check in checks]
