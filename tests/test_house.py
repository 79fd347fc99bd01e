"""The rules of the house that a machine can judge; an exception stands in a list here, with its reason.

A finder reads one file and yields (line, name, what): `name` is what an exception is keyed on, together with the path.
`test_the_rules_can_be_broken` hands every finder something that it must find.
"""

import ast
import builtins
import configparser
import io
import re
import shlex
import shutil
import subprocess
import sys
import tokenize
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest
import typer

from device import errors
from device.spec import load_head
from services.cli import app

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
ROOMS = ("device", "services", "web", "systemd", "tests", "hardware")
BESIDE = {
    ".ci", ".gitignore", "CHANGELOG.md", "LICENSE", "Makefile", "README.md", "pyproject.toml", "requirements.lock",
}  # fmt: skip
MOST_LINES, MOST_FUNCTION_LINES = 400, 40

Offence = tuple[int, str, str]
Finder = Callable[[str], Iterable[Offence]]


@cache
def files() -> tuple[str, ...]:
    """What git holds or would hold, and what is there; vendored code belongs to others."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(git, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    return tuple(sorted(n for n in names if not n.startswith("web/vendor/") and (ROOT / n).is_file()))


@cache
def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@cache
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(parsed(source)))


def python(*rooms: str) -> list[str]:
    return [name for name in files() if name.endswith(".py") and name.startswith(rooms)]


def judge(finder: Finder, names: Iterable[str], allowed: Mapping[str, str], rule: str) -> None:
    """Fail with every offence that no exception covers, and with every exception that nothing needs any more."""
    found = [(f"{name}: {key}", line, what) for name in names for line, key, what in finder(text(name))]
    bad = [f"{key} (line {line}): {what}" for key, line, what in found if key not in allowed]
    assert not bad, "\n".join([rule, *bad])
    assert all(len(reason) > 20 for reason in allowed.values()), "an exception carries its reason"
    assert set(allowed) <= {key for key, _, _ in found}, f"no longer needed: {set(allowed) - {k for k, _, _ in found}}"


# Who may import what


def test_everybody_imports_only_from_below() -> None:
    """The arrows of DESIGN are import-linter contracts: a drawing that nobody checks is soon a drawing of the past."""
    done = subprocess.run([BIN / "lint-imports", "--no-cache", "--no-logo"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def imports(source: str) -> Iterator[tuple[ast.stmt, str]]:
    for node in nodes(source):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node, node.module


HARDWARE = {"picamera2", "libcamera", "spidev", "smbus2", "gpiod", "gpiozero", "lgpio", "RPi"}
WEB = {"fastapi", "starlette", "uvicorn", "httpx", "sqlalchemy", "alembic", "pydicom", "typer"}


def hardware_imports(source: str) -> Iterator[Offence]:
    yield from ((n.lineno, m, "hardware") for n, m in imports(source) if m.split(".")[0] in HARDWARE)


def eager_hardware_imports(source: str) -> Iterator[Offence]:
    yield from (o for o in hardware_imports(source) for n in parsed(source).body if n.lineno == o[0])


def web_imports(source: str) -> Iterator[Offence]:
    yield from ((n.lineno, m, "not in an instrument") for n, m in imports(source) if m.split(".")[0] in WEB)


def test_hardware_is_met_in_drivers_only_and_there_late() -> None:
    """The instrument must be importable on a laptop with nothing attached."""
    outside = [name for name in python("device", "services", "tests") if not name.startswith("device/drivers/")]
    judge(hardware_imports, outside, {}, "hardware libraries belong into device/drivers")
    judge(eager_hardware_imports, python("device/drivers"), {}, "drivers import hardware in their constructors")


def test_the_instrument_knows_no_web_no_database_and_no_dicom() -> None:
    """What stands above changes more often than optics does."""
    judge(web_imports, python("device"), {}, "these belong into services")


# What code may not do


def long_functions(source: str) -> Iterator[Offence]:
    for node in nodes(source):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MOST_FUNCTION_LINES:
                yield node.lineno, node.name, f"{lines} lines"


JS_FUNCTION = re.compile(r"(\s*)(?!.*\b(?:if|for|while|switch|catch)\b \().*?(#?\w+)\s*(?:=.*|\(.*\)|: .*)\s*\{$")


def long_js_functions(source: str) -> Iterator[Offence]:
    """By indentation: a block begins with a line that looks like a function's head, and ends with its brace."""
    lines = source.splitlines()
    for first, line in enumerate(lines):
        if (head := JS_FUNCTION.match(line)) and ("=>" in line or "(" in line):
            end = next((i for i in range(first + 1, len(lines)) if lines[i].startswith(f"{head[1]}}}")), first)
            if end - first + 1 > MOST_FUNCTION_LINES:
                yield first + 1, head[2], f"{end - first + 1} lines"


