"""Idempotent requests: each completed request is stored with its key, so that a repeated one has no further effect."""

import hashlib
import hmac
from collections.abc import Callable
from datetime import timedelta

from sqlalchemy import Engine, delete
from sqlalchemy.orm import Session

from device.clock import Clock
from services.errors import IdempotencyKeyConflict
from services.records import schema
from services.records.record_signing import recorded
from services.records.reserve_file import ReserveFile
from services.records.schema import IdempotencyKeyRow
from services.records.storage_errors import storage_errors

KEY_RETENTION = timedelta(days=30)  # retention of idempotency keys, longer than any network's retries


class IdempotentRequests:
    """Idempotency keys of completed requests in the database; thread-safe, writers are serialised."""

    def __init__(self, engine: Engine, clock: Clock) -> None:
        self._engine, self._clock = engine, clock
        self._key = schema.key_of(engine) or b""
        self._reserve = ReserveFile(schema.folder_of(engine))

    def run_in_transaction(self, key: str, request: str, act: Callable[[Session], str]) -> str:
        """Run a change and store its idempotency key and answer in one transaction; return the answer.

        For a repeated key return the stored answer; IdempotencyKeyConflict if the key belongs to another request.
        StoreFull or StoreReadOnly if the store takes no changes.
        """
        schema.refuse_if_read_only(self._engine)
        return self._reserve.retried(lambda: self._run(key, request, act))

    def run_once(self, key: str, request: str, act: Callable[[], str]) -> str:
        """Run an action such as an export, and store its answer; for a repeated key return the stored answer instead.

        `request`: text of the request; IdempotencyKeyConflict if the key belongs to another request. The action runs
        before the transaction, because other writers must not wait for it; so two simultaneous calls may both run it.
        """
        with storage_errors(), Session(self._engine) as session:
            before = self.find(session, key, request)
        if before is not None:
            return before
        answer = act()
        return self._run(key, request, lambda _: answer)  # also in a read-only store, whose tables are a copy

    def _run(self, key: str, request: str, act: Callable[[Session], str]) -> str:
        with storage_errors(), recorded(self._engine) as session:
            before = self.find(session, key, request)
            if before is None:
                answer = act(session)
                self.store(session, key, request, answer)
                return answer
            return before

    def find(self, session: Session, key: str, request: str) -> str | None:
        """Return the stored answer of a request; None for a new key, IdempotencyKeyConflict for a key in use."""
        before = session.get(IdempotencyKeyRow, key)
        if before is None:
            return None
        if before.request != self._digest(request):
            raise key_conflict()
        return before.answer

    def store(self, session: Session, key: str, request: str, answer: str) -> None:
        """Add the key of a completed request to the transaction."""
        now = schema.utc_text(self._clock.wall())
        session.add(IdempotencyKeyRow(key=key, request=self._digest(request), answer=answer, done_at=now))

    def reference(self, key: str, request: str) -> str:
        """Return key and digest of a request, as the record that the request makes holds them."""
        return f"{key} {self._digest(request)}"

    def delete_expired(self, session: Session) -> None:
        """Delete the keys that are older than KEY_RETENTION."""
        oldest = schema.utc_text(self._clock.wall() - KEY_RETENTION)
        session.execute(delete(IdempotencyKeyRow).where(IdempotencyKeyRow.done_at < oldest))

    def _digest(self, request: str) -> str:
        """Return the HMAC of the text of a request, which may hold a number: a plain digest could be guessed."""
        return hmac.new(self._key, request.encode("utf-8", "backslashreplace"), hashlib.sha256).hexdigest()


def key_conflict() -> IdempotencyKeyConflict:
    """Return the error for an idempotency key that was used for another request."""
    return IdempotencyKeyConflict("key: it belongs to another request")
