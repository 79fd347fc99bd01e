"""Users of a device with their roles and secrets: table in one private file, argon2id hashes.

The table is read again when its file changes, so that a change by the command is in force at the next request.
"""

import secrets
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Literal, cast, get_args

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from device import atomic_io
from device.errors import InputError, StoreError
from services.errors import LoginRequired, RecordNotFound, StoreDamaged
from services.records import digested_json
from services.records.json_values import JsonValue

Role = Literal["screener", "reader", "technician", "administrator"]
ROLES: tuple[Role, ...] = get_args(Role)
FOLDER, TABLE, BEGUN = "access", "users.json", "users-begun"
MAX_USERS, MAX_NAME, MAX_SECRET = 200, 40, 200
GENERATION_BITS = 48  # of the random number at which the generations of a new user begin
PIN_DIGITS, MIN_PASSPHRASE = 6, 10  # characters; a PIN may have more digits
# The least memory that OWASP recommends for argon2id, about 0.1 s on a laptop; a PIN needs the lock-out beside it.
HASHER = PasswordHasher(time_cost=2, memory_cost=19_456, parallelism=1)
SECRET_REMEDY = f"Choose {PIN_DIGITS} digits that are no simple sequence, or {MIN_PASSPHRASE} characters or more."
TABLE_REMEDY = "Restore the users from a backup, or call the technician. No user can sign in until then."


@dataclass(frozen=True)
class User:
    """A user: unique name, roles, and `generation`, which grows with each change and ends the logins before it.

    It begins at a random number: logins of a removed user stay ended when the name is given again.
    `is_demo`: the user of a simulated head before the first real user; it is in no table.
    """

    name: str
    roles: frozenset[Role]
    generation: int = 1
    is_demo: bool = False


@dataclass(frozen=True)
class _Entry:
    user: User
    secret: str


class UserTable:
    """Table of the users in `folder`; thread-safe, also with other processes.

    The first user is an administrator, and the last administrator stays. A table that is damaged, or missing although
    users were created, is StoreDamaged for every use: no user is admitted. `refusal`: raised for every change; the
    folder is a copy in memory, which ends with the program (read_only_store.py).
    """

    def __init__(self, folder: Path, refusal: StoreError | None = None) -> None:
        self._folder, self._refusal = folder, refusal
        self._lock = Lock()
        self._read_at: tuple[int, ...] | None = None
        self._entries: dict[str, _Entry] = {}

    @property
    def has_begun(self) -> bool:
        """Whether any user was ever created."""
        return (self._folder / TABLE).exists() or (self._folder / BEGUN).exists()

    def users(self) -> tuple[User, ...]:
        """Return all users in the order of their names."""
        entries = self._current()
        return tuple(entries[key].user for key in sorted(entries))

    def find(self, name: str) -> User | None:
        """Return the user of that name, in any case of its letters; None if there is none."""
        entry = self._current().get(_key(name))
        return None if entry is None else entry.user

    def verify(self, name: str, secret: str) -> User | None:
        """Return the user with that name and secret, else None; an unknown name takes as long as a wrong secret."""
        entry = self._current().get(_key(name))
        try:
            HASHER.verify(_hash_of_no_user() if entry is None else entry.secret, secret)
        except (VerificationError, InvalidHashError):
            return None
        return None if entry is None else entry.user

    def add(self, name: str, secret: str, roles: Iterable[Role]) -> User:
        """Add a user; InputError for an invalid or used name, a weak secret, or a first user without administration."""
        name = _checked_name(name)
        entry = _Entry(User(name, _checked_roles(roles), secrets.randbits(GENERATION_BITS)), _hashed(secret))
        with self._changed() as entries:
            if _key(name) in entries:
                raise InputError(f"{name} is a user already", "Choose another name, or give this user a new PIN.")
            if len(entries) >= MAX_USERS:
                raise InputError(f"there are {len(entries)} users already", "Remove those who work here no more.")
            entries[_key(name)] = entry
        return entry.user

    def change(
        self,
        name: str,
        secret: str | None = None,
        roles: Iterable[Role] | None = None,
        generation: int | None = None,
    ) -> User:
        """Give a user a new secret or other roles, which ends its logins; RecordNotFound if unknown, InputError.

        LoginRequired if `generation` is given and the user has changed since.
        """
        hashed = None if secret is None else _hashed(secret)
        with self._changed() as entries:
            entry = _known(entries, name)
            if generation not in (None, entry.user.generation):
                raise LoginRequired(f"{entry.user.name} was changed meanwhile")
            checked = entry.user.roles if roles is None else _checked_roles(roles)
            user = replace(entry.user, roles=checked, generation=entry.user.generation + 1)
            entries[_key(name)] = _Entry(user, hashed or entry.secret)
        return user

    def remove(self, name: str) -> None:
        """Remove a user, which ends its logins; RecordNotFound if unknown, InputError for the last administrator."""
        with self._changed() as entries:
            _known(entries, name)
            del entries[_key(name)]

    def _current(self) -> dict[str, _Entry]:
        if not self.has_begun:
            return {}
        with self._lock:
            try:
                state = (self._folder / TABLE).stat()
                stamp = (state.st_mtime_ns, state.st_ino, state.st_size)
                if stamp != self._read_at:
                    self._entries, self._read_at = _decoded((self._folder / TABLE).read_bytes()), stamp
            except (OSError, ValueError, KeyError, TypeError) as error:
                self._read_at = None
                raise StoreDamaged(f"the table of the users cannot be read: {error}", TABLE_REMEDY) from error
            return self._entries

    @contextmanager
    def _changed(self) -> Iterator[dict[str, _Entry]]:
        """Change the table within the context; it is written at the end, unless the context raises."""
        if self._refusal is not None:
            raise type(self._refusal)(self._refusal.message, self._refusal.remedy)
        with _disk_errors():
            atomic_io.make_private(self._folder)
            with atomic_io.file_lock(self._folder / ".lock"):
                entries = dict(self._current())
                yield entries
                if not any("administrator" in entry.user.roles for entry in entries.values()):
                    raise InputError("no administrator is left", "First make another user an administrator.")
                atomic_io.write_atomically(self._folder / BEGUN, b"")
                atomic_io.write_atomically(self._folder / TABLE, _encoded(entries))