def long_files(source: str) -> Iterator[Offence]:
    if (lines := source.count("\n")) > MOST_LINES:
        yield lines, "file", f"{lines} lines"


def test_files_and_functions_are_short() -> None:
    """A file over 400 lines or a function over 40 is asking to be two."""
    judge(long_files, python("device", "services"), {}, "a long file is two")
    judge(long_functions, python("device", "services"), {}, "a long function is two")


def test_the_pages_files_and_functions_are_short() -> None:
    """The same for the page, which has the same readers."""
    modules = [name for name in files() if name.startswith("web/") and name.endswith(".js")]
    judge(long_files, modules, {}, "a long file is two")
    judge(long_js_functions, modules, {}, "a long function is two")


UNITS = set(re.findall(r"\w+", "um mm m s ms min deg rad dpt dn dn2 e px samples hz bytes percent"))
QUANTITIES = set(
    re.findall(
        r"\w+",
        """
        time exposure duration budget wait delay timeout age elapsed period interval due
        length width height distance radius diameter pitch thickness wavelength bandwidth reach iris aperture
        angle heading bearing tilt rotation turn refraction sphere cylinder defocus myopia
        counts black white dark noise pedestal electrons charge temperature frequency
        """,
    )
)


def is_float(annotation: ast.expr | None) -> bool:
    """float, float | None, and tuples of them; arrays and mappings name their units in the docstring."""
    words = {node.id for node in ast.walk(annotation) if isinstance(node, ast.Name)} if annotation else set()
    return "float" in words and words <= {"float", "tuple", "Annotated"}


def floats(body: list[ast.stmt], in_class: bool = False) -> Iterator[tuple[int, str]]:
    for node in body:
        match node:
            case ast.ClassDef() if not node.name.startswith("_"):
                yield from floats(node.body, in_class=True)
            case ast.AnnAssign(target=ast.Name(id=name)) if in_class and is_float(node.annotation):
                yield node.lineno, name
            case ast.FunctionDef() | ast.AsyncFunctionDef() if not re.match(r"_(?!_)", node.name):
                every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                yield from ((arg.lineno, arg.arg) for arg in every if is_float(arg.annotation))
                decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
                if "property" in decorators and is_float(node.returns):
                    yield node.lineno, node.name


def unitless(source: str) -> Iterator[Offence]:
    for line, name in floats(parsed(source).body):
        words = name.lower().split("_")
        if QUANTITIES & set(words) and words[-1] not in UNITS and "per" not in words:
            yield line, name, "a quantity without its unit"


def test_quantities_carry_their_unit_in_the_name() -> None:
    """No suffix means a ratio: a public float that speaks of time, length, angle, refraction or counts has one."""
    judge(unitless, python("device", "services"), {}, f"end the name in one of _{', _'.join(sorted(UNITS))}")


def swallowers(source: str) -> Iterator[Offence]:
    for node in nodes(source):
        if isinstance(node, ast.ExceptHandler):
            caught = ast.unparse(node.type) if node.type else "everything"
            last = node.body[-1]
            passed_on = caught == "BaseException" and isinstance(last, ast.Raise) and last.exc is None
            if caught in ("everything", "Exception", "BaseException") and not passed_on:
                yield node.lineno, f"except {caught}", "name what you can mend, or end with a bare raise"


