"""Response classes of answers that are no JSON, and their declaration in the OpenAPI document."""

from typing import TypeAlias

from fastapi.responses import Response, StreamingResponse

Declaration: TypeAlias = "str | dict[str, Declaration]"
Responses: TypeAlias = dict[int | str, dict[str, Declaration]]


def file_responses(*media_types: str) -> Responses:
    """Return the argument `responses` of an endpoint that answers 200 with a file of one of these media types."""
    content: dict[str, Declaration] = {kind: {"schema": {"type": "string", "format": "binary"}} for kind in media_types}
    return {200: {"content": content}}


def no_picture(reason: str) -> Responses:
    """Return the declaration of answer 204."""
    return {204: {"description": reason}}


class PngResponse(Response):
    """A picture as PNG."""

    media_type = "image/png"


class JpegResponse(Response):
    """A picture as JPEG."""

    media_type = "image/jpeg"


class SvgResponse(Response):
    """A drawing as SVG."""

    media_type = "image/svg+xml"


class ZipResponse(Response):
    """A ZIP archive."""

    media_type = "application/zip"


class AgeResponse(Response):
    """A file that is encrypted to public keys of age; the format has no registered media type."""

    media_type = "application/octet-stream"


class TextResponse(Response):
    """A text; Starlette adds the character set to the media type."""

    media_type = "text/plain"


class EventStream(StreamingResponse):
    """A stream of server-sent events."""

    media_type = "text/event-stream"
