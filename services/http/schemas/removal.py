"""Bodies of the endpoints that remove exported and sent pictures."""

from services.http.schemas.common import ResponseBody


class RemovalAnswer(ResponseBody):
    """What may be removed (visits, captures, bytes, local days, ISO 8601), and what can be brought back."""

    visits: int
    captures: int
    size_bytes: int
    oldest_day: str | None
    newest_day: str | None
    undoable_captures: int
    undoable_bytes: int