def test_no_error_is_swallowed_unnamed() -> None:
    """The first error hidden by `except Exception` on such a device is the lamp that stayed on."""
    judge(swallowers, python("device", "services", "tests"), {}, "catch what you know")


def patches(source: str) -> Iterator[Offence]:
    owners = [node for node in nodes(source) if isinstance(node, ast.Import | ast.ImportFrom)]
    bound = {alias.asname or alias.name.split(".")[0] for node in owners for alias in node.names}
    yield from ((n.lineno, m, "a mock") for n, m in imports(source) if "mock" in m)
    for node in nodes(source):
        if isinstance(node, ast.arg) and node.arg in ("monkeypatch", "mocker"):
            yield node.lineno, node.arg, "a patching fixture"
        if isinstance(node, ast.ImportFrom) and any(alias.name in ("mock", "MonkeyPatch") for alias in node.names):
            yield node.lineno, "mock", "a mock"
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
            owner = node.value
            if isinstance(owner, ast.Name) and owner.id in bound:
                yield node.lineno, f"{owner.id}.{node.attr}", "an attribute of an imported name is replaced"


def test_tests_use_the_three_seams_and_patch_nothing() -> None:
    """Port, bus and clock are constructor arguments; a test that patches tests a program that nobody runs."""
    judge(patches, python("tests"), {}, "hand the other part to the constructor instead")


def doors_to_time(source: str) -> Iterator[Offence]:
    yield from ((n.lineno, "time", "ask the Clock") for n, m in imports(source) if m == "time")
    for node in nodes(source):
        if isinstance(node, ast.ImportFrom) and any(alias.name == "Timer" for alias in node.names):
            yield node.lineno, "Timer", "ask the Clock"
        door = r"\b(datetime\.(now|utcnow|today)|date\.today|threading\.Timer|asyncio\.sleep)$"
        if isinstance(node, ast.Attribute) and re.search(door, called := ast.unparse(node)):
            yield node.lineno, called, "ask the Clock"


def test_the_clock_is_the_only_door_to_time() -> None:
    """Time is an argument, or the tests must wait for it."""
    allowed = {
        "device/clock.py: time": "the door itself: SystemClock",
        "device/clock.py: datetime.now": "the door itself: SystemClock.wall",
        "device/guard.py: Timer": "darkens the lamp when everything that asks a Clock hangs",
    }
    judge(doors_to_time, python("device", "services"), allowed, "Clock and Deadline are arguments")


def test_no_module_hides_one_of_the_standard_library() -> None:
    """`import queue` must mean the same in every folder."""
    hiding = [name for name in python("device", "services") if Path(name).stem in sys.stdlib_module_names]
    assert not hiding


# What may not be left lying about


def leftovers(source: str) -> Iterator[Offence]:
    for number, line in enumerate(source.splitlines(), 1):
        for mark in re.findall(r"\b(?:TO[D]O|FIX[M]E|X[X]X)\b", line):
            yield number, mark, "do it, or write an issue"
        for place in re.findall(r"(?<![\w./>])/(?:work|root|home|tmp)(?![\w-])", line):
            yield number, place, "a path of one machine"


def workplace_words(source: str) -> Iterator[Offence]:
    """Words that mean who wrote this, not who reads it; recordings beside the repository are fine in data tests."""
    for number, line in enumerate(source.splitlines(), 1):
        for word in re.findall(r"\b(?:sessio[n]|helpe[r])s?\b", line, re.IGNORECASE):
            yield number, word.lower(), "say what it is"
        data = "mark.data" in source or "data: reads real recordings" in line
        for place in re.findall(r"\bshared[/]\w*", line.replace("../shared" + "/data", "") if data else line):
            yield number, place, "not part of this repository"