@contextmanager
def _disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"the users cannot be stored: {error}", "Free some space, then repeat the change.") from error


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold().strip()


def _known(entries: Mapping[str, _Entry], name: str) -> _Entry:
    entry = entries.get(_key(name))
    if entry is None:
        raise RecordNotFound(f"there is no user {name[:MAX_NAME]!r}", "Choose a user from the list.")
    return entry


def _checked_name(name: str) -> str:
    name = unicodedata.normalize("NFC", name).strip()
    if not (0 < len(name) <= MAX_NAME and name.isprintable()):
        raise InputError("this cannot be a name", f"Type a name of at most {MAX_NAME} letters and digits.")
    return name


def _checked_roles(roles: Iterable[Role]) -> frozenset[Role]:
    checked = frozenset(roles)
    if not checked or not checked <= set(ROLES):
        raise InputError("a user needs at least one role", f"Choose from: {', '.join(ROLES)}.")
    return checked


def _hashed(secret: str) -> str:
    """Return the argon2id hash of a new secret; InputError for a weak one."""
    if secret.isascii() and secret.isdecimal():
        steps = {(ord(after) - ord(before)) % 10 for before, after in pairwise(secret)}
        is_weak = len(secret) < PIN_DIGITS or (len(steps) == 1 and steps <= {0, 1, 9})
    else:
        is_weak = len(secret) < MIN_PASSPHRASE or len(set(secret)) < PIN_DIGITS
    if is_weak or len(secret) > MAX_SECRET or not secret.isprintable():
        raise InputError("this PIN is too easy to guess", SECRET_REMEDY)
    return HASHER.hash(secret)


@cache
def _hash_of_no_user() -> str:
    return HASHER.hash(secrets.token_hex())


def _encoded(entries: Mapping[str, _Entry]) -> bytes:
    rows: list[JsonValue] = [
        {
            "name": entry.user.name,
            "roles": list[JsonValue](sorted(entry.user.roles)),
            "generation": entry.user.generation,
            "secret": entry.secret,
        }
        for entry in entries.values()
    ]
    return digested_json.encoded({"users": rows})


def _decoded(content: bytes) -> dict[str, _Entry]:
    rows = digested_json.decoded(content)["users"]
    if not isinstance(rows, list):
        raise ValueError("no list of users")
    entries = {}
    for row in cast(list[dict[str, str]], rows):
        roles = frozenset(role for role in ROLES if role in row["roles"])
        user = User(str(row["name"]), roles, int(row["generation"]))
        entries[_key(user.name)] = _Entry(user, str(row["secret"]))
    return entries
