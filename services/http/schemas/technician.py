"""Bodies of the endpoints of the technician's login."""

from pydantic import Field

from services.http.schemas.common import RequestBody, ResponseBody


class Pin(RequestBody):
    """Request body: the PIN as typed; its form is checked later."""

    pin: str = Field(max_length=40)


class LoginState(ResponseBody):
    """Whether this client is logged in (`open`) and a PIN is set, the lock-out left and the idle timeout, seconds."""

    open: bool
    has_pin: bool
    wait_s: float
    idle_s: float


class LoginAnswer(ResponseBody):
    """Whether this client is logged in after the request."""

    open: bool
