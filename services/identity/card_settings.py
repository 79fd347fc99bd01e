"""Settings of a card: one file `diffuscope.toml` on its first partition, edited on a laptop before any boot.

Each boot reads the file, keeps it on the data partition, and overwrites the Wi-Fi password in it. An invalid file is
reported and changes nothing.
"""

import re
import tomllib
from contextlib import suppress
from ipaddress import IPv4Address, IPv4Interface
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from device import atomic_io
from device.config.head_file import load_head
from device.config.toml_file import Table, load_toml
from device.errors import DiffuscopeError, SpecError
from device.user_files import files_in, read_text
from services.identity.ssh_keys import fingerprint
from services.records.programme import load_programme

FILE = "diffuscope.toml"
UPDATES = "update.toml"  # of the update server, put onto the data partition by SSH
COUNTRIES = "iso3166.tab"  # of tzdata: a line for each country, its code first
PASSWORD = re.compile(rb'^([ \t]*password[ \t]*=[ \t]*)(["\'])(.*?)\2', re.MULTILINE)
READABLE = re.compile(rb"""password[ \t]*=[ \t]*["']*[^\s"'*]""")  # also where the file cannot be read
KEPT = re.compile(r"\*+")  # what is left of a password on the first partition


class Wifi(Table):
    """Wi-Fi network that the device joins; without a password: an open network. Stars stand for the kept password."""

    name: str = Field(min_length=1, max_length=32)
    password: str = Field(default="", max_length=63)

    @model_validator(mode="after")
    def _password_is_long_enough(self) -> Self:
        if 0 < len(self.password) < 8:
            raise ValueError("a Wi-Fi password has 8 to 63 characters")
        return self


class Ethernet(Table):
    """Fixed address of the Ethernet port; without this table the network assigns one (DHCP)."""

    address: IPv4Interface
    gateway: IPv4Address | None = None
    dns: tuple[IPv4Address, ...] = ()


