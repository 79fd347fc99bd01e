"""Bodies of the endpoints of the keys for SSH."""

from pydantic import Field

from services.http.schemas.common import RequestBody, ResponseBody


class SshKeyDecision(RequestBody):
    """Request body: the key with this fingerprint may log in, or not."""

    fingerprint: str = Field(max_length=80)
    confirmed: bool


class SshKeyAnswer(ResponseBody):
    """A key: SHA-256 fingerprint, comment, and whether it is confirmed (false: refused; null: no decision)."""

    fingerprint: str
    comment: str
    confirmed: bool | None


class SshKeyList(ResponseBody):
    """Keys for SSH in the file of the card, in its order."""

    keys: list[SshKeyAnswer]
