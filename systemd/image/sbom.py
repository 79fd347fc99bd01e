"""Software bill of materials (CycloneDX) of a root file system: every Debian and every Python package.

Run by `systemd/image/release`: `python systemd/image/sbom.py ROOT VERSION GIT_ID` writes JSON to standard output. The
source is the content of the root, not the list of requested packages; Python packages that are not those of the lock
file are an error. Standard library only.
"""

import json
import re
import sys
from collections.abc import Iterable, Iterator
from email import message_from_string
from email.message import Message
from pathlib import Path

LOCK = Path(__file__).with_name("requirements.lock")


def debian(root: Path) -> Iterator[dict[str, object]]:
    """Yield the packages that dpkg has installed."""
    for paragraph in (root / "var/lib/dpkg/status").read_text(encoding="utf-8").split("\n\n"):
        fields = message_from_string(paragraph)
        if fields["Status"] == "install ok installed":
            name, version, arch = fields["Package"], fields["Version"], fields["Architecture"]
            purl = f"pkg:deb/debian/{name}@{version}?arch={arch}"
            yield {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}


def python(root: Path) -> Iterator[dict[str, object]]:
    """Yield the packages of the virtual environment."""
    for metadata in root.glob("opt/diffuscope/.venv/lib/python*/site-packages/*.dist-info/METADATA"):
        fields = message_from_string(metadata.read_text(encoding="utf-8"))
        name = re.sub(r"[-_.]+", "-", fields["Name"]).lower()
        purl = f"pkg:pypi/{name}@{fields['Version']}"
        found = {"type": "library", "bom-ref": purl, "name": fields["Name"], "version": fields["Version"], "purl": purl}
        licence = licence_of(fields)
        yield found | ({"licenses": [{"license": {"name": licence}}]} if licence else {})


def licence_of(fields: Message) -> str:
    """Return a package's licence: the expression, else the classifiers, else the first line of the text."""
    classifiers = [
        str(c).split(" :: ")[-1] for c in fields.get_all("Classifier", []) if str(c).startswith("License ::")
    ]
    return str(fields["License-Expression"] or " / ".join(classifiers) or (fields["License"] or "").split("\n")[0])


def differences(found: Iterable[dict[str, object]], lock: str) -> list[str]:
    """Return the packages that differ from a lock file; one with a marker may be missing on this system."""
    locked: dict[str, set[str]] = {}
    for name, version in re.findall(r"^([a-z0-9-]+)==([^\s;]+)", lock, re.MULTILINE):
        locked.setdefault(name, set()).add(version)
    needed = set(re.findall(r"^([a-z0-9-]+)==[^\s;]+ *\\?$", lock, re.MULTILINE))
    there = {re.sub(r"[-_.]+", "-", str(part["name"])).lower(): str(part["version"]) for part in found}
    wrong = [
        f"{name} {version} is not locked" for name, version in there.items() if version not in locked.get(name, ())
    ]
    return sorted(wrong + [f"{name} is missing" for name in needed - there.keys()])


def bill(root: Path, version: str, git_id: str) -> dict[str, object]:
    """Return the bill of materials; its order does not depend on the file system."""
    parts = sorted([*debian(root), *python(root)], key=lambda part: str(part["purl"]))
    about = {"type": "firmware", "bom-ref": "diffuscope", "name": "diffuscope", "version": version}
    about["properties"] = [{"name": "git", "value": git_id}]  # type: ignore[assignment]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": about},
        "components": parts,
    }


if __name__ == "__main__":
    if wrong := differences(python(Path(sys.argv[1])), LOCK.read_text(encoding="utf-8")):
        sys.exit("\n".join(wrong))
    sys.stdout.write(json.dumps(bill(Path(sys.argv[1]), sys.argv[2], sys.argv[3]), indent=1) + "\n")
