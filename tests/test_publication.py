"""Rules of the files for publication: version, changelog, citation, licences, workflow, and the page of the package."""

import json
import re
import tomllib
from fnmatch import fnmatch

from tests.project_files import ROOT, files, text
from tests.test_project_files import make_targets

PROJECT = tomllib.loads(text("pyproject.toml"))["project"]
KINDS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}  # of Keep a Changelog


def test_version_is_that_of_the_newest_release_and_of_the_citation() -> None:
    """The version is written in pyproject.toml; `make release` tags the commit where the three are equal."""
    first, newest = re.findall(r"^## (.+)$", text("CHANGELOG.md"), re.M)[:2]
    assert first == "Unreleased"
    version, date = newest.split(" - ")
    cited = dict(re.findall(r'^([a-z-]+): "?([^"\n]+)"?$', text("CITATION.cff"), re.M))
    assert version == PROJECT["version"] == cited["version"]
    assert date == cited["date-released"]


def test_changelog_has_releases_in_order_and_known_kinds_of_changes() -> None:
    """Sections: Unreleased, then versions with dates, newest first; in each, the kinds of Keep a Changelog."""
    releases = re.findall(r"^## (?!Unreleased$)(.+)$", text("CHANGELOG.md"), re.M)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ - \d{4}-\d\d-\d\d", release) for release in releases)
    numbers = [tuple(map(int, release.split(" - ")[0].split("."))) for release in releases]
    assert numbers == sorted(set(numbers), reverse=True)
    assert set(re.findall(r"^### (.+)$", text("CHANGELOG.md"), re.M)) <= KINDS


def test_workflow_runs_make_targets_that_exist() -> None:
    """A step of the workflow is a make target, one of a list of targets, or a preparation of git."""
    workflow = text(".github/workflows/ci.yml")
    steps = re.findall(r"run: (.+)$", workflow, re.M)
    listed = [name for names in re.findall(r"target: \[(.+)\]", workflow) for name in names.split(", ")]
    called = [step.removeprefix("make ") for step in steps if step.startswith("make ")]
    assert {"lint", "test", "${{ matrix.target }}"} <= set(called)
    assert not [name for name in {*called, *listed} - {"${{ matrix.target }}"} if name not in make_targets()]
    assert all(step.startswith(("make ", "git config ")) for step in steps)
    assert "secrets." not in workflow


def test_every_licence_has_its_text_and_every_text_a_file() -> None:
    """REUSE.toml covers all files; the licences of installed files are those of the package."""
    tables = tomllib.loads(text("REUSE.toml"))["annotations"]
    used = {table["SPDX-License-Identifier"] for table in tables}
    assert tables[0]["path"] == "**"
    assert {f"LICENSES/{name}.txt" for name in used} == {name for name in files() if name.startswith("LICENSES/")}
    assert set(PROJECT["license"].split(" AND ")) == used - {"CERN-OHL-P-2.0"}
    paths = [path for table in tables for path in [table["path"]] if isinstance(path, str)]
    paths += [path for table in tables if isinstance(table["path"], list) for path in table["path"]]
    there = [*files(), *(path.relative_to(ROOT).as_posix() for path in (ROOT / "web" / "vendor").iterdir())]
    assert not [path for path in paths if not any(fnmatch(name, path) for name in there)]


def test_code_of_others_has_the_licence_that_it_came_with() -> None:
    """VENDOR.json and REUSE.toml agree."""
    licences = {
        path: table["SPDX-License-Identifier"]
        for table in tomllib.loads(text("REUSE.toml"))["annotations"]
        for path in table["path"]
    }
    for part in json.loads((ROOT / "web" / "vendor" / "VENDOR.json").read_text(encoding="utf-8")):
        assert licences[f"web/vendor/{part['file']}"] == licences[f"web/vendor/{part['licence_file']}"]
        assert licences[f"web/vendor/{part['file']}"] == part["licence"]


def test_page_of_the_package_needs_no_file_beside_it() -> None:
    """A package index shows the page alone, so it has no relative link and no relative picture."""
    assert not re.findall(r"\]\((?!https?://)[^)]*\)", text(PROJECT["readme"]))
