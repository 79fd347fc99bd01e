"""Bodies of the endpoints of exports."""

from pydantic import Field

from services.http.schemas.common import IdempotentRequest, ResponseBody


class VisitExport(IdempotentRequest):
    """Request body: the USB drive that receives the export, by its id."""

    folder: str = Field(min_length=1, max_length=1000)


class UsbDriveAnswer(ResponseBody):
    """A USB drive: its id, its name, its free space, and whether it can be written."""

    id: str
    name: str
    free_bytes: int
    is_writable: bool


class UsbDriveList(ResponseBody):
    """The USB drives that are present."""

    folders: list[UsbDriveAnswer]
