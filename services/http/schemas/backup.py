"""Bodies of the endpoints of backups."""

from pydantic import AwareDatetime, Field

from services.http.schemas.common import RequestBody, ResponseBody
from services.http.schemas.problems import ErrorText


class BackupPassphrase(RequestBody):
    """Request body: the passphrase of the next backups."""

    passphrase: str = Field(min_length=1, max_length=1000)


class BackupRequest(RequestBody):
    """Request body: the USB drive that receives the backup, by the folder that the server listed."""

    folder: str = Field(min_length=1, max_length=1000)


class LastBackupAnswer(ResponseBody):
    """The last complete backup: number, time, name of its folder, folders of the store in it, and bytes written."""

    number: int
    made_at: AwareDatetime
    folder: str
    units: int
    written_bytes: int


class BackupAnswer(ResponseBody):
    """State of the backups: `done` and `total` count the folders of the one under way, null without one."""

    has_key: bool
    last: LastBackupAnswer | None
    is_due: bool
    done: int | None
    total: int | None
    error: ErrorText | None
