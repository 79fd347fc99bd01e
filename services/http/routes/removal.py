"""Endpoints of the technician that remove exported and sent pictures, and bring them back."""

from fastapi import APIRouter

from services.delivery.removal import PictureRemoval
from services.http.schemas.removal import RemovalAnswer


def removal_routes(removal: PictureRemoval) -> APIRouter:
    """Return the router of the removal under /api/technician/removal; every request may be repeated."""
    router = APIRouter(prefix="/api/technician/removal")

    def answer() -> RemovalAnswer:
        now = removal.removable()
        (captures, size_bytes) = removal.undoable()
        return RemovalAnswer(
            visits=now.visits,
            captures=sum(map(len, now.captures.values())),
            size_bytes=now.size_bytes,
            oldest_day=now.oldest_day,
            newest_day=now.newest_day,
            undoable_captures=captures,
            undoable_bytes=size_bytes,
        )

    @router.get("")
    def removable() -> RemovalAnswer:
        """Return what was exported, or sent and confirmed, and may be removed; and what can be brought back."""
        return answer()

    @router.post("")
    def remove() -> RemovalAnswer:
        """Remove raw frames and pictures of these visits; reports and quick looks stay.

        They are kept until a new picture needs their space.
        """
        removal.remove()
        return answer()

    @router.post("/undo")
    def undo() -> RemovalAnswer:
        """Bring back everything whose space was not needed yet."""
        removal.undo()
        return answer()

    return router
