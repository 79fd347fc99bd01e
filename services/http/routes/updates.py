"""Endpoints of the update screen: status, search, install, restart, and upload of an update file."""

from typing import Annotated

from fastapi import APIRouter, Header, Request
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from device.errors import InputError
from services.http.schemas.updates import UpdateChoice
from services.instrument.update_requests import UpdateRequests, UpdateStatus
from services.update.ipc import UpdateRequest

UPLOAD_PATH = "/api/update/file"


def update_routes(desk: UpdateRequests) -> APIRouter:
    """Return the router under /api/update."""
    router = APIRouter(prefix="/api/update")

    @router.get("")
    def update_status() -> UpdateStatus:
        """Return the running version, the progress of an update, the updates found, and the last error."""
        return desk.status()

    router.include_router(_request_router(desk))
    router.include_router(_upload_router(desk))
    return router


def _request_router(desk: UpdateRequests) -> APIRouter:
    """Return the router of the requests to the updater: search, install, restart."""
    router = APIRouter()

    def requested(request: UpdateRequest) -> UpdateStatus:
        desk.request(request)
        return desk.status()

    @router.post("/check", status_code=202)
    def check() -> UpdateStatus:
        """Request a search for updates on USB drives, in the uploaded file and in the channel.

        Answers 202 with the status; the updater runs as another process. 409 (`update.busy`) while an update is under
        way.
        """
        return requested(UpdateRequest(do="check"))

    @router.post("/install", status_code=202)
    def install(choice: UpdateChoice) -> UpdateStatus:
        """Request the install of one of the updates found; the device restarts by itself afterwards.

        Answers 202 with the status; 409 (`update.busy`) while an update is under way.
        """
        return requested(UpdateRequest(do="install", id=choice.id))

    @router.post("/restart", status_code=202)
    def restart() -> UpdateStatus:
        """Request a restart into the installed version to try it.

        Answers 202 with the status; 409 (`update.busy`) while an update is under way.
        """
        return requested(UpdateRequest(do="restart"))

    return router


def _upload_router(desk: UpdateRequests) -> APIRouter:
    """Return the router of the upload of an update file."""
    router = APIRouter()

    @router.put("/file", status_code=201)
    async def receive(request: Request, content_length: Annotated[int, Header(ge=0)]) -> UpdateStatus:
        """Store an update file (the request body) for the updater; a later search finds it.

        Answers 201 with the status; 409 while an update is under way, 422 if the connection ends early, 507 if the file
        does not fit.
        """
        try:
            with desk.receiving(content_length) as upload:
                async for piece in request.stream():
                    await run_in_threadpool(upload.write, piece)  # a slow SD card must not block the event loop
                await run_in_threadpool(upload.publish)
        except ClientDisconnect as error:  # the client is gone; the event log records the error
            raise InputError("the tablet went away before all had arrived", "Send the file again.") from error
        return desk.status()

    return router
