"""OpenAPI document: problem responses are JSON also where the answer of an endpoint is a file or a stream."""

from fastapi import FastAPI
from pydantic import JsonValue

PROBLEM_STATUS = ("4XX", "5XX")


class DocumentedApp(FastAPI):
    """FastAPI application that corrects the media type of the problem responses in its OpenAPI document."""

    def openapi(self) -> dict[str, JsonValue]:
        """Return the OpenAPI document; it is generated once.

        FastAPI declares every answer of an endpoint with the media type of its response class.
        """
        if self.openapi_schema is None:
            document = super().openapi()
            for operations in document["paths"].values():
                for operation in operations.values():
                    for answer in (operation["responses"][status] for status in PROBLEM_STATUS):
                        (declared,) = answer["content"].values()
                        answer["content"] = {"application/json": declared}
        return super().openapi()
