"""Settings of a card applied at boot: the root file system is volatile, so every boot writes networks, SSH and zone."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from device import atomic_io
from device.errors import DiffuscopeError, SpecError
from services.identity import ssh_keys
from services.identity.card_settings import (
    FILE,
    UPDATES,
    CardSettings,
    Ethernet,
    Wifi,
    head_path,
    kept_settings,
    named_files,
    take_settings,
)

CONNECTIONS = "run/NetworkManager/system-connections"
OUTPUT = "run/diffuscope-settings"  # readable for all: head file, programme, arguments, country, SSH keys, problem
HOST_KEY = "ssh_host_ed25519_key"


@dataclass(frozen=True)
class CardBoot:
    """Settings of a card at one boot; `root` is the root of its file system ("/" or a folder in tests)."""

    root: Path = Path("/")

    @property
    def kept(self) -> Path:
        """Folder of the settings on the data partition, which updates do not write."""
        return self.root / "data/settings"

    def run(self) -> DiffuscopeError | None:
        """Take the file of the boot partition, apply what is kept, and publish a problem; return it, else None.

        Each step is tried, whatever another one raised, and the device starts: the first problem is published.
        """
        problems = [_attempt(step) for step in (self._take, self._apply, self._apply_update_settings)]
        problem = next((error for error in problems if error is not None), None)
        self._publish(problem)
        return problem

    def _take(self) -> DiffuscopeError | None:
        zones = self.root / "usr/share/zoneinfo"
        return take_settings(self.root / "boot/chooser", self.kept, self._release, zones)

    @property
    def _release(self) -> Path:
        return self.root / "opt/diffuscope"

    def _apply(self) -> DiffuscopeError | None:
        settings = kept_settings(self.kept)
        steps = (self._apply_head_and_programme, self._apply_place, self._apply_networks, self._apply_ssh)
        problems = [_attempt(partial(step, settings)) for step in steps]
        return next((error for error in problems if error is not None), None)

    def _apply_head_and_programme(self, settings: CardSettings) -> None:
        output = self.root / OUTPUT
        arguments = {}
        for name in named_files(settings, self.kept):
            self._write_public(name, (self.kept / name).read_bytes())
        if settings.head is not None:
            arguments["HEAD"] = str(_from_root(head_path(settings.head, output, self._release), self.root))
        if settings.programme is not None:
            arguments["PROGRAMME"] = f"--programme {_from_root(output / settings.programme, self.root)}"
        content = "".join(f"{name}={value}\n" for name, value in arguments.items())
        self._write_public("instrument.env", content.encode())

    def _apply_place(self, settings: CardSettings) -> None:
        if settings.country is not None:
            self._write_public("country.env", f"COUNTRY={settings.country}\n".encode())
        if settings.time_zone is not None:
            zone = self.root / "etc/localtime"
            zone.unlink(missing_ok=True)
            zone.symlink_to(f"/usr/share/zoneinfo/{settings.time_zone}")

    def _apply_networks(self, settings: CardSettings) -> None:
        if settings.wifi is not None:
            self._write_private(f"{CONNECTIONS}/wifi.nmconnection", wifi_profile(settings.wifi))
        elif settings.network:
            access_point = f"{CONNECTIONS}/access-point.nmconnection"
            profile = (self.root / access_point).read_text()
            self._write_private(access_point, profile.replace("autoconnect=false", "autoconnect=true"))
        if settings.network:
            self._write_public("network", b"")
        if settings.ethernet is not None:
            self._write_private(f"{CONNECTIONS}/ethernet.nmconnection", ethernet_profile(settings.ethernet))

    def _apply_update_settings(self) -> None:
        if (updates := self.kept / UPDATES).exists():
            shutil.copyfile(updates, self.root / "etc/diffuscope" / UPDATES)

    def _apply_ssh(self, settings: CardSettings) -> None:
        """Write the confirmed keys, and create the host key once; ssh.service runs only if the file of keys exists."""
        asked = () if settings.ssh is None else settings.ssh.keys
        self._write_public(ssh_keys.FILE, json.dumps(asked).encode())
        keys = ssh_keys.confirmed_keys(asked, self.root / "data/captures")
        if not keys:
            return
        if not (self.kept / HOST_KEY).exists():
            words = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(self.kept / HOST_KEY)]
            subprocess.run(words, check=True)
        self._write_private("run/diffuscope-ssh/authorized_keys", "".join(f"{key}\n" for key in keys))

    def _publish(self, problem: DiffuscopeError | None) -> None:
        """Write the problem for the page and onto the console, or remove an earlier one."""
        console = self.root / "run/issue.d/settings.issue"
        for file in (self.root / OUTPUT / "problem.json", console):
            file.unlink(missing_ok=True)
        if problem is not None:
            text = f"\n  The settings of the card were not taken: {problem.message}\n  {problem.remedy}\n\n"
            self._write_private("run/issue.d/settings.issue", text)
            content = json.dumps({"message": problem.message, "remedy": problem.remedy})
            self._write_public("problem.json", content.encode())

    def _write_public(self, name: str, content: bytes) -> None:
        """Write a file into OUTPUT, readable for every user; the umask of the unit is 077."""
        folder = self.root / OUTPUT
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o755)
        (folder / name).write_bytes(content)
        (folder / name).chmod(0o644)

    def _write_private(self, name: str, content: str) -> None:
        atomic_io.make_folder((self.root / name).parent)
        atomic_io.write_atomically_unsynced(self.root / name, content.encode())


def _attempt(step: Callable[[], DiffuscopeError | None]) -> DiffuscopeError | None:
    """Return the problem of a step; an unexpected exception is one, too, because the device has to start."""
    try:
        with _expected():
            return step()
    except DiffuscopeError as error:
        return error


@contextmanager
def _expected() -> Iterator[None]:
    try:
        yield
    except DiffuscopeError:
        raise
    except Exception as error:  # of any kind: otherwise the boot would end without its report
        message = f"the settings cannot be used: {type(error).__name__}: {error}"
        raise SpecError(message, f"Write {FILE} onto the card again. If this stays, call the technician.") from error


def wifi_profile(wifi: Wifi) -> str:
    """Return the NetworkManager profile (keyfile) of a Wi-Fi network."""
    security = f"\n[wifi-security]\nkey-mgmt=wpa-psk\npsk={_escaped(wifi.password)}\n" if wifi.password else ""
    head = f"[connection]\nid=wifi\ntype=wifi\n\n[wifi]\nmode=infrastructure\nssid={_escaped(wifi.name)}\n"
    return f"{head}{security}\n[ipv4]\nmethod=auto\n"


def ethernet_profile(ethernet: Ethernet) -> str:
    """Return the NetworkManager profile (keyfile) of a fixed Ethernet address."""
    gateway = f",{ethernet.gateway}" if ethernet.gateway else ""
    dns = f"dns={';'.join(map(str, ethernet.dns))};\n" if ethernet.dns else ""
    address = f"address1={ethernet.address}{gateway}\n"
    return f"[connection]\nid=ethernet\ntype=ethernet\n\n[ethernet]\n\n[ipv4]\nmethod=manual\n{address}{dns}"


def _escaped(text: str) -> str:
    """Return a value of a keyfile: backslashes doubled, a leading space as an escape (GLib key files)."""
    doubled = text.replace("\\", "\\\\")
    return f"\\s{doubled[1:]}" if doubled.startswith(" ") else doubled


def _from_root(path: Path, root: Path) -> Path:
    return Path("/") / path.relative_to(root)