def prose(source: str) -> str:
    """A Python file with its names and operators blanked: comments and strings stay on their lines."""
    lines = [""] * (source.count("\n") + 2)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if tokenize.tok_name[token.type] in ("COMMENT", "STRING", "FSTRING_MIDDLE") and token.string != '"session"':
            for offset, line in enumerate(token.string.splitlines()):
                lines[token.start[0] - 1 + offset] += f" {line}"
    return "\n".join(lines)


def workplace_words_in_prose(source: str) -> Iterator[Offence]:
    """As above, where a name may be what a library calls it: SQLAlchemy's for a transaction, pytest's for a scope."""
    yield from workplace_words(prose(source))


def test_nothing_of_the_workshop_is_left_in_the_house() -> None:
    """Marks of unfinished work, paths of one machine, words of whoever was here: of no use to any reader."""
    readable = [name for name in files() if Path(name).suffix not in (".png", ".jpg", ".npy", ".tiff", ".gz")]
    judge(leftovers, readable, {}, "clear it away")
    judge(workplace_words, [name for name in readable if not name.endswith(".py")], {}, "clear it away")
    own = {"tests/test_house.py: session": "this file names what it looks for"}
    judge(workplace_words_in_prose, python(""), own, "clear it away")


def test_the_top_level_is_fixed() -> None:
    """A newcomer finds six rooms and what belongs to all of them, next year as well."""
    assert {name.split("/")[0] for name in files()} <= {*ROOMS, *BESIDE}


# Every rule above can fail

BROKEN: list[tuple[Finder, str]] = [
    (hardware_imports, "def f():\n    import spidev"),
    (hardware_imports, "from gpiod.line import Value"),
    (eager_hardware_imports, "import picamera2"),
    (web_imports, "from sqlalchemy.orm import Session"),
    (long_files, "x = 1\n" * 401),
    (long_functions, "def f():\n" + "    x = 1\n" * 40),
    (long_js_functions, "export function f(a, b) {\n" + "  x;\n" * 40 + "}"),
    (long_js_functions, "const f = async (a) => {\n" + "  x;\n" * 40 + "};"),
    (long_js_functions, "class A {\n  draw(a) {\n" + "    x;\n" * 40 + "  }\n}"),
    (unitless, "def f(exposure: float): ..."),
    (unitless, "def f(*, beam_width: float | None = None): ..."),
    (unitless, "class A:\n    black: float = 0.0"),
    (unitless, "class A:\n    @property\n    def angle(self) -> float: ..."),
    (swallowers, "try:\n    x\nexcept:\n    pass"),
    (swallowers, "try:\n    x\nexcept Exception as error:\n    raise"),
    (swallowers, "try:\n    x\nexcept BaseException:\n    pass"),
    (patches, "def test(monkeypatch): ..."),
    (patches, "from unittest import mock"),
    (patches, "import unittest.mock"),
    (patches, "from services.records import store\nstore.RESERVE_BYTES = 0"),
    (doors_to_time, "from time import sleep"),
    (doors_to_time, "import datetime\ndatetime.datetime.now()"),
    (doors_to_time, "import asyncio\nasync def f():\n    await asyncio.sleep(1)"),
    (leftovers, "# TO" "DO: later"),
    (leftovers, "see /wo" "rk/main"),
    (workplace_words, "from shared" "/knowledge"),
    (workplace_words, "read ../shared" "/data here"),
    (workplace_words_in_prose, "x = 1  # as in the last sessio" "n"),
]  # fmt: skip
FINE: list[tuple[Finder, str]] = [
    (eager_hardware_imports, "def f():\n    import picamera2"),
    (long_functions, "def f():\n" + "    x = 1\n" * 39),
    (unitless, "def f(exposure_s: float, white: int, gain_e_per_dn: float, level: float): ..."),
    (unitless, "def _f(exposure: float): ..."),
    (swallowers, "try:\n    x\nexcept BaseException:\n    y()\n    raise"),
    (patches, "from device.clock import VirtualClock\nclock = VirtualClock()\nclock.elapsed_s = 1"),
    (doors_to_time, "from datetime import datetime\ndatetime.fromisoformat('2026-01-01')"),
    (leftovers, "Path.home() / 'work'"),
    (workplace_words, "pytest.mark.data: ../shared" "/data/fundus"),
    (workplace_words_in_prose, 'import pytest\nwith Session(engine) as session:\n    scope = "session"'),
]  # fmt: skip


