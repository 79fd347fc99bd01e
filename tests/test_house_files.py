"""What stands beside the code is judged too: heads, the tree of errors, `make`, the wheel, READMEs, units."""

import ast
import builtins
import configparser
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
import typer

from device import errors
from device.spec import load_head
from services.cli import app
from services.instrument.pace import BUDGET_S, LAST_S
from services.instrument.watchdog import BEAT_S
from services.records.update_notes import TABLET, WISH
from services.update.command import app as update_app
from services.update.settings import UpdateSettings
from services.update.settings import load as load_settings
from tests.house import BIN, ROOMS, ROOT, Offence, files, judge, nodes, python, text


def test_every_head_and_every_scene_loads() -> None:
    """A head file that does not load is found here, not in the clinic."""
    tomls = [name for name in files() if re.fullmatch(r"(hardware/heads|device/sim/scenes)/[^/]+\.toml", name)]
    assert {Path(name).parent.name for name in tomls} == {"heads", "scenes"}
    names = [load_head(ROOT / name).name for name in tomls]
    assert len(set(names)) == len(names), "two heads of one name cannot be told apart on the page"


def test_the_tree_of_errors_is_the_one_that_is_drawn() -> None:
    """The drawing in errors.py is what a newcomer reads first."""
    kinds = {
        name: kind for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)
    }
    drawn: dict[str, list[str]] = {}
    branch: list[str] = []
    for indent, name, builtin in re.findall(
        r"^([│├└─ ]*)([A-Z]\w+)(?: \((\w+)\))?(?: {2,}.*)?$", errors.__doc__ or "", re.M
    ):
        branch[len(indent) // 4 :] = [name]
        drawn[name] = [branch[-2] if len(branch) > 1 else "Exception", *([builtin] if builtin else [])]
    assert drawn == {name: [base.__name__ for base in kind.__bases__] for name, kind in kinds.items()}


def test_every_error_has_its_own_code_and_every_leaf_its_own_remedy() -> None:
    """Each leaf tells the operator what to do; the code finds it in the log."""
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len({kind.__dict__["code"] for kind in kinds}) == len(kinds)
    for leaf in (kind for kind in kinds if not kind.__subclasses__()):
        assert re.fullmatch(r"[A-Z].{20,}\.", leaf.__dict__.get("default_remedy", "")), f"{leaf.__name__} has no remedy"


def new_errors(source: str) -> Iterator[Offence]:
    for node in nodes(source):
        if isinstance(node, ast.ClassDef):
            bases = {ast.unparse(base).split(".")[-1] for base in node.bases}
            if bases & ({*vars(errors)} | {n for n in vars(builtins) if n.endswith(("Error", "Exception"))}) - {
                "ClassVar"
            }:
                yield node.lineno, node.name, "an error outside the tree"


def test_errors_grow_on_one_tree() -> None:
    """The API maps class to status in one table, which can only be whole if the tree is in one place."""
    rooms = [name for name in python("device", "services") if name != "device/errors.py"]
    judge(new_errors, rooms, {}, "errors live in device/errors.py")


def make_targets() -> dict[str, str]:
    """The words of `make`, each with its explanation."""
    rows = re.findall(r"^([a-z][\w-]*):[^=\n]*?(?:## *(.*))?$", text("Makefile"), re.M)
    return dict(rows)


def test_every_make_word_explains_itself() -> None:
    """`make help` prints them; a word without a sentence is a riddle."""
    targets = make_targets()
    assert {"run", "test", "bench", "lint", "clean"} <= set(targets)
    assert not [name for name, sentence in targets.items() if not re.fullmatch(r"[A-Z].{10,}\.", sentence)]
    phony = re.search(r"^\.PHONY: (.*)$", text("Makefile"), re.M)
    assert phony is not None
    assert set(phony[1].split()) == set(targets)


def test_make_clean_removes_all_that_git_ignores() -> None:
    """What git is told to overlook was made here, and can be made again."""
    recipe = text("Makefile").split("\nclean:")[1].split("\n\n")[0]
    assert not [line for line in text(".gitignore").split() if line.rstrip("/") not in recipe]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the wheel lays into site-packages."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as packed:
        packed.extractall(folder / "site-packages")
    return folder / "site-packages"


def test_the_wheel_holds_what_the_instrument_needs_at_run_time(wheel: Path) -> None:
    """Page, migrations, scenes and heads are not Python, and are easily left behind."""
    held = {path.relative_to(wheel).as_posix() for path in wheel.rglob("*")}
    code = {name for name in files() if re.match(r"(device|services)/(?!pictures/)", name)} - {"services/package.py"}
    beside = {name for name in files() if re.match(r"web/|hardware/(heads/|optics.toml)|CHANGELOG.md", name)}
    beside |= {f"web/vendor/{path.name}" for path in (ROOT / "web" / "vendor").glob("*.js")}
    assert (code | {f"diffuscope/{name}" for name in beside}) - held == set()


def test_the_wheel_lays_no_common_name_into_site_packages(wheel: Path) -> None:
    """`web` is a library of others, and `hardware` or a changelog belongs to nobody there."""
    assert {path.name for path in wheel.iterdir() if not path.name.endswith(".dist-info")} == {
        "device", "services", "diffuscope",
    }  # fmt: skip


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
    """`make lock` writes both lists; one that is forgotten is found here, not by a device that does not start."""
    whole, release = (
        set(re.findall(r"^([a-z0-9.-]+==[^ ]+)", text(name), re.M))
        for name in ("requirements.lock", "systemd/image/requirements.lock")
    )
    needed = tomllib.loads(text("pyproject.toml"))["project"]["dependencies"]
    names = {re.split(r"[^A-Za-z0-9-]", wish)[0].lower() for wish in needed}
    assert names <= {pin.split("==")[0] for pin in release}, "make lock"
    assert release <= whole, "make lock"


# READMEs


def readmes() -> list[str]:
    return [name for name in files() if Path(name).name == "README.md"]


def code_in(markdown: str) -> list[str]:
    """Every line of fenced code, continued lines joined, and every code span."""
    fences = re.findall(r"^```\w*\n(.*?)^```", markdown, re.M | re.S)
    lines = [line for fence in fences for line in fence.replace("\\\n", " ").splitlines()]
    return lines + re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", markdown, flags=re.M | re.S))


def commands() -> dict[str, set[str]]:
    """The words of `diffuscope`, also those of two words, each with its options."""
    group = typer.main.get_group(app)
    inner = [(f"{name} {second}", command) for name, outer in group.commands.items()
             for second, command in getattr(outer, "commands", {}).items()]  # fmt: skip
    return {
        name: {"--help"}.union(*(p.opts + p.secondary_opts for p in command.params))
        for name, command in [*group.commands.items(), *inner]
    }


def unknown_words(command_line: str) -> list[str]:
    """What a command line says that `diffuscope` does not know."""
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


@pytest.mark.parametrize("readme", readmes())
def test_commands_in_a_readme_exist(readme: str) -> None:
    """The first command that fails is the last one that a newcomer tries."""
    code = code_in(text(readme))
    words = [word for line in code for word in re.findall(r"(?:^|\s)make ([a-z][\w-]*)", line)]
    assert not [word for word in words if word not in make_targets()]
    assert not [word for line in code for word in unknown_words(line)]


def named_paths(markdown: str) -> set[str]:
    """Links and pictures, spans that begin with a room, and the first column of a table of files, rooms or folders."""
    named = set(re.findall(r"\]\((?!https?:|#)([^)]+)\)", markdown))
    named |= {span for span in re.findall(r"`([^`\s<>{}]+)`", markdown) if span.split("/")[0] in ROOMS and "/" in span}
    for table in re.findall(r"^\| *(?:file|room|folder)s? *\|.*\n\|.*\n((?:\|.*\n?)+)", markdown, re.M):
        for row in table.splitlines():
            named |= set(re.findall(r"`([^`\s]+)`", row.split("|")[1]))
    return named


@pytest.mark.parametrize("readme", readmes())
def test_paths_in_a_readme_exist(readme: str) -> None:
    """A map with a street that is not there is worse than none."""
    there = {str(parent) for name in files() for parent in (Path(name), *Path(name).parents)}
    here = Path(readme).parent
    missing = []
    for path in sorted(named_paths(text(readme))):
        at = [str(base / path.split("#")[0]) for base in (Path(), here)]
        if not any(place in there or any(fnmatch(one, place) for one in there) for place in at):
            missing.append(path)
    assert not missing, f"{readme} names what is not there"


def test_every_room_has_a_readme() -> None:
    """Each room has a short README: its map, how to extend it, dated decisions."""
    there = {str(parent) for name in files() for parent in Path(name).parents}
    inner = {str(Path(n).parent) for n in files() if re.fullmatch(r"(device|services)/\w+/__init__\.py", n)}
    rooms = {room for room in ROOMS if room in there} | inner
    assert not sorted(room for room in rooms if f"{room}/README.md" not in files()), "rooms without a README"


@pytest.mark.parametrize("readme", readmes())
def test_a_map_names_every_module_beside_it(readme: str) -> None:
    """Tests are named after what they prove; everything else is found through the map."""
    beside = [
        Path(name) for name in files() if Path(name).parent == Path(readme).parent and name.endswith((".py", ".js"))
    ]
    named = text(readme)
    ours = [path.name for path in beside if not path.name.startswith(("test_", "__", "conftest"))]
    assert not [name for name in ours if not re.search(rf"\b{re.escape(Path(name).stem)}\b", named)]


@pytest.mark.parametrize("room", [room for room in ROOMS if f"{room}/README.md" in files()])
def test_a_map_names_every_folder(room: str) -> None:
    """A folder that is not on the map was put there without saying what for."""
    there = {str(parent) for name in files() for parent in Path(name).parents}
    folders = {path for path in there if Path(path).parent == Path(room)}
    assert not [f for f in folders if f"`{Path(f).name}/" not in text(f"{room}/README.md")], f"folders of {room}"


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
BLANKER = "/usr/bin/python3 -I -S /opt/diffuscope/device/drivers/blank.py --device /dev/spidev0.0"


def unit_of(name: str) -> configparser.ConfigParser:
    """The last of several lines of one key counts here; for the tests that look at keys that is enough."""
    unit = configparser.ConfigParser(interpolation=None, delimiters="=", comment_prefixes="#", strict=False)
    unit.optionxform = str  # type: ignore[assignment, method-assign]  # keys of systemd are case-sensitive
    unit.read_string(text(name))
    return unit


def test_the_instrument_is_started_with_words_that_exist_restarted_and_locked_in() -> None:
    """Sections, keys and the command line, also where there is no systemd."""
    service = unit_of("systemd/diffuscope.service")["Service"]
    _, *words = shlex.split(service["ExecStart"])
    assert not unknown_words(shlex.join(["diffuscope", *words]))
    assert service["Restart"] == "always"
    assert not [key for key in HARDENING if service.get(key) != "yes"]
    assert service["ProtectSystem"] == "strict"
    assert "MemoryDenyWriteExecute" not in service, "numba compiles at run time, so memory must become executable"


def test_the_watchdog_waits_for_several_beats_and_for_the_longest_round() -> None:
    """One beat that comes late is not a hang; BUDGET_S is what a whole picture may take, and it beats in between."""
    service = unit_of("systemd/diffuscope.service")["Service"]
    assert service["Type"] == "notify"
    assert float(service["WatchdogSec"]) >= max(3 * BEAT_S, 2 * BUDGET_S)
    assert service["WatchdogSignal"] == "SIGKILL"
    assert float(service["TimeoutStartSec"]) >= 180


def test_whoever_stops_the_instrument_waits_for_the_longest_picture_that_can_be_chosen() -> None:
    """And uvicorn's second, and one for the rest: a picture under way is finished and kept."""
    assert float(unit_of("systemd/diffuscope.service")["Service"]["TimeoutStopSec"]) >= LAST_S + 2


def test_every_end_every_boot_and_giving_up_call_the_same_blanker() -> None:
    """Its words are a contract with device/drivers/blank.py; a lamp that cannot be reached must not fail the unit."""
    assert unit_of("systemd/diffuscope.service")["Service"]["ExecStopPost"] == f"-+{BLANKER}"
    assert unit_of("systemd/diffuscope.service")["Unit"]["OnFailure"] == "diffuscope-dark.service"
    for name in ("diffuscope-blank", "diffuscope-dark"):
        assert unit_of(f"systemd/{name}.service")["Service"]["ExecStart"] == f"-{BLANKER}"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_has_nothing_to_say_about_any_unit(tmp_path: Path) -> None:
    """Any output is a failure: for unknown keys systemd-analyze only prints, and says that all is well."""
    for name in UNITS:  # the same units, with the program that this machine has
        here = re.sub(r"/opt/diffuscope/\S+/(diffuscope|python)(?= )", rf"{BIN}/\1", text(name))
        (tmp_path / Path(name).name).write_text(here, encoding="utf-8")
    words = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", *sorted(tmp_path.iterdir())]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["diffuscope-settle", "diffuscope-update", "diffuscope-wish"])
def test_what_updates_is_locked_in_and_called_with_words_that_exist(name: str) -> None:
    """It runs as root, who owns RAUC: so without capabilities, and on a disk that is read-only but for its journal."""
    service = unit_of(f"systemd/{name}.service")["Service"]
    called = service["ExecStart"].removeprefix("/opt/diffuscope/.venv/bin/python -m services.update ")
    assert not unknown_words(f"diffuscope update {called}")
    assert called.split()[0] in typer.main.get_group(update_app).commands
    sees = {"ProtectKernelModules"} if name == "diffuscope-wish" else set()  # whether a version must bring its kernel
    assert {key for key in HARDENING if service.get(key) != "yes"} == sees
    assert (service["ProtectSystem"], service["CapabilityBoundingSet"]) == ("strict", "")
    assert service["StateDirectory"] == UpdateSettings().folder.name
    assert service["StateDirectoryMode"] == "0711", "the page reads the journal in it"


def test_page_updater_and_systemd_mean_the_same_folders() -> None:
    """Who leaves a wish where nobody looks waits for ever."""
    state, wishes = str(UpdateSettings().folder), str(UpdateSettings().wishes)
    instrument = unit_of("systemd/diffuscope.service")["Service"]
    assert f"--updates {state} --wishes {wishes}" in instrument["ExecStart"]
    assert instrument["ReadWritePaths"] == f"-{wishes} -{state}/{TABLET} -/media"
    assert unit_of("systemd/diffuscope-wish.path")["Path"]["PathExists"] == f"{wishes}/{WISH}"
    assert unit_of("systemd/diffuscope-wish.service")["Service"]["ReadWritePaths"] == wishes
    made = [line.split() for line in text("systemd/diffuscope.tmpfiles").splitlines() if line.startswith("d ")]
    shared = ["2770", "root", "diffuscope-update", "-"]
    own = ["0711", "root", "root", "-"]
    assert made == [["d", wishes, *shared], ["d", state, *own], ["d", f"{state}/{TABLET}", *shared]]
    assert "\ng diffuscope-update -\n" in text("systemd/diffuscope.sysusers")
    assert "diffuscope-update" in instrument["SupplementaryGroups"].split()


def test_a_version_that_is_tried_has_its_patience_and_then_goes_back() -> None:
    """The unit must not give up before the updater has said why, and its failure must restart the device."""
    settle = unit_of("systemd/diffuscope-settle.service")
    assert settle["Unit"]["FailureAction"] == "reboot"
    assert float(settle["Service"]["TimeoutStartSec"]) >= load_settings(IMAGE_SETTINGS).patience_s + 120
    assert settle["Service"]["ExecCondition"].endswith("/services/update/bootchooser.py trying")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_instrument_is_exposed_as_little_as_it_can_be() -> None:
    """0 is locked up, 10 is open; with camera, lamp and buses in reach it is 2 at most."""
    words = ["systemd-analyze", "security", "--offline=true", "--threshold=20", "systemd/diffuscope.service"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-200:]
