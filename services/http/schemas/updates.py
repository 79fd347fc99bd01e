"""Bodies of the endpoints of updates."""

from pydantic import Field

from services.http.schemas.common import RequestBody


class UpdateChoice(RequestBody):
    """Request body: the id of one of the updates found."""

    id: str = Field(pattern="^[0-9a-f]{16}$")
