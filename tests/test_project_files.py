"""Rules of the files beside the code: heads, error tree, make targets, wheel, READMEs, paths, systemd units."""

import ast
import builtins
import configparser
import posixpath
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from os.path import normpath
from pathlib import Path

import pytest
import typer

import device.errors
import services.errors
from device.config.head_file import load_head
from device.drivers.exposure_retry import FRAME_TIMEOUT_S
from device.drivers.pi_camera import OPEN_TIMEOUT_S
from device.errors import SettingError
from services.cli import app
from services.health import clock_request
from services.http.connection_limits import ConnectionLimits
from services.instrument.time_budget import SHUTDOWN_TIMEOUT_S
from services.instrument.watchdog import BEAT_S
from services.records.capture import BUDGET_S
from services.research.named_files import head_file
from services.update.command import app as update_app
from services.update.ipc import REQUEST_FILE, TABLET
from services.update.settings import UpdateSettings
from services.update.settings import load_settings as load_settings
from tests.golden.command_line import subcommands
from tests.hard.__main__ import app as hard
from tests.paper.__main__ import app as paper
from tests.project_files import BIN, ROOT, TOP_FOLDERS, Violation, check_rule, files, nodes, python_files, text


def test_every_head_and_every_scene_loads() -> None:
    """Every head file and every scene can be loaded, and their names differ."""
    tomls = [name for name in files() if re.fullmatch(r"(hardware/heads|device/sim/scenes)/[^/]+\.toml", name)]
    assert {Path(name).parent.name for name in tomls} == {"heads", "scenes"}
    names = [load_head(ROOT / name).name for name in tomls]
    assert len(set(names)) == len(names), "two heads of one name cannot be told apart on the page"


ERRORS = {
    kind
    for module in (device.errors, services.errors)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Exception)
}


