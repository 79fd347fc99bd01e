"""Bodies of the endpoints of sign-in, set-up, users and keys for SSH."""

from pydantic import Field

from services.http.schemas.common import RequestBody, ResponseBody
from services.identity.users import MAX_NAME, MAX_SECRET, Role

SecretText = Field(max_length=MAX_SECRET)


class SignIn(RequestBody):
    """Request body: name and PIN or passphrase, as typed."""

    name: str = Field(max_length=MAX_NAME)
    secret: str = SecretText


class SetUp(SignIn):
    """Request body: set-up code, and name and secret of an administrator."""

    code: str = Field(max_length=40)


class SecretConfirmation(RequestBody):
    """Request body: the PIN or passphrase of the signed-in user."""

    secret: str = SecretText


class SecretChange(SecretConfirmation):
    """Request body: the present and the new PIN or passphrase."""

    new: str = SecretText


class NewUser(SignIn):
    """Request body: a new user."""

    roles: list[Role]


class UserChange(RequestBody):
    """Request body: a new secret, or other roles, of a user; null leaves it."""

    secret: str | None = Field(default=None, max_length=MAX_SECRET)
    roles: list[Role] | None = None


class UserAnswer(ResponseBody):
    """A user with the roles; `is_demo`: the demonstration user of a simulated head."""

    name: str
    roles: list[Role]
    is_demo: bool


class LoginAnswer(ResponseBody):
    """The user of this client, or null; whether the device waits for its set-up; time of the idle lock in s."""

    user: UserAnswer | None
    needs_setup: bool
    idle_s: float


class UserList(ResponseBody):
    """All users, in the order of their names."""

    users: list[UserAnswer]


class SshKeyDecision(RequestBody):
    """Request body: the key with this fingerprint may log in, or not."""

    fingerprint: str = Field(max_length=80)
    confirmed: bool


class SshKeyAnswer(ResponseBody):
    """A key: SHA-256 fingerprint, comment, and whether it is confirmed (false: refused; null: no decision)."""

    fingerprint: str
    comment: str
    confirmed: bool | None


class SshKeyList(ResponseBody):
    """Keys for SSH in the file of the card, in its order."""

    keys: list[SshKeyAnswer]