@pytest.mark.parametrize(("finder", "source"), BROKEN)
def test_the_rules_can_be_broken(finder: Finder, source: str) -> None:
    assert list(finder(source))


@pytest.mark.parametrize(("finder", "source"), FINE)
def test_the_rules_can_be_kept(finder: Finder, source: str) -> None:
    assert not list(finder(source))


# What the files beside the code say


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


def test_the_wheel_holds_what_the_instrument_needs_at_run_time(tmp_path: Path) -> None:
    """Page, migrations, scenes and heads are not Python, and are easily left behind."""
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        held = set(wheel.namelist())
    needed = {name for name in files() if re.match(r"(device|services|web)/(?!pictures/)|hardware/heads/", name)}
    needed |= {f"web/vendor/{path.name}" for path in (ROOT / "web" / "vendor").glob("*.js")}
    assert needed - held == set()


# READMEs


def readmes() -> list[str]:
    return [name for name in files() if Path(name).name == "README.md"]


def code_in(markdown: str) -> list[str]:
    """Every line of fenced code, continued lines joined, and every code span."""
    fences = re.findall(r"^```\w*\n(.*?)^```", markdown, re.M | re.S)
    lines = [line for fence in fences for line in fence.replace("\\\n", " ").splitlines()]
    return lines + re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", markdown, flags=re.M | re.S))


def commands() -> dict[str, set[str]]:
    """The words of `diffuscope`, each with its options."""
    group = typer.main.get_group(app)
    return {name: {"--help"}.union(*(p.opts for p in command.params)) for name, command in group.commands.items()}


def unknown_words(command_line: str) -> list[str]:
    """What a command line says that `diffuscope` does not know."""
    known = commands()
    found = re.search(r"\bdiffuscope ([a-z][\w-]*)(.*)", command_line)
    if found is None or found[1] not in known:
        return [found[1]] if found else []
    return [o for o in re.findall(r"(?<!\S)--?[a-z][\w-]*", found[2]) if o not in known[found[1]]]


def test_a_wrong_command_line_is_noticed() -> None:
    assert unknown_words("diffuscope fly") == ["fly"]
    assert unknown_words(".venv/bin/diffuscope run --port 1 --fly=1 -y") == ["--fly", "-y"]
    assert unknown_words("diffuscope reconstruct a.tiff --psf p.tiff -o out.png") == []


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


@pytest.mark.parametrize("name", [name for name in files() if name.endswith(".service")])
def test_a_unit_starts_what_exists_restarts_it_and_locks_it_in(name: str, tmp_path: Path) -> None:
    """Checked by systemd where it is installed; where it is not, at least sections, keys and the command line are."""
    unit = configparser.ConfigParser(interpolation=None, delimiters="=", comment_prefixes="#")
    unit.optionxform = str  # type: ignore[assignment, method-assign]  # keys of systemd are case-sensitive
    unit.read_string(text(name))
    assert unit.sections() == ["Unit", "Service", "Install"]
    service = unit["Service"]
    program, *words = shlex.split(service["ExecStart"])
    assert not unknown_words(shlex.join(["diffuscope", *words]))
    assert service["Restart"] == "always"
    assert not [key for key in HARDENING if service.get(key) != "yes"]
    assert service["ProtectSystem"] == "strict"
    assert "MemoryDenyWriteExecute" not in service, "numba compiles at run time, so memory must become executable"
    if analyze := shutil.which("systemd-analyze"):
        here = tmp_path / Path(name).name  # the same unit, with the program that this machine has
        here.write_text(text(name).replace(program, str(BIN / "diffuscope")), encoding="utf-8")
        done = subprocess.run([analyze, "verify", "--man=no", here], capture_output=True, text=True)
        assert (done.returncode, done.stdout + done.stderr) == (0, "")
