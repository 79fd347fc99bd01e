"""Bodies of the endpoints of updates."""

from pydantic import Field

from services.http.schemas.common import OmittedIfNone, RequestBody, ResponseBody
from services.update.ipc import FoundUpdate, StoredError


class UpdateChoice(RequestBody):
    """Request body: the id of one of the updates found."""

    id: str = Field(pattern="^[0-9a-f]{16}$")


class UpdateAnswer(ResponseBody):
    """State of the update: running version (`runs`), `state`, updates found, last error, release notes (`news`).

    `here`: this computer has an updater. Only with an updater: the new `version`, the version `before` it, progress 0
    to 1 (`share`), a newer version `offered` by the channel, and whether a search was done (`looked`). `took_s`:
    duration of the last committed update in seconds.
    """

    here: bool
    runs: str
    state: str
    found: list[FoundUpdate]
    trouble: StoredError | None
    news: list[str]
    took_s: float | None
    version: OmittedIfNone[str] = None
    before: OmittedIfNone[str] = None
    share: OmittedIfNone[float] = None
    offered: OmittedIfNone[str] = None
    looked: OmittedIfNone[bool] = None