class Ssh(Table):
    """Public keys that log in as root once an administrator has confirmed them; without one the SSH server is off."""

    keys: tuple[str, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _keys_are_public_keys(self) -> Self:
        for key in self.keys:
            if not re.fullmatch(r"(ssh-ed25519|ssh-rsa|ecdsa-sha2-\S+|sk-\S+) [A-Za-z0-9+/=]{40,}( [^\n]*)?", key):
                raise ValueError("a key is the one line of a file such as id_ed25519.pub")
            fingerprint(key)
        return self


class CardSettings(Table):
    """Content of `diffuscope.toml`; for an absent key the release decides.

    `country`: ISO 3166 code, whose rules the radio follows; `head`: a head file of the release, or the name of a file
    `NAME.toml` beside; `programme`: name of a file beside; `network`: whether the page is served to tablets.
    """

    country: str | None = Field(default=None, pattern="^[A-Z]{2}$")
    time_zone: str | None = Field(default=None, pattern="^[A-Za-z0-9_+-]+(/[A-Za-z0-9_+-]+)*$")
    head: str | None = Field(default=None, pattern="^[A-Za-z0-9_-]+([.]toml)?$")
    programme: str | None = Field(default=None, pattern="^[A-Za-z0-9_-]+[.]toml$")
    network: bool = False
    wifi: Wifi | None = None
    ethernet: Ethernet | None = None
    ssh: Ssh | None = None


def take_settings(boot: Path, kept: Path, release: Path, zones: Path) -> DiffuscopeError | None:
    """Keep the settings of the boot partition in the folder `kept`; return the error of an invalid file, else None.

    `boot`: folder of `diffuscope.toml`; `release`: folder of the installed program; `zones`: folder of the time zones.
    Without a file nothing changes. After an error the kept settings are as before. Of the files beside, `kept` has
    those that the settings name (`named_files`); others that it had before are removed. The password on the boot
    partition is overwritten after the settings are durable, so that a power cut loses neither. That of a file which is
    not taken stays, since nothing else has it; the remedy says so.
    """
    source = boot / FILE
    if not source.exists():
        return None
    try:
        settings = load_toml(source, CardSettings)
        content = source.read_bytes()
        if settings.wifi is not None and settings.wifi.password:
            content = _with_known_password(content, settings.wifi, kept)
        beside = _files_beside(settings, boot, release, zones)
        atomic_io.make_private(kept)
        for name, text in beside.items():
            atomic_io.write_atomically(kept / name, text)
        atomic_io.write_atomically(kept / FILE, content)
        _overwrite_password(source)
        _forget(kept, {FILE, UPDATES, *beside})
    except DiffuscopeError as error:
        return SpecError(error.message, f"{error.remedy}{_readable_password(source)}")
    except OSError as error:
        remedy = f"Make room on the card, or write the card again.{_readable_password(source)}"
        return SpecError(f"{FILE} cannot be kept: {error}", remedy)
    return None


def _readable_password(source: Path) -> str:
    """Return the sentence on a password that the file still holds, in any encoding; "" without one."""
    with suppress(OSError):
        if READABLE.search(source.read_bytes().replace(b"\0", b"")):
            return f" {FILE} still holds the Wi-Fi password, readable for everybody who has the card."
    return ""


def kept_settings(kept: Path) -> CardSettings:
    """Return the settings on the data partition; the defaults if there are none. SpecError if they are damaged."""
    return load_toml(kept / FILE, CardSettings) if (kept / FILE).exists() else CardSettings()


def _with_known_password(content: bytes, wifi: Wifi, kept: Path) -> bytes:
    """Return the file with the kept password of the network in place of stars; otherwise unchanged.

    SpecError if none is kept, or if the password cannot be overwritten in place.
    """
    written = PASSWORD.search(content)
    if written is None or written[3] != wifi.password.encode():
        message = f"{FILE}: wifi.password: it cannot be removed from this file again"
        raise SpecError(message, "Write it on a line of its own, between single quotes if it has a backslash or quote.")
    if not KEPT.fullmatch(wifi.password):
        return content
    before = kept_settings(kept).wifi
    if before is None or before.name != wifi.name:
        message = f"{FILE}: wifi.password: no password of {wifi.name!r} is kept"
        raise SpecError(message, "Write the password into the file.")
    known = PASSWORD.search((kept / FILE).read_bytes())
    assert known is not None, "a kept network has a password"
    return PASSWORD.sub(lambda found: found[1] + known[2] + known[3] + known[2], content, count=1)


def _files_beside(settings: CardSettings, boot: Path, release: Path, zones: Path) -> dict[str, bytes]:
    """Return the files that the settings name by name, checked; SpecError for one that is not valid."""
    if settings.time_zone is not None and not (zones / settings.time_zone).is_file():
        raise SpecError(f"{FILE}: time_zone: {settings.time_zone!r} is none", "Write one such as Asia/Kolkata.")
    if settings.country is not None and f"\n{settings.country}\t" not in (zones / COUNTRIES).read_text("utf-8"):
        raise SpecError(f"{FILE}: country: {settings.country!r} is none", "Write one such as KE; Great Britain is GB.")
    if settings.programme is not None:
        load_programme(boot / settings.programme)
    if settings.head is not None:
        path = head_path(settings.head, boot, release)
        if not path.is_file():
            heads = ", ".join(file.stem for file in files_in(head_path("any", boot, release).parent, "*.toml"))
            remedy = f"Write one of {heads}, or the name of a .toml file beside {FILE}."
            raise SpecError(f"{FILE}: head: there is no head file {path.name!r}", remedy)
        load_head(path)
    return {name: (boot / name).read_bytes() for name in named_files(settings, boot)}


def named_files(settings: CardSettings, folder: Path) -> list[str]:
    """Return the sorted names of the TOML files in `folder` that the settings name, and those that these files name.

    A head file names a sensor, or the head whose light it has. SpecError for a file that cannot be read.
    """
    named = set[str]()
    pending = [settings.programme, settings.head]
    while pending:
        name = pending.pop()
        if name is None or name in named or Path(name).name != name or not name.endswith(".toml"):
            continue
        if (folder / name).is_file():
            named.add(name)
            pending += _texts(tomllib.loads(read_text(folder / name)))
    return sorted(named)


def _texts(value: object) -> list[str]:
    """Return every text among the values of a TOML table."""
    if isinstance(value, dict):
        return [text for entry in value.values() for text in _texts(entry)]
    if isinstance(value, list):
        return [text for entry in value for text in _texts(entry)]
    return [value] if isinstance(value, str) else []


def _forget(kept: Path, names: set[str]) -> None:
    """Remove every other TOML file that is kept, also a hidden one, durably."""
    for path in kept.glob("*.toml"):
        if path.name not in names:
            atomic_io.remove(path)
    atomic_io.fsync_folder(kept)


def head_path(head: str, folder: Path, release: Path) -> Path:
    """Return the path of a head file: in `folder` if its name ends with `.toml`, else of the release."""
    return folder / head if head.endswith(".toml") else release / "hardware" / "heads" / f"{head}.toml"


def _overwrite_password(source: Path) -> None:
    """Replace the password in the file by stars of the same length, in place: the old bytes are gone from the card."""
    content = source.read_bytes()
    hidden = PASSWORD.sub(lambda found: found[1] + found[2] + b"*" * len(found[3]) + found[2], content)
    if hidden == content:
        return
    with source.open("r+b") as file:
        file.write(hidden)
    atomic_io.fsync_file(source)
