"""Problem responses: the HTTP status of each error, and the handlers that answer every exception with one."""

import math

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException

from device.errors import (
    CalibrationError,
    DiffuscopeError,
    HardwareError,
    HeadMismatch,
    InputError,
    LightFault,
    LightLimit,
    PowerLow,
    StoreFull,
    StoreReadOnly,
    TooHot,
)
from services.errors import (
    AccessDenied,
    BackupKeyWrong,
    Busy,
    ConfirmationRequired,
    CrossOriginRequest,
    LoginRequired,
    PresenceRequired,
    RecordErased,
    RecordNotFound,
    RecordRemoved,
    RequestRefused,
    RestoreRefused,
    SecretWrong,
    ServerFull,
    SetupRequired,
    SignInLockedOut,
    StoreDamaged,
    StoreLocked,
    TooManyRequests,
    UntrustedHost,
    UpdateError,
    UpdateNoRoom,
    UploadError,
    UsbDriveFull,
    UsbDriveUnavailable,
)
from services.http.schemas.problems import ErrorText, ProblemResponse
from services.http.security import security_headers

HTTP_STATUS: dict[type[DiffuscopeError], int] = {
    RecordNotFound: 404,
    RecordRemoved: 410,
    RecordErased: 410,
    Busy: 409,
    RequestRefused: 409,
    ServerFull: 503,
    CrossOriginRequest: 403,
    UntrustedHost: 400,
    InputError: 422,
    LightLimit: 423,
    LightFault: 423,
    HardwareError: 503,
    HeadMismatch: 423,
    TooHot: 423,
    PowerLow: 423,
    CalibrationError: 423,
    LoginRequired: 401,
    SetupRequired: 401,
    ConfirmationRequired: 401,
    AccessDenied: 403,
    SecretWrong: 403,
    PresenceRequired: 403,
    SignInLockedOut: 429,
    TooManyRequests: 429,
    BackupKeyWrong: 403,
    RestoreRefused: 409,
    StoreFull: 507,
    StoreReadOnly: 503,
    StoreLocked: 503,
    UsbDriveFull: 507,
    UpdateNoRoom: 507,
    UpdateError: 409,
    UsbDriveUnavailable: 503,
    UploadError: 409,
    StoreDamaged: 500,
    DiffuscopeError: 500,
}


def problem_response(error: DiffuscopeError) -> Response:
    """Return the problem response of an error; its HTTP status is that of its nearest ancestor in `HTTP_STATUS`.

    `wait_s` of the error is also in the header `Retry-After`.
    """
    status = next(HTTP_STATUS[kind] for kind in type(error).__mro__ if kind in HTTP_STATUS)
    headers = None if error.wait_s is None else {"Retry-After": str(math.ceil(error.wait_s))}
    return JSONResponse(problem_body(error).model_dump(), status, headers)


def problem_body(error: DiffuscopeError) -> ProblemResponse:
    """Return the problem response body of an error."""
    return ProblemResponse(code=error.code, message=error.message, remedy=error.remedy, n=error.n, wait_s=error.wait_s)


def error_text(error: DiffuscopeError | None) -> ErrorText | None:
    """Return code, message and remedy of an error inside another body; None for None."""
    return None if error is None else ErrorText(code=error.code, message=error.message, remedy=error.remedy)


def register_error_handlers(app: FastAPI) -> None:
    """Register handlers that answer every exception with a problem response: own, validation, HTTP, unexpected."""

    @app.exception_handler(DiffuscopeError)
    async def _(_: Request, error: DiffuscopeError) -> Response:
        return problem_response(error)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        message_text = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        encodable = message_text.encode("utf-8", "replace").decode()  # a lone surrogate cannot be encoded as UTF-8
        return problem_response(InputError(encodable, "Reload the page and try again."))

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> Response:
        message = f"{request.method} {request.url.path}: {error.detail}"
        answer = ProblemResponse(code=f"http.{error.status_code}", message=message, remedy="Go back to the page.")
        return JSONResponse(answer.model_dump(), error.status_code, error.headers)

    @app.exception_handler(Exception)  # Starlette answers outside every middleware, then logs it
    async def _(request: Request, _: Exception) -> Response:
        answer = problem_response(DiffuscopeError("an unexpected error occurred"))
        answer.headers.update(security_headers(request.url.path))
        return answer
