"""What is inside a root filesystem, as a CycloneDX list: every Debian package and every Python package.

Run by `systemd/image/bundle`: `python systemd/image/sbom.py ROOT VERSION GIT_ID` writes JSON to standard output. It
reads what lies in the root, not what was asked for. Standard library only.
"""

import json
import re
import sys
from collections.abc import Iterator
from email import message_from_string
from email.message import Message
from pathlib import Path


def debian(root: Path) -> Iterator[dict[str, object]]:
    """The packages that dpkg has installed."""
    for paragraph in (root / "var/lib/dpkg/status").read_text(encoding="utf-8").split("\n\n"):
        said = message_from_string(paragraph)
        if said["Status"] == "install ok installed":
            name, version, arch = said["Package"], said["Version"], said["Architecture"]
            purl = f"pkg:deb/debian/{name}@{version}?arch={arch}"
            yield {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}


def python(root: Path) -> Iterator[dict[str, object]]:
    """The packages in the virtual environment."""
    for metadata in root.glob("opt/diffuscope/.venv/lib/python*/site-packages/*.dist-info/METADATA"):
        said = message_from_string(metadata.read_text(encoding="utf-8"))
        name = re.sub(r"[-_.]+", "-", said["Name"]).lower()
        purl = f"pkg:pypi/{name}@{said['Version']}"
        found = {"type": "library", "bom-ref": purl, "name": said["Name"], "version": said["Version"], "purl": purl}
        licence = licence_of(said)
        yield found | ({"licenses": [{"license": {"name": licence}}]} if licence else {})


def licence_of(said: Message) -> str:
    """What a package says of its licence: the expression, else the classifiers, else the first line of its text."""
    classifiers = [str(c).split(" :: ")[-1] for c in said.get_all("Classifier", []) if str(c).startswith("License ::")]
    return str(said["License-Expression"] or " / ".join(classifiers) or (said["License"] or "").split("\n")[0])


def bill(root: Path, version: str, git_id: str) -> dict[str, object]:
    """The whole list; its order does not depend on the disk."""
    parts = sorted([*debian(root), *python(root)], key=lambda part: str(part["purl"]))
    about = {"type": "firmware", "bom-ref": "diffuscope", "name": "diffuscope", "version": version}
    about["properties"] = [{"name": "git", "value": git_id}]  # type: ignore[assignment]
    return {
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "metadata": {"component": about},
        "components": parts,
    }  # fmt: skip


if __name__ == "__main__":
    sys.stdout.write(json.dumps(bill(Path(sys.argv[1]), sys.argv[2], sys.argv[3]), indent=1) + "\n")
