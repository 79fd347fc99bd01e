"""Bodies of the endpoints that erase a patient."""

from pydantic import Field

from services.http.schemas.common import RequestBody, ResponseBody
from services.records.visit import EraseReason


class ErasureRequest(RequestBody):
    """Request body: the patient to erase for good, by number, and the reason."""

    number: str = Field(min_length=1, max_length=40)
    reason: EraseReason


class PatientCounts(ResponseBody):
    """Numbers of visits and captures of a patient, and of the files of the captures."""

    visits: int
    captures: int
    files: int
