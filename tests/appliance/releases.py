"""Releases for tests: built by the release recipe, signed with test keys."""

import random
import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.appliance.device import run
from tests.project_files import ROOT

BROKEN = '"""A release that dies as soon as it is asked to serve."""\n\nraise SystemExit("broken release")\n'
IMPATIENT = 'sticks = "/media"\npatience_s = 25.0\n'  # a broken release uses the whole timeout


@dataclass(frozen=True)
class Workshop:
    """Folder in which bundles are built."""

    folder: Path

    @property
    def keys(self) -> Path:
        return self.folder / "keys"

    def bundle(self, version: str, files: dict[str, str] | None = None) -> Path:
        """Build a signed release of this checkout as `version`; `files` replace some of its files."""
        overlay, out = self.folder / f"overlay-{version}", self.folder / f"diffuscope-{version}.raucb"
        overlay.mkdir()
        for name, content in {"etc/diffuscope/head.env": "HEAD=sim\n", **(files or {})}.items():
            (overlay / name).parent.mkdir(parents=True, exist_ok=True)
            (overlay / name).write_text(content)
        words = ["--keys", self.keys, "--format", "plain", "--version", version, "--overlay", overlay, "-o", out]
        run(ROOT / "systemd" / "image" / "bundle", *words)
        return out

    def image(self, bundle: Path) -> Path:
        """Return the root file system of a bundle."""
        folder = self.folder / f"{bundle.stem}-content"
        run("unsquashfs", "-q", "-n", "-d", folder, bundle, "rootfs.img")
        return folder / "rootfs.img"

    def small(
        self,
        name: str,
        version: str,
        compatible: str = "diffuscope-pi5",
        keys: Path | None = None,
        minimum: str = "0.9",
        noise_bytes: int = 12_000_000,
        boot: bytes | None = None,
    ) -> Path:
        """Build a bundle with a small file system of a version file and noise, fast to write and check."""
        keys, folder, out = keys or self.keys, self.folder / f"{name}-parts", self.folder / f"{name}.raucb"
        (folder / "tree").mkdir(parents=True)
        (folder / "tree" / "version").write_text(version)
        (folder / "tree" / "noise").write_bytes(random.randbytes(noise_bytes))
        run("mksquashfs", folder / "tree", folder / "rootfs.img", "-quiet", "-no-progress", "-comp", "zstd")
        subprocess.run(["rm", "-r", str(folder / "tree")], check=True)
        (folder / "manifest.raucm").write_text(
            f"[update]\ncompatible={compatible}\nversion={version}\ndescription=updates from {minimum} or newer\n\n"
            "[bundle]\nformat=plain\n\n[image.rootfs]\nfilename=rootfs.img\n"
            + ("" if boot is None else "\n[image.boot]\nfilename=boot.img\n")
        )
        if boot is not None:
            (folder / "boot.img").write_bytes(boot)
        signer = ("--cert", keys / "signer.crt", "--key", keys / "signer.key", "--keyring", keys / "ca.crt")
        run("rauc", *signer, "bundle", folder, out)
        return out


def opened(folder: Path) -> Workshop:
    """Return a workshop with its own keys."""
    folder.mkdir(parents=True, exist_ok=True)
    run(ROOT / "systemd" / "image" / "keys", folder / "keys")
    return Workshop(folder)
