"""Bases and shared types of all request and response bodies."""

import re
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer

KEY_PATTERN = "^[0-9a-f]{16}$"
ID_PATTERN = "^[A-Za-z0-9._-]{1,128}$"
Key = Annotated[str, Field(pattern=KEY_PATTERN)]
RecordId = Annotated[str, Field(pattern=ID_PATTERN)]
SlotName = Annotated[str, Field(min_length=1, max_length=40)]


# Absolute paths, in quotation marks or without spaces, down to their last part; no URL, and no endpoint.
_FOLDERS = re.compile(r"""(?<=['"])/(?:[^'"/]+/)+(?=[^'"/]*['"])|(?<![\w.:/\]])/(?!api/|web/)(?:[^\s'"/:;,]+/)+""")


def without_folders(text: str) -> str:
    """Return a text in which the name of a file stands for its path: who has no login learns nothing of the disk."""
    return _FOLDERS.sub("", text)


PublicText = Annotated[str, PlainSerializer(without_folders, return_type=str)]


class RequestBody(BaseModel):
    """Request body that refuses unknown fields."""

    model_config = ConfigDict(extra="forbid")


class IdempotentRequest(RequestBody):
    """Request body of a change; `key` is an idempotency key: a repeated request has no further effect."""

    key: Key


class ResponseBody(BaseModel):
    """Response body, or a part of one; its fields are the keys on the wire."""

    model_config = ConfigDict(frozen=True, from_attributes=True)


class FolderName(ResponseBody):
    """Answer to a copy on a USB drive: the new folder."""

    folder: str