def test_the_error_tree_is_the_one_in_the_docstring() -> None:
    """The drawings in the docstrings of both errors.py show every error with its base class."""
    drawn: dict[str, list[str]] = {}
    branch: list[str] = []
    for indent, name, builtin in re.findall(
        r"^([│├└─ ]*)([A-Z]\w+)(?: \((\w+)\))?(?: {2,}.*)?$",
        f"{device.errors.__doc__}{services.errors.__doc__}",
        re.M,
    ):
        branch[len(indent) // 4 :] = [name]
        drawn[name] = [branch[-2] if len(branch) > 1 else "Exception", *([builtin] if builtin else [])]
    assert drawn == {kind.__name__: [base.__name__ for base in kind.__bases__] for kind in ERRORS}


def test_every_error_has_its_own_code_and_every_leaf_its_own_remedy() -> None:
    """Each leaf has a remedy for the operator, and each error a code of its own for the log."""
    assert len({kind.__dict__["code"] for kind in ERRORS}) == len(ERRORS)
    for leaf in (kind for kind in ERRORS if not kind.__subclasses__()):
        assert re.fullmatch(r"[A-Z].{20,}\.", leaf.__dict__.get("default_remedy", "")), f"{leaf.__name__} has no remedy"


def new_errors(source: str) -> Iterator[Violation]:
    for node in nodes(source):
        if isinstance(node, ast.ClassDef):
            bases = {ast.unparse(base).split(".")[-1] for base in node.bases}
            builtin = {name for name in vars(builtins) if name.endswith(("Error", "Exception"))}
            if bases & ({kind.__name__ for kind in ERRORS} | builtin):
                yield node.lineno, node.name, "an error outside the tree"


def test_all_errors_are_in_one_tree() -> None:
    """HTTP maps each error class to a status in one table, so the tree is in two files, of device and services."""
    tree = {"device/errors.py", "services/errors.py"}
    sources = [name for name in python_files("device", "services") if name not in tree]
    check_rule(new_errors, sources, {}, "errors are defined in device/errors.py and services/errors.py")


def make_targets() -> dict[str, str]:
    """Return the make targets, each with its explanation."""
    rows = re.findall(r"^([a-z][\w-]*):[^=\n]*?(?:## *(.*))?$", text("Makefile"), re.M)
    return dict(rows)


def test_every_make_target_has_an_explanation() -> None:
    """`make help` prints one sentence for each target."""
    targets = make_targets()
    assert {"run", "test", "bench", "lint", "clean"} <= set(targets)
    assert not [name for name, sentence in targets.items() if not re.fullmatch(r"[A-Z].{10,}\.", sentence)]
    phony = re.search(r"^\.PHONY: (.*)$", text("Makefile"), re.M)
    assert phony is not None
    assert set(phony[1].split()) == set(targets)


def pytest_arguments(target: str) -> list[str]:
    """Return the files and folders of a make target for pytest; `make -n` prints the commands without running them."""
    printed = subprocess.run(["make", "-n", target], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    commands = [shlex.split(line) for line in printed.splitlines() if "-m pytest" in line]
    return [word for words in commands for word in words if re.match(r"tests(/|$)", word)]


def test_every_test_file_is_run_by_a_make_target_that_names_it_once() -> None:
    """pytest drops a file that is named beside a folder that holds it, and then leaves out what that folder ignores."""
    named = {target: pytest_arguments(target) for target in make_targets() if target.startswith("test")}
    twice = [
        (target, path, other) for target, all in named.items() for path in all for other in all if f"{path}/" in other
    ]
    assert not twice
    run = [path for all in named.values() for path in all]
    tests = [name for name in files() if re.fullmatch(r"tests/(.+/)?test_\w+\.py", name)]
    assert not [name for name in tests if not any(name == path or name.startswith(f"{path}/") for path in run)]


def test_make_clean_removes_all_that_git_ignores() -> None:
    """Everything in .gitignore is generated and can be generated again."""
    recipe = text("Makefile").split("\nclean:")[1].split("\n\n")[0]
    assert not [line for line in text(".gitignore").split() if line.rstrip("/") not in recipe]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the content of the built wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as packed:
        packed.extractall(folder / "site-packages")
    return folder / "site-packages"


def test_the_wheel_holds_what_the_instrument_needs_at_run_time(wheel: Path) -> None:
    """The wheel contains the page, migrations, scenes and heads, which are not Python files."""
    held = {path.relative_to(wheel).as_posix() for path in wheel.rglob("*")}
    moved = tomllib.loads(text("pyproject.toml"))["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    code = {name for name in files() if re.match(r"(device|services)/(?!research/site/)", name)} - set(moved)
    beside = {name for name in files() if re.match(r"web/|hardware/(heads/|optics.toml)|CHANGELOG.md", name)}
    beside |= {f"web/vendor/{path.name}" for path in (ROOT / "web" / "vendor").glob("*.js")}
    assert (code | {*moved.values()} | {f"diffuscope/{name}" for name in beside}) - held == set()


def test_the_wheel_installs_no_common_name_into_site_packages(wheel: Path) -> None:
    """Names such as `web`, `hardware` or CHANGELOG.md could collide with other packages."""
    assert {path.name for path in wheel.iterdir() if not path.name.endswith(".dist-info")} == {
        "device",
        "services",
        "diffuscope",
    }


@pytest.mark.parametrize("installed", ["wheel", "editable"])
def test_diffuscope_is_imported_and_finds_its_page(wheel: Path, installed: str) -> None:
    first = f"import sys; sys.path.insert(0, {str(wheel)!r}); " if installed == "wheel" else ""
    asked = "import diffuscope; from services import resources as r; print(diffuscope.__version__, r.ROOT)\n"
    there = "assert all(p.exists() for p in (r.WEB / 'index.html', r.HEADS / 'sim.toml', r.LIGHT_PATH, r.CHANGELOG))"
    command = [sys.executable, "-c", first + asked + there]
    answer = subprocess.run(command, cwd=wheel.parent, check=True, capture_output=True, text=True).stdout.split()
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    assert answer == [version, str(wheel / "diffuscope" if installed == "wheel" else ROOT)]


def test_a_release_holds_what_the_program_needs_and_nothing_that_was_not_tested() -> None:
    """Both lock files, written by `make lock`, cover the dependencies of the program."""
    whole, drivers, release = (
        set(re.findall(r"^([a-z0-9.-]+==[^ ]+)", text(name), re.M))
        for name in ("requirements.lock", "tests/ports/emulators/requirements.lock", "systemd/image/requirements.lock")
    )
    project = tomllib.loads(text("pyproject.toml"))["project"]
    needed = project["dependencies"] + project["optional-dependencies"]["instrument"]
    names = {re.split(r"[^A-Za-z0-9-]", requirement)[0].lower() for requirement in needed}
    assert names <= {pin.split("==")[0] for pin in release}, "make lock"
    untested = {pin.split("==")[0] for pin in release - whole - drivers}
    assert untested <= {"gpiod"}, "make lock"  # tests use a stand-in: the library needs the GPIO chip of a kernel


# READMEs and decision records


def readmes() -> list[str]:
    return [name for name in files() if Path(name).name == "README.md"]


def documents() -> list[str]:
    """Return the READMEs, CONTRIBUTING.md and the policies."""
    return readmes() + [name for name in files() if re.fullmatch(r"CONTRIBUTING\.md|\.github/[^/]+\.md", name)]


def code_in(markdown: str) -> list[str]:
    """Return every line of fenced code, with continued lines joined, and every code span."""
    fences = re.findall(r"^```\w*\n(.*?)^```", markdown, re.M | re.S)
    lines = [line for fence in fences for line in fence.replace("\\\n", " ").splitlines()]
    return lines + re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", markdown, flags=re.M | re.S))


@cache
def commands() -> dict[str, set[str]]:
    """Return the commands of `diffuscope`, subcommands included, each with its options."""
    outer = dict(subcommands(typer.main.get_group(app)))
    outer |= {"paper": typer.main.get_command(paper), "hard": typer.main.get_command(hard)}
    inner = [(f"{name} {second}", command) for name, parent in outer.items() for second, command in subcommands(parent)]
    return {
        name: {"--help"}.union(*(p.opts + p.secondary_opts for p in command.params))
        for name, command in [*outer.items(), *inner]
    }


def unknown_words(command_line: str) -> list[str]:
    """Return the commands and options of a command line that `diffuscope` does not have."""
    known = commands()
    found = re.search(r"\bdiffuscope ([a-z][\w-]*)((?: [a-z][\w-]*)?)(.*)", command_line)
    if found is None:
        return []
    word = found[1] + found[2] if any(name.startswith(f"{found[1]} ") for name in known) else found[1]
    if word not in known:
        return [word]
    return [o for o in re.findall(r"(?<!\S)--?[a-z][\w-]*", found[3]) if o not in known[word]]


def test_a_wrong_command_line_is_noticed() -> None:
    assert unknown_words("diffuscope fly") == ["fly"]
    assert unknown_words(".venv/bin/diffuscope run --port 1 --fly=1 -y") == ["--fly", "-y"]
    assert unknown_words("diffuscope calibrations fly --archive a") == ["calibrations fly"]
    assert unknown_words("diffuscope calibrations use 0f --archive a --fly") == ["--fly"]
    assert unknown_words("diffuscope reconstruct a.tiff --psf p.tiff -o out.png") == []
    assert unknown_words("diffuscope calibrations") == []


@pytest.mark.parametrize("readme", documents())
def test_commands_in_a_readme_exist(readme: str) -> None:
    """Make targets, commands and options in a README or another document exist."""
    code = code_in(text(readme))
    words = [word for line in code for word in re.findall(r"(?:^|\s)make ([a-z][\w-]*)", line)]
    assert not [word for word in words if word not in make_targets()]
    assert not [word for line in code for word in unknown_words(line)]


def named_paths(markdown: str) -> set[str]:
    """Return links, code spans that begin with a top folder, and the first column of tables of files or folders."""
    named = set(re.findall(r"\]\((?!https?:|#)([^)]+)\)", markdown))
    named |= {
        span for span in re.findall(r"`([^`\s<>{}]+)`", markdown) if span.split("/")[0] in TOP_FOLDERS and "/" in span
    }
    for table in re.findall(r"^\| *(?:file|folder)s?(?: or folder)? *\|.*\n\|.*\n((?:\|.*\n?)+)", markdown, re.M):
        for row in table.splitlines():
            named |= set(re.findall(r"`([^`\s]+)`", row.split("|")[1]))
    return named


@pytest.mark.parametrize("readme", documents())
def test_paths_in_a_readme_exist(readme: str) -> None:
    """Every path that a README or another document names is in the repository."""
    there = {str(parent) for name in files() for parent in (Path(name), *Path(name).parents)}
    here = Path(readme).parent
    missing = []
    for path in sorted(named_paths(text(readme))):
        at = [normpath(base / re.split("#|::", path)[0]) for base in (Path(), here)]
        if not any(place in there or any(fnmatch(entry, place) for entry in there) for place in at):
            missing.append(path)
    assert not missing, f"{readme} names what is not there"


def test_every_folder_has_a_readme() -> None:
    """Each top folder, and each folder below device/ and services/, has a README."""
    there = {str(parent) for name in files() for parent in Path(name).parents}
    inner = {str(Path(n).parent) for n in files() if re.fullmatch(r"(device|services)/\w+/__init__\.py", n)}
    folders = {folder for folder in TOP_FOLDERS if folder in there} | inner
    assert not sorted(folder for folder in folders if f"{folder}/README.md" not in files()), "folders without a README"


MAX_README_LINES, MAX_DECISION_LINES = 60, 25


@pytest.mark.parametrize("readme", [name for name in readmes() if name != "README.md"])
def test_a_readme_is_short(readme: str) -> None:
    """A README has a purpose, a map of subfolders and how to extend; the docstring of a module describes the module."""
    assert text(readme).count("\n") <= MAX_README_LINES


@pytest.mark.parametrize("decision", [name for name in files() if "/decisions/" in name])
def test_a_decision_is_one_short_numbered_file(decision: str) -> None:
    """A decision record has a number, a title, context, decision and consequences."""
    assert re.fullmatch(r"\d{4}-[a-z0-9-]+\.md", Path(decision).name)
    assert text(decision).count("\n") <= MAX_DECISION_LINES


@pytest.mark.parametrize("folder", [folder for folder in TOP_FOLDERS if f"{folder}/README.md" in files()])
def test_a_map_names_every_folder(folder: str) -> None:
    """The README of a top folder names each of its folders."""
    there = {str(parent) for name in files() for parent in Path(name).parents}
    folders = {path for path in there if Path(path).parent == Path(folder)}
    assert not [f for f in folders if f"`{Path(f).name}/" not in text(f"{folder}/README.md")], f"folders of {folder}"


# Citations of documents: `OPTICS.md 2.6`, `NUMERICS.md 3.5, items 5, 6 and 12`, `hardware/assembly.md`

GAP, AND = r"[\s#/]+", r"(?:,|,?[\s#/]+(?:and|to))[\s#/]+"  # a citation may continue on the next line of a comment
CITATION = re.compile(
    rf"([\w./-]*\w\.md)\b[`)\]]*(?:{GAP}(\d+\.\d+(?:{AND}\d+\.\d+)*)(?:,{GAP}items?{GAP}(\d+(?:{AND}\d+)*))?)?"
)
CITING = {".py", ".toml", ".md", ".js", ".mjs", ".html", ".css", ".csv", ".yml", ".yaml", ".service", ""}
NO_DOCUMENT = {
    "hard-cases.md": "written by `diffuscope hard`",
    "diffuscope/CHANGELOG.md": "its path in the wheel",
    "decisions/NNNN-title.md": "the form of a name",
}
SITE = "services/research/site/"  # its build checks the links, some to pages that it writes


def sections(markdown: str) -> dict[str, set[str]]:
    """Return the numbered sections of a document, each with the numbers of its list; chapters are sections, too."""
    _, *parts = re.split(r"^#+ (\d+(?:\.\d+)?) .*$", markdown, flags=re.M)
    bodies = zip(parts[::2], parts[1::2], strict=True)
    return {number: set(re.findall(r"^(\d+)\. ", body, re.M)) for number, body in bodies}


def cited_documents(path: str, citing: str) -> list[str]:
    """Return the documents that a path in the file `citing` may mean: relative, from the root, or by name alone."""
    relative = posixpath.normpath(posixpath.join(posixpath.dirname(citing), path))
    exact = [name for name in files() if name in (relative, path)]
    return exact or [name for name in files() if "/" not in path and posixpath.basename(name) == path]


def wrong_citations(source: str, citing: str) -> list[str]:
    """Return the citations of documents, sections and list items that do not exist."""
    wrong = []
    for path, numbers, items in CITATION.findall(source):
        documents = cited_documents(path, citing)
        known = [sections(text(name)) for name in documents]
        cited = re.findall(r"\d+\.\d+", numbers)
        wrong += [f"{path} {number}" for number in cited if not any(number in contents for contents in known)]
        for item in re.findall(r"\d+", items):
            if not any(item in contents.get(cited[-1], ()) for contents in known):
                wrong.append(f"{path} {cited[-1]}, item {item}")
        if not documents and not path.endswith(tuple(NO_DOCUMENT)):
            wrong.append(path)
    return wrong


def test_a_wrong_citation_is_found() -> None:
    here = "device/optics/eye.py"
    right = (
        "OPTICS.md 1.1 to 1.4, the paper",
        "NUMERICS.md 3.5, items 5, 6 and 12 (shift)",
        "# OPTICS.md\n    # 2.6: T",
        "[NUMERICS.md](../recon/NUMERICS.md) 7.1",
        "`OPTICS.md`",
        "hardware/assembly.md",
        "OPTICS.md 1.2, 30 degrees",
    )
    assert [wrong_citations(citation, here) for citation in right] == [[]] * len(right)
    wrong = {
        "optics.md": ["optics.md"],
        "(OPTICS.md 1.1, 99.1 and 1.4)": ["OPTICS.md 99.1"],
        "NUMERICS.md 3.5, item 99": ["NUMERICS.md 3.5, item 99"],
        "# NUMERICS.md\n# 99.9": ["NUMERICS.md 99.9"],
        "../optics/NUMERICS.md 3.5": ["../optics/NUMERICS.md 3.5", "../optics/NUMERICS.md"],
        "](../OPTICS.md) 1.1": ["../OPTICS.md 1.1", "../OPTICS.md"],
        "notes/optics.md": ["notes/optics.md"],
    }
    assert {citation: wrong_citations(citation, here) for citation in wrong} == wrong


def test_every_citation_of_a_document_resolves() -> None:
    """Each document, section and list item that a file of the repository cites is in the repository."""
    examples = "tests/test_project_files.py"
    texts = [name for name in files() if Path(name).suffix in CITING and not name.startswith("tests/golden/kept/")]
    citing = [name for name in texts if name != examples and ".md" in text(name)]
    found = [(name, wrong) for name in citing for wrong in wrong_citations(text(name), name)]
    found = [(name, wrong) for name, wrong in found if not (name.startswith(SITE) and wrong.endswith(".md"))]
    assert not found, "\n".join(map(": ".join, found))


@pytest.mark.parametrize("document", ["device/optics/OPTICS.md", "device/recon/NUMERICS.md"])
def test_sections_of_a_document_are_numbered_in_order(document: str) -> None:
    """Sections are appended and never renumbered, so the numbers of a chapter have no gap."""
    numbers = [tuple(map(int, number.split("."))) for number in sections(text(document))]
    chapters = [number for number in numbers if len(number) == 1]
    inner = [(c[0], k) for c in chapters for k in range(1, 1 + sum(n[0] == c[0] and len(n) == 2 for n in numbers))]
    assert chapters == [(k,) for k in range(1, len(chapters) + 1)]
    assert [number for number in numbers if len(number) == 2] == inner


# Paths in other files

PATH = re.compile(
    r"(?<![\w./*{}-])(?:/opt/diffuscope/|\.\./|\./)?"
    r"((?:device|services|web|tests|hardware|systemd)/[\w./@*-]*[\w/*])(?![\w./@*-]*\{)"
)
MODULE = re.compile(r"-m ((?:device|services|tests|hardware)[\w.]*)")
BINARY = {".png", ".jpg", ".npy", ".npz", ".tiff", ".gz", ".zip", ".sqlite", ".copy", ".calibration"}


@cache
def known_paths() -> frozenset[str]:
    """Return every file and folder of the repository, Markdown files also without ending, as the site names pages."""
    paths = {str(path) for file in files() for path in (Path(file), *Path(file).parents)}
    return frozenset(paths | {file.removesuffix(".md") for file in files()} | {"web/vendor"})


def missing_paths(name: str) -> list[str]:
    """Return the paths and `-m` modules that a file names and the repository does not have."""
    there = known_paths()
    paths = {found.rstrip("./") for found in PATH.findall(text(name)) if not found.startswith("web/vendor/")}
    modules = {found.rstrip(".").replace(".", "/") for found in MODULE.findall(text(name))}
    missing = [path for path in paths if path not in there and not any(fnmatch(entry, path) for entry in there)]
    return missing + [module for module in modules if not {module, f"{module}.py"} & there]


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in files()
        if Path(name).suffix not in BINARY and not name.startswith("tests/golden/") and name != "CHANGELOG.md"
    ],
)
def test_paths_and_modules_in_a_file_exist(name: str) -> None:
    """Units, udev rules, image scripts, Makefile, docstrings and documents name files that are in the repository."""
    assert not missing_paths(name)


# systemd

HARDENING = re.findall(
    r"\w+",
    """
    NoNewPrivileges ProtectHome PrivateTmp ProtectKernelTunables ProtectKernelModules ProtectKernelLogs
    ProtectControlGroups ProtectClock RestrictSUIDSGID LockPersonality RestrictRealtime RestrictNamespaces
    """,
)


UNITS = [
    name for name in files() if re.fullmatch(r"systemd/(image/card/luks/)?[^/]+\.(service|socket|timer|path)", name)
]
IMAGE_SETTINGS = ROOT / "systemd" / "image" / "update.toml"
RESIDENT_MB, THREADS = 768, 64  # most that `make bench-attacks` and 48 clients ever took
BLANKER = "/usr/bin/python3 -I -S /opt/diffuscope/device/drivers/blank.py --device /dev/spidev0.0"


def unit_of(name: str) -> configparser.ConfigParser:
    """Return a parsed unit; of several lines with one key, the last counts."""
    unit = configparser.ConfigParser(interpolation=None, delimiters="=", comment_prefixes="#", strict=False)
    unit.optionxform = str  # type: ignore[assignment, method-assign]  # keys of systemd are case-sensitive
    unit.read_string(text(name))
    return unit


def test_the_instrument_unit_has_a_valid_command_restart_and_sandboxing() -> None:
    """The unit's command line, restart policy and sandboxing keys, also without systemd."""
    service = unit_of("systemd/diffuscope.service")["Service"]
    _, *words = shlex.split(service["ExecStart"])
    assert not unknown_words(shlex.join(["diffuscope", *words]))
    assert service["Restart"] == "always"
    real_time = ["RestrictRealtime"]  # the lamp's guardian runs at real-time priority
    assert [key for key in HARDENING if service.get(key) != "yes"] == real_time
    assert service["ProtectSystem"] == "strict"
    assert service["LimitRTPRIO"] == "1"
    assert "MemoryDenyWriteExecute" not in service, "numba compiles at run time, so memory must become executable"


def test_the_units_name_no_head_and_their_installer_asks_for_it(tmp_path: Path) -> None:
    """A device must not simulate because a line was left out: no fallback to a fake."""
    service = text("systemd/diffuscope.service")
    assert not re.search(r"^[^#]*(HEAD=|sim)", service, re.MULTILINE)
    assert "EnvironmentFile=-/etc/diffuscope/head.env\n" in service
    with pytest.raises(SettingError, match="no head is named"):
        head_file("")
    for words, message in (((), "imx296"), (("no_such_head",), "there is no head 'no_such_head'")):
        done = subprocess.run([ROOT / "systemd/install", *words], cwd=tmp_path, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (2, "")
        assert message in done.stderr


def test_the_watchdog_interval_covers_heartbeats_and_the_budget() -> None:
    """One late heartbeat is no hang; heartbeats continue during a capture of BUDGET_S."""
    service = unit_of("systemd/diffuscope.service")["Service"]
    assert service["Type"] == "notify"
    assert float(service["WatchdogSec"]) >= max(3 * BEAT_S, 2 * BUDGET_S)
    assert service["WatchdogSignal"] == "SIGKILL"
    assert float(service["TimeoutStartSec"]) >= 180


def test_the_watchdog_waits_for_a_camera_that_hangs() -> None:
    """Two frames that do not come, one close and one open; a loose cable must reach the page as an error."""
    longest_s = 2 * FRAME_TIMEOUT_S + 2 * OPEN_TIMEOUT_S + BEAT_S
    assert float(unit_of("systemd/diffuscope.service")["Service"]["WatchdogSec"]) > longest_s


def test_the_stop_timeout_covers_the_longest_capture() -> None:
    """A capture under way is finished and stored; uvicorn and the close each get one second more."""
    assert float(unit_of("systemd/diffuscope.service")["Service"]["TimeoutStopSec"]) >= SHUTDOWN_TIMEOUT_S + 2


def test_the_instrument_unit_limits_files_memory_tasks_and_log() -> None:
    """Files: every permitted connection and as many of our own; memory and tasks: twice the figures of use."""
    service = unit_of("systemd/diffuscope.service")["Service"]
    clients = ConnectionLimits().clients
    assert int(service["LimitNOFILE"]) >= 2 * (clients.local + clients.remote)
    assert int(service["MemoryMax"].removesuffix("M")) >= 2 * RESIDENT_MB
    assert int(service["TasksMax"]) >= 2 * THREADS
    lines_per_min = int(service["LogRateLimitBurst"]) * 60 / float(service["LogRateLimitIntervalSec"])
    assert lines_per_min * 1000 <= 1e6, "a log line has less than 1000 bytes"


def test_stop_boot_and_failure_call_the_same_blanker() -> None:
    """The command is the interface of device/drivers/blank.py; a lamp that stays lit is a failed unit."""
    assert unit_of("systemd/diffuscope.service")["Service"]["ExecStopPost"] == f"-+{BLANKER}"
    assert unit_of("systemd/diffuscope.service")["Unit"]["OnFailure"] == "diffuscope-dark.service"
    for name, more in {"diffuscope-blank": " --insist", "diffuscope-dark": ""}.items():
        unit = unit_of(f"systemd/{name}.service")
        assert unit["Service"]["ExecStart"] == f"{BLANKER}{more}"
        assert unit["Unit"]["ConditionPathExists"] == "/dev/spidev0.0", "a simulated head has no lamp"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_analyze_accepts_every_unit(tmp_path: Path) -> None:
    """Any output is a failure: systemd-analyze prints unknown keys and still exits with 0."""
    for name in UNITS:  # the same units, with the program that this machine has
        here = re.sub(r"/opt/diffuscope/\S+/(diffuscope|python)(?= )", rf"{BIN}/\1", text(name))
        (tmp_path / Path(name).name).write_text(here, encoding="utf-8")
    words = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", *sorted(tmp_path.iterdir())]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["diffuscope-settle", "diffuscope-update", "diffuscope-update-request"])
def test_an_update_unit_has_a_valid_command_and_sandboxing(name: str) -> None:
    """It runs as root without capabilities, on a file system that is read-only except for its state folder."""
    service = unit_of(f"systemd/{name}.service")["Service"]
    called = service["ExecStart"].removeprefix("/opt/diffuscope/.venv/bin/python -m services.update ")
    assert not unknown_words(f"diffuscope update {called}")
    assert called.split()[0] in typer.main.get_group(update_app).commands
    exempt = (
        {"ProtectKernelModules"} if name == "diffuscope-update-request" else set()
    )  # whether a version must bring its kernel
    assert {key for key in HARDENING if service.get(key) != "yes"} == exempt
    assert (service["ProtectSystem"], service["CapabilityBoundingSet"]) == ("strict", "")
    assert service["StateDirectory"] == UpdateSettings().folder.name
    assert service["StateDirectoryMode"] == "0711", "the page reads the journal in it"


def test_page_updater_and_systemd_use_the_same_folders() -> None:
    """The page writes update requests into the folder that the updater's path unit watches."""
    state, requests = str(UpdateSettings().folder), str(UpdateSettings().requests)
    instrument = unit_of("systemd/diffuscope.service")["Service"]
    assert f"--updates {state} --update-requests {requests}" in instrument["ExecStart"]
    clock = "/run/diffuscope-clock"  # where the page leaves the time of a tablet
    assert instrument["ReadWritePaths"] == f"-{clock} -{requests} -{state}/{TABLET} -/media"
    assert unit_of("systemd/diffuscope-update-request.path")["Path"]["PathExists"] == f"{requests}/{REQUEST_FILE}"
    assert unit_of("systemd/diffuscope-update-request.service")["Service"]["ReadWritePaths"] == requests
    made = [line.split() for line in text("systemd/diffuscope.tmpfiles").splitlines() if line.startswith("d ")]
    shared = ["2770", "root", "diffuscope-update", "-"]
    own = ["0711", "root", "root", "-"]
    offered = ["d", clock, "2770", "root", "diffuscope-clock", "-"]
    assert made == [["d", requests, *shared], offered, ["d", state, *own], ["d", f"{state}/{TABLET}", *shared]]
    assert unit_of("systemd/diffuscope-clock.path")["Path"]["PathExists"] == f"/{clock_request.REQUEST}"
    assert f"/{clock_request.REQUEST}".startswith(f"{clock}/")
    for group in ("diffuscope-clock", "diffuscope-update"):
        assert f"\ng {group} -\n" in text("systemd/diffuscope.sysusers")
        assert group in instrument["SupplementaryGroups"].split()


def test_an_update_on_trial_times_out_and_rolls_back() -> None:
    """The unit's timeout is longer than the updater's, and its failure reboots the device."""
    settle = unit_of("systemd/diffuscope-settle.service")
    assert settle["Unit"]["FailureAction"] == "reboot"
    assert float(settle["Service"]["TimeoutStartSec"]) >= load_settings(IMAGE_SETTINGS).patience_s + 120
    assert settle["Service"]["ExecCondition"].endswith("/services/update/bootchooser.py trying")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_instrument_unit_has_a_low_exposure_score() -> None:
    """The exposure of systemd-analyze is at most 2.0 of 10, with access to camera, lamp and buses."""
    words = ["systemd-analyze", "security", "--offline=true", "--threshold=20", "systemd/diffuscope.service"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-200:]
