"""The rules of the house that a machine can judge in code; an exception stands in a list here, with its reason.

A finder reads one file and yields (line, name, what): `name` is what an exception is keyed on, together with the path.
`test_the_rules_can_be_broken` hands every finder something that it must find.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.house import BESIDE, BIN, ROOMS, ROOT, Finder, Offence, files, judge, nodes, parsed, python

MOST_LINES, MOST_FUNCTION_LINES = 400, 40


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
    emulated = ("device/drivers/", "tests/ports/")  # where the real libraries run over emulated transports
    outside = [name for name in python("device", "services", "tests") if not name.startswith(emulated)]
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
    allowed = {"device/errors.py: file": "one tree in one place: a list of leaves, which nobody reads through"}
    judge(long_files, python("device", "services"), allowed, "a long file is two")
    judge(long_functions, python("device", "services"), {}, "a long function is two")


def test_the_pages_files_and_functions_are_short() -> None:
    """The same for the page, which has the same readers."""
    modules = [name for name in files() if name.startswith("web/") and name.endswith(".js")]
    judge(long_files, modules, {}, "a long file is two")
    judge(long_js_functions, modules, {}, "a long function is two")


UNITS = set(re.findall(r"\w+", "um mm m s ms min deg rad dpt dn dn2 e px samples hz bytes percent c"))
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
        "services/instrument/carrier.py: Timer": "ends a delivery that hangs in a socket, where nobody asks a Clock",
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
    binary = {".png", ".jpg", ".npy", ".tiff", ".gz", ".zip", ".sqlite", ".copy", ".calibration", ".npz"}
    readable = [name for name in files() if Path(name).suffix not in binary]
    readable.remove("tests/golden/records/tests.json")  # names of tests, with the examples that break this rule
    judge(leftovers, readable, {}, "clear it away")
    judge(workplace_words, [name for name in readable if not name.endswith(".py")], {}, "clear it away")
    own = {
        "tests/test_house.py: session": "this file names what it looks for",
        "tests/appliance/bench.py: session": "what D-Bus calls a bus that is not the whole computer's",
    }
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
    (patches, "from services.records import disk\ndisk.RESERVE_BYTES = 0"),
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
