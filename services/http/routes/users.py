"""Endpoints of the administrator: list, add, change and remove users."""

from fastapi import APIRouter, Request

from services.http.routes.login import user_answer
from services.http.schemas.access import NewUser, UserAnswer, UserChange, UserList
from services.identity.users import UserTable


def users_router(users: UserTable) -> APIRouter:
    """Return the router of the users."""
    router = APIRouter(prefix="/api/users")

    def answer() -> UserList:
        return UserList(users=[user_answer(user) for user in users.users()])

    @router.get("")
    def list_users() -> UserList:
        """List all users with their roles."""
        return answer()

    @router.post("", status_code=201)
    def add_user(new: NewUser, request: Request) -> UserAnswer:
        """Add a user; 422 for a name that is used, or a name, secret or roles that cannot be used."""
        request.state.audit_record = new.name
        return user_answer(users.add(new.name, new.secret, new.roles))

    @router.patch("/{name}")
    def change_user(name: str, change: UserChange) -> UserAnswer:
        """Give a user a new secret or other roles, which signs the user out everywhere.

        404 for an unknown user, 422 for a weak secret, or if no administrator would be left.
        """
        return user_answer(users.change(name, change.secret, change.roles))

    @router.delete("/{name}")
    def remove_user(name: str) -> UserList:
        """Remove a user, who is signed out everywhere; 404 for an unknown user, 422 for the last administrator."""
        users.remove(name)
        return answer()

    return router
