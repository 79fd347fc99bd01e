"""The addresses of the technician's update screen: how far it is, look, install, restart, and a tablet's own file."""

from typing import Annotated, Any

from fastapi import APIRouter, Cookie, Depends, Header, Request
from pydantic import Field
from starlette.requests import ClientDisconnect

from device.errors import InputError
from services.instrument.technician import Door
from services.instrument.technician_api import COOKIE, Body
from services.instrument.updating import UpdateDesk
from services.records.update_notes import Wish

UPLOAD_PATH = "/api/update/file"


class Choice(Body):
    """One of the updates that were found."""

    id: str = Field(pattern="^[0-9a-f]{16}$")


def update_routes(desk: UpdateDesk, door: Door) -> APIRouter:
    """Addresses under /api/update; whoever looks on is inside already, whoever acts keeps the door open."""
    router = APIRouter(prefix="/api/update")

    def acting(token: Annotated[str | None, Cookie(alias=COOKIE)] = None) -> None:
        door.touch(token)

    @router.get("")
    def told() -> dict[str, Any]:
        """What runs, how far an update is, what was found, and what went wrong."""
        return desk.told()

    @router.post("/check", status_code=202, dependencies=[Depends(acting)])
    def check() -> dict[str, Any]:
        """Look what there is: on sticks, from this tablet, in the channel."""
        desk.wish(Wish(do="check"))
        return desk.told()

    @router.post("/install", status_code=202, dependencies=[Depends(acting)])
    def install(choice: Choice) -> dict[str, Any]:
        """Install one of those that were found; the device restarts by itself."""
        desk.wish(Wish(do="install", id=choice.id))
        return desk.told()

    @router.post("/restart", status_code=202, dependencies=[Depends(acting)])
    def restart() -> dict[str, Any]:
        """Restart to try what is installed and waits."""
        desk.wish(Wish(do="restart"))
        return desk.told()

    @router.put("/file", status_code=201, dependencies=[Depends(acting)])
    async def receive(request: Request, content_length: Annotated[int, Header(ge=0)]) -> dict[str, Any]:
        """Take an update from the tablet, as the body; then look, and it is among those that are found."""
        try:
            await desk.receive(content_length, request.stream())
        except ClientDisconnect as error:  # nobody hears this, but the diary does
            raise InputError("the tablet went away before all had arrived", "Send the file again.") from error
        return desk.told()

    return router
