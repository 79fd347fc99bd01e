"""Endpoints of the administrator: keys for SSH in the file of the card, confirmed or refused at the device."""

import json
from collections.abc import Callable
from pathlib import Path

from fastapi import APIRouter, Request

from services.errors import RecordNotFound
from services.http.authentication import Peer, check_presence
from services.http.schemas.ssh_keys import SshKeyAnswer, SshKeyDecision, SshKeyList
from services.identity import ssh_keys
from services.identity.apply_settings import OUTPUT
from services.records import schema
from services.records.capture_store import CaptureStore
from services.records.storage_errors import storage_errors


def ssh_keys_router(store: CaptureStore, root: Path, pressed_s: Callable[[], float | None]) -> APIRouter:
    """Return the router of the keys; `root`: of the file system, `pressed_s`: as of `check_presence`."""
    router = APIRouter(prefix="/api/ssh-keys")

    def answer() -> SshKeyList:
        file, known = root / OUTPUT / ssh_keys.FILE, ssh_keys.decisions(store.folder)
        asked: list[str] = json.loads(file.read_text()) if file.exists() else []
        shown = {ssh_keys.fingerprint(key): " ".join(key.split()[2:]) for key in asked}
        return SshKeyList(
            keys=[SshKeyAnswer(fingerprint=one, comment=shown[one], confirmed=known.get(one)) for one in shown]
        )

    @router.get("")
    def list_keys() -> SshKeyList:
        """List the keys that the file of the card had at the last start, with their decisions; none without a card."""
        return answer()

    @router.post("")
    def decide(decision: SshKeyDecision, request: Request) -> SshKeyList:
        """Confirm or refuse a key, from the next start on.

        Within 30 s after a press of the device's button; a device without one asks for a request from its own screen.
        403 without, 404 for a key that is not listed.
        """
        request.state.audit_record = decision.fingerprint
        request.state.audit_field = "confirmed" if decision.confirmed else "refused"
        check_presence(Peer.of(request), pressed_s())
        if decision.fingerprint not in {key.fingerprint for key in answer().keys}:
            raise RecordNotFound("the card has no such key", "Start the device again, and compare the fingerprints.")
        schema.refuse_if_read_only(store.engine)
        with storage_errors():
            ssh_keys.decide(store.folder, decision.fingerprint, decision.confirmed)
        return answer()

    return router
