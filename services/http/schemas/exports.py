"""Bodies of the endpoints of exports."""

from pydantic import Field

from services.http.schemas.common import IdempotentRequest, ResponseBody


class VisitExport(IdempotentRequest):
    """Request body: the USB drive that receives the export, by its folder."""

    folder: str = Field(min_length=1, max_length=1000)


class UsbDrive(ResponseBody):
    """A USB drive: its folder, its name and its free space."""

    id: str
    name: str
    free_bytes: int


class UsbDriveList(ResponseBody):
    """The USB drives that are present."""

    folders: list[UsbDrive]
