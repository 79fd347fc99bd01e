"""Architecture rules of the source code; each exception is listed here with its reason.

A finder reads one file and yields its violations as (line, name, description); path and name are the key of an
exception. `test_a_finder_finds_a_violation` gives every finder an example that it must find.
"""

import ast
import io
import posixpath
import re
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.project_files import (
    BIN,
    ROOT,
    TOP_FILES,
    TOP_FOLDERS,
    Finder,
    Violation,
    check_rule,
    files,
    nodes,
    parsed,
    python_files,
    text,
)

MAX_FUNCTION_LINES, MAX_COMPLEXITY = 40, 10
MAX_METHODS, MAX_ATTRIBUTES = 15, 16


# Imports


def test_each_layer_imports_only_the_layers_below_it() -> None:
    """The import-linter contracts of pyproject.toml hold."""
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


def hardware_imports(source: str) -> Iterator[Violation]:
    yield from ((n.lineno, m, "hardware") for n, m in imports(source) if m.split(".")[0] in HARDWARE)


def eager_hardware_imports(source: str) -> Iterator[Violation]:
    yield from (o for o in hardware_imports(source) for n in parsed(source).body if n.lineno == o[0])


def web_imports(source: str) -> Iterator[Violation]:
    yield from ((n.lineno, m, "not in an instrument") for n, m in imports(source) if m.split(".")[0] in WEB)


def test_hardware_libraries_are_imported_in_drivers_only_and_lazily() -> None:
    """The instrument can be imported on a laptop without hardware."""
    emulated = ("device/drivers/", "tests/ports/")  # the real libraries, over emulated transports
    outside = [name for name in python_files("device", "services", "tests") if not name.startswith(emulated)]
    check_rule(hardware_imports, outside, {}, "hardware libraries belong into device/drivers")
    check_rule(eager_hardware_imports, python_files("device/drivers"), {}, "import hardware in constructors")


def test_device_imports_no_http_database_or_dicom() -> None:
    """HTTP, database and DICOM belong to services."""
    check_rule(web_imports, python_files("device"), {}, "these belong into services")


Function = ast.FunctionDef | ast.AsyncFunctionDef
RAW_LAMPS = {"LedRing", "Apa102Ring", "Tlc5971Ring", "SimLight", "MirroredLight", "ReplayLight", "SpiBus", "self._lamp"}


def raw_lamps(source: str) -> Iterator[Violation]:
    """Find calls of lamps without guard and of their bus, by the function that contains each."""
    for function in nodes(source):
        if isinstance(function, Function):
            for node in ast.walk(function):
                if isinstance(node, ast.Call) and (name := ast.unparse(node.func)) in RAW_LAMPS:
                    yield node.lineno, f"{function.name}, {name}", "open the lamp with device/head.py: it is guarded"


def test_every_lamp_is_opened_within_its_guard() -> None:
    """No other code gets hold of a lamp; tests/ports/test_every_light_is_guarded.py runs the commands and endpoints."""
    allowed = {
        "device/head.py: light, self._lamp": "the argument of GuardedLight: the only way to a lamp",
        "device/head.py: _lamp, SimLight": "the simulated lamp that the guard gets",
        "device/head.py: _lamp, MirroredLight": "the ring with a simulated camera that the guard gets",
        "device/head.py: _ring, Apa102Ring": "the ring that the guard gets",
        "device/head.py: _ring, Tlc5971Ring": "the ring that the guard gets",
        "device/head.py: _replayed, ReplayLight": "a recording emits no light; it is guarded in the next lines",
        "device/drivers/ring.py: __init__, SpiBus": "the bus of a ring, in the ring's own constructor",
        "device/sim/scene_files.py: lit_frames, SimLight": "renders a scene of its own: no head, no LED",
    }
    check_rule(raw_lamps, python_files("device", "services"), allowed, "no light without the guard")


# Size, units, errors, time


def size_reason(source: str, line: int) -> str | None:
    """Return the reason of the comment `# size: reason` on a line, None without that comment."""
    found = re.search(r"# size: (.*)", source.splitlines()[line - 1])
    return found[1] if found else None


def statement_lines(node: Function, source: str) -> int:
    """Return the lines of a function's statements: without signature, docstring, comments and blank lines."""
    body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    lines = source.splitlines()[body[0].lineno - 1 : node.end_lineno] if body else []
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in lines)


def long_functions(source: str) -> Iterator[Violation]:
    for node in nodes(source):
        if isinstance(node, Function):
            lines = statement_lines(node, source)
            if lines > MAX_FUNCTION_LINES and size_reason(source, node.lineno) is None:
                yield node.lineno, node.name, f"{lines} lines"


VALUES = {"NamedTuple", "TypedDict", "Enum", "StrEnum", "IntEnum", "BaseModel", "Table", "Row", "Structure"} | {
    "RequestBody",
    "ResponseBody",
    "StoredPart",  # base classes of the HTTP models
}


def is_value(node: ast.ClassDef) -> bool:
    """Return whether a class is a frozen value, a model or a table, which may have any number of fields."""
    decorators, bases = map(ast.unparse, node.decorator_list), {ast.unparse(base).split(".")[-1] for base in node.bases}
    return any("dataclass" in call and "frozen=True" in call for call in decorators) or bool(bases & VALUES)


def attributes(node: ast.ClassDef) -> set[str]:
    """Return the names that a class body or the methods of the class assign."""
    names = {
        statement.target.id
        for statement in node.body
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)
    }
    plain = [target for statement in node.body if isinstance(statement, ast.Assign) for target in statement.targets]
    names |= {target.id for target in plain if isinstance(target, ast.Name)}
    for part in ast.walk(node):
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store) and ast.unparse(part.value) == "self":
            names.add(part.attr)
    return names


def large_classes(source: str) -> Iterator[Violation]:
    for node in nodes(source):
        if isinstance(node, ast.ClassDef) and size_reason(source, node.lineno) is None:
            methods = sum(isinstance(statement, Function) for statement in node.body)
            if methods > MAX_METHODS:
                yield node.lineno, node.name, f"{methods} methods"
            elif len(attributes(node)) > MAX_ATTRIBUTES and not is_value(node):
                yield node.lineno, node.name, f"{len(attributes(node))} attributes"


def size_comments(source: str) -> Iterator[Violation]:
    """Find exceptions from the limits of size without a reason, on a line without function or class, or unneeded."""
    heads = {node.lineno for node in nodes(source) if isinstance(node, Function | ast.ClassDef)}
    bare = re.sub("# size: ", "# ", source)
    needed = {line for finder in (long_functions, large_classes) for line, _, _ in finder(bare)}
    for number, line in enumerate(source.splitlines(), 1):
        reason = re.search(r"# size:(.*)", line)
        complex_one = re.search(r"# noqa:.*C901", line) is not None
        if complex_one and not reason:
            yield number, "C901", "an exception carries `# size: reason`"
        if reason and (number not in heads or len(reason[1]) <= 20):
            yield number, "size", "a reason stands behind `class` or `def`"
        elif reason and number not in needed and not complex_one:
            yield number, "size", "the limit is kept: remove the comment"


def test_functions_are_short() -> None:
    """A function has at most 40 lines of statements, its nested functions included; a file has no limit."""
    check_rule(long_functions, python_files("device", "services"), {}, "split the function")


def test_classes_have_one_responsibility() -> None:
    """A class has at most 15 methods and 16 attributes; frozen values, models and tables have any number of fields."""
    remedy = "find the second responsibility"
    check_rule(large_classes, python_files("device", "services"), {}, remedy)


def test_functions_have_few_branches() -> None:
    """Ruff reports a function of cyclomatic complexity above 10; an exception of any limit carries its reason."""
    lint = tomllib.loads(text("pyproject.toml"))["tool"]["ruff"]["lint"]
    assert "C90" in lint["select"]
    assert lint["mccabe"]["max-complexity"] == MAX_COMPLEXITY
    check_rule(size_comments, python_files("device", "services"), {}, "state the reason of the size")


JS_FUNCTION = re.compile(r"(\s*)(?!.*\b(?:if|for|while|switch|catch)\b \().*?(#?\w+)\s*(?:=.*|\(.*\)|: .*)\s*\{$")


def long_js_functions(source: str) -> Iterator[Violation]:
    """Find functions by indentation: from a line that looks like a function head to its closing brace."""
    lines = source.splitlines()
    for first, line in enumerate(lines):
        if (head := JS_FUNCTION.match(line)) and ("=>" in line or "(" in line):
            end = next((i for i in range(first + 1, len(lines)) if lines[i].startswith(f"{head[1]}}}")), first)
            if end - first + 1 > MAX_FUNCTION_LINES:
                yield first + 1, head[2], f"{end - first + 1} lines"


def test_functions_of_the_page_are_short() -> None:
    """The same limit holds for the page."""
    modules = [name for name in files() if name.startswith("web/") and name.endswith(".js")]
    check_rule(long_js_functions, modules, {}, "split the function")


# What the modules of a folder of the page may import, beside their own folder.
PAGE_IMPORTS = {
    "vendor": set(),
    "i18n": set(),
    "core": {"vendor", "i18n"},
    "components": {"vendor", "i18n", "core"},
    "screens": {"vendor", "i18n", "core", "components"},
    "technician": {"vendor", "i18n", "core", "components"},
}


def page_imports(name: str, source: str) -> Iterator[Violation]:
    """Yield the imports of a module of the page that its folder does not permit."""
    folder = name.split("/")[1]
    for number, line in enumerate(source.splitlines(), 1):
        for path in re.findall(r"""(?:from|import|import\()\s*["`](\.[^"`]+)["`]""", line):
            target = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)).split("/")[1]
            if target != folder and target not in PAGE_IMPORTS[folder]:
                yield number, f"{folder} imports {target}"


def test_modules_of_the_page_import_downwards() -> None:
    """core <- components <- screens | technician; the entry module `app.js` imports all of them."""
    for name in files():
        if name.startswith("web/") and name.count("/") > 1 and name.endswith((".js", ".mjs")):
            assert list(page_imports(name, (ROOT / name).read_text(encoding="utf-8"))) == [], name


def test_an_upward_import_of_the_page_is_found() -> None:
    assert list(page_imports("web/core/state.js", 'import { b } from "../screens/b.js";')) == [
        (1, "core imports screens")
    ]
    assert list(page_imports("web/screens/aim.js", 'import("../core/b.js");\nimport "./c.js";')) == []


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
    """Return whether an annotation is float, float | None or a tuple of them; arrays state units in the docstring."""
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


def unitless(source: str) -> Iterator[Violation]:
    for line, name in floats(parsed(source).body):
        words = name.lower().split("_")
        if QUANTITIES & set(words) and words[-1] not in UNITS | {"ratio"} and "per" not in words:
            yield line, name, "a quantity without its unit"


def test_quantities_carry_their_unit_in_the_name() -> None:
    """A public float that is a time, length, angle, refraction or count has a unit suffix, or `_ratio`."""
    check_rule(unitless, python_files("device", "services"), {}, f"end the name in one of _{', _'.join(sorted(UNITS))}")


UNTYPED = re.compile(r"\b(?:dict|Dict|Mapping|MutableMapping)\[str, (?:\w+\.)?Any\]")


def untyped_dicts(source: str) -> Iterator[Violation]:
    """Find signatures, fields and aliases with a mapping of names to values of any type."""
    annotated: list[tuple[int, str, ast.expr | None]] = []
    for node in nodes(source):
        if isinstance(node, Function):
            arguments = [argument for argument in ast.walk(node.args) if isinstance(argument, ast.arg)]
            annotated += [(argument.lineno, node.name, argument.annotation) for argument in arguments]
            annotated.append((node.lineno, node.name, node.returns))
        if isinstance(node, ast.ClassDef | ast.Module):
            assigned = [statement for statement in node.body if isinstance(statement, ast.Assign | ast.AnnAssign)]
            annotated += [(statement.lineno, "assignment", statement.value) for statement in assigned]
            fields = [field for field in assigned if isinstance(field, ast.AnnAssign)]
            annotated += [(field.lineno, ast.unparse(field.target), field.annotation) for field in fields]
    for line, name, annotation in annotated:
        if annotation is not None and UNTYPED.search(ast.unparse(annotation)):
            yield line, name, "a mapping of names to values of any type"


def test_signatures_of_services_have_no_untyped_dict() -> None:
    """Modules exchange frozen values or mappings of typed values, which mypy checks."""
    check_rule(untyped_dicts, python_files("services"), {}, "use a frozen dataclass, or a model at an edge")


def swallowers(source: str) -> Iterator[Violation]:
    for node in nodes(source):
        if isinstance(node, ast.ExceptHandler):
            caught = ast.unparse(node.type) if node.type else "everything"
            last = node.body[-1]
            passed_on = caught == "BaseException" and isinstance(last, ast.Raise) and last.exc is None
            if caught in ("everything", "Exception", "BaseException") and not passed_on:
                yield node.lineno, f"except {caught}", "catch the errors that are handled, or end with a bare raise"


def test_no_exception_is_caught_without_its_name() -> None:
    """`except Exception` could hide a lamp that stays on."""
    plugin = "code of another package may raise anything; the error that follows names the package"
    library = "a compiled part of a library may raise anything at its import; the error that follows names the library"
    drivers = [f"device/drivers/{name}.py: except Exception" for name in ("chips", "gpio", "pi_camera", "spi_bus")]
    boot = "a card with any settings has to start; the error that follows is shown on the page and on the console"
    allowed = {
        "device/plugins.py: except Exception": plugin,
        "services/identity/apply_settings.py: except Exception": boot,
    }
    allowed |= dict.fromkeys(drivers, library)
    check_rule(swallowers, python_files("device", "services", "tests"), allowed, "catch named exceptions")


def patches(source: str) -> Iterator[Violation]:
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


def test_tests_use_constructor_arguments_and_patch_nothing() -> None:
    """Port, bus and clock are constructor arguments; a patched program is not the program that users run."""
    check_rule(patches, python_files("tests"), {}, "pass the other part to the constructor")


def private_accesses(source: str) -> Iterator[Violation]:
    for node in nodes(source):
        if isinstance(node, ast.Attribute) and re.match(r"_(?!_)", node.attr):
            owner = ast.unparse(node.value)
            if owner not in ("self", "cls", "super()", "os"):  # os._exit is public
                yield node.lineno, node.attr, f"a private attribute of {owner}"
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "setattr", "vars"):
            words = [
                constant.value
                for constant in ast.walk(node)
                if isinstance(constant, ast.Constant) and isinstance(constant.value, str)
            ]
            yield from ((node.lineno, word, "a private attribute") for word in words if re.match(r"_(?!_)", word))


PRIVATE_ACCESSES_TO_REPLACE = {  # a line is removed when the owner has a public interface
    "tests/journey/test_updates.py: _journal": "the updater does not show its journal",
    "tests/unit/test_upload_worker.py: _back_off": "the upload worker has no step of its own",
}


def test_tests_use_public_interfaces() -> None:
    """A test that reaches for a private attribute fails with the code's structure, not with its behaviour."""
    check_rule(
        private_accesses, python_files("tests"), PRIVATE_ACCESSES_TO_REPLACE, "give the object a public interface"
    )


def time_sources(source: str) -> Iterator[Violation]:
    yield from ((n.lineno, "time", "ask the Clock") for n, m in imports(source) if m == "time")
    for node in nodes(source):
        if isinstance(node, ast.ImportFrom) and any(alias.name == "Timer" for alias in node.names):
            yield node.lineno, "Timer", "ask the Clock"
        source_of_time = r"\b(datetime\.(now|utcnow|today)|date\.today|threading\.Timer|asyncio\.sleep)$"
        if isinstance(node, ast.Attribute) and re.search(source_of_time, called := ast.unparse(node)):
            yield node.lineno, called, "ask the Clock"


def test_the_clock_is_the_only_source_of_time() -> None:
    """Time is an argument, so that tests run in virtual time."""
    allowed = {
        "device/clock.py: time": "the implementation of SystemClock",
        "device/clock.py: datetime.now": "the implementation of SystemClock.wall",
        "device/light_safety/guard.py: Timer": "switches the lamp off when the threads that use a Clock hang",
        "services/research/lensless_peer.py: time": "a program of another environment, which cannot import `device`",
        "services/delivery/uploader.py: Timer": "aborts an upload that hangs in a socket, where no Clock is used",
    }
    check_rule(time_sources, python_files("device", "services"), allowed, "Clock and Deadline are arguments")


def test_no_module_hides_one_of_the_standard_library() -> None:
    """`import queue` means the standard library in every folder."""
    hiding = [name for name in python_files("device", "services") if Path(name).stem in sys.stdlib_module_names]
    assert not hiding


# Files

FILE_CALLS = {"fsync", "fdatasync", "flock", "lockf", "rename", "renames"}


def file_calls(source: str) -> Iterator[Violation]:
    """Find calls that make a write durable or atomic, or lock a file: os, fcntl, and the methods of Path."""
    for node in nodes(source):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called, name = ast.unparse(node.func), node.func.attr
            is_path_replace = name == "replace" and len(node.args) == 1 and not node.keywords
            if name in FILE_CALLS or is_path_replace or called in ("os.replace", "shutil.move"):
                yield node.lineno, name, "use device/atomic_io.py"


def test_files_are_written_durably_and_locked_in_one_module() -> None:
    """A missing fsync is seen only after a power cut, so all of them are in one module, which the kill tests cover."""
    names = [name for name in python_files("device", "services") if name != "device/atomic_io.py"]
    script = "RAUC runs this file alone with the system's Python, in an isolated mode that cannot import `device`"
    allowed = {
        "services/update/bootchooser.py: fsync": script,
        "services/update/bootchooser.py: rename": script,
        "services/identity/apply_at_boot.py: rename": "on a tmpfs, where nothing is durable",
    }
    check_rule(file_calls, names, allowed, "use write_atomically, replace_durably, fsync_file or file_lock")


def umask_writes(source: str) -> Iterator[Violation]:
    """Find new files and folders with the modes of the umask: those of other users may read them."""
    for node in nodes(source):
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
            texts = [
                argument.value
                for argument in (*node.args, *(k.value for k in node.keywords))
                if isinstance(argument, ast.Constant)
            ]
            opens = name == "open" and any(isinstance(value, str) and value and value[0] in "wax" for value in texts)
            is_private = any(keyword.arg == "opener" for keyword in node.keywords)
            if name in ("mkdir", "makedirs", "write_text", "write_bytes", "touch") or (opens and not is_private):
                yield node.lineno, name, "use device/atomic_io.py, or its private_opener"


def test_data_is_written_private_whatever_the_umask() -> None:
    """A person who starts the program by hand has umask 022: other users of the computer could read names."""
    user = (
        "services/research/",
        "services/workshop/",
        "services/archive/",
        "services/cli.py",
        "device/sim/scene_files.py",
    )  # write where their user says
    names = [name for name in python_files("device", "services") if not name.startswith((*user, "device/atomic_io.py"))]
    public = "in a folder of every boot, for services of other users"
    allowed = {
        "device/config/marked_files.py: write_bytes": "a picture of a command, where its user says",
        "services/identity/apply_at_boot.py: write_text": public,
        "services/identity/apply_at_boot.py: mkdir": public,
        "services/identity/apply_settings.py: mkdir": public,
        "services/identity/apply_settings.py: write_bytes": public,
        "services/backup/store_contents.py: open": "a tar archive in memory, which is encrypted before it is written",
    }
    check_rule(umask_writes, names, allowed, "write data with device/atomic_io.py")


def folder_lists(source: str) -> Iterator[Violation]:
    """Find lists of the files of a folder: they may hold companions `._NAME` that macOS has written."""
    for node in nodes(source):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name = node.func.attr
            if name in ("iterdir", "glob", "rglob") or ast.unparse(node.func) in (
                "os.listdir",
                "os.scandir",
                "os.walk",
            ):
                yield node.lineno, name, "use files_in of device/user_files.py"


def test_folders_are_listed_without_hidden_companions() -> None:
    """A stick, a card or a data set that a Mac has touched holds a file `._NAME` beside each file."""
    names = [name for name in python_files("device", "services") if name != "device/user_files.py"]
    whole = "all that a folder holds, hidden or not, is counted, copied, moved or removed"
    parts = "parts of interrupted writes, whose names begin with a dot"
    own = "names that only this program or the kernel gives, in a folder that no other program writes"
    allowed = {
        "device/atomic_io.py: rglob": whole,
        "services/backup/restore_backup.py: iterdir": whole,
        "services/backup/restore_backup.py: rglob": whole,
        "services/records/quarantine.py: iterdir": whole,
        "services/records/read_only_store.py: iterdir": whole,
        "services/records/restoration.py: iterdir": whole,
        "services/records/removed_captures.py: glob": whole,
        "services/records/removed_captures.py: iterdir": whole,
        "services/records/capture_journal.py: iterdir": whole,
        "services/identity/card_settings.py: glob": whole,
        "device/calibration/archive.py: glob": parts,
        "services/archive/result.py: glob": parts,
        "services/update/sources.py: glob": parts,
        "device/config/device_nodes.py: glob": own,
        "services/health/collector.py: glob": own,
        "services/identity/apply_at_boot.py: glob": own,
        "services/records/capture_journal.py: glob": own,
    }
    check_rule(folder_lists, names, allowed, "list folders with files_in")


# Leftovers


def leftovers(source: str) -> Iterator[Violation]:
    for number, line in enumerate(source.splitlines(), 1):
        for mark in re.findall(r"\b(?:TO[D]O|FIX[M]E|X[X]X)\b", line):
            yield number, mark, "do it, or write an issue"
        for place in re.findall(r"(?<![\w./>])/(?:work|root|home|tmp)(?![\w-])", line):
            yield number, place, "a path of one machine"


def workplace_words(source: str) -> Iterator[Violation]:
    """Find words about the author's workplace; recordings beside the repository are allowed in data tests."""
    for number, line in enumerate(source.splitlines(), 1):
        for word in re.findall(r"\b(?:sessio[n]|helpe[r])s?\b", line, re.IGNORECASE):
            yield number, word.lower(), "describe the thing itself"
        data = "mark.data" in source or "data: reads real recordings" in line
        for place in re.findall(r"\bshared[/]\w*", line.replace("../shared" + "/data", "") if data else line):
            yield number, place, "not part of this repository"


def prose(source: str) -> str:
    """Return a Python file with names and operators blanked; comments and strings stay on their lines."""
    lines = [""] * (source.count("\n") + 2)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if tokenize.tok_name[token.type] in ("COMMENT", "STRING", "FSTRING_MIDDLE") and token.string != '"session"':
            for offset, line in enumerate(token.string.splitlines()):
                lines[token.start[0] - 1 + offset] += f" {line}"
    return "\n".join(lines)


def workplace_words_in_prose(source: str) -> Iterator[Violation]:
    """Find the same words in comments and strings; identifiers may be names of a library (SQLAlchemy, pytest)."""
    yield from workplace_words(prose(source))


def test_no_unfinished_mark_or_machine_path_is_left() -> None:
    """Marks of unfinished work, paths of one machine and words about the workplace do not help any reader."""
    binary = {".png", ".jpg", ".npy", ".tiff", ".gz", ".zip", ".sqlite", ".copy", ".calibration", ".npz"}
    keys = {"patient-keys", "patient-keys-copy"}  # binary too, of the golden store
    readable = [name for name in files() if Path(name).suffix not in binary and Path(name).name not in keys]
    check_rule(leftovers, readable, {}, "remove it")
    check_rule(workplace_words, [name for name in readable if not name.endswith(".py")], {}, "remove it")
    own = {
        "tests/test_architecture.py: session": "this file names what it looks for",
        "tests/appliance/bench.py: session": "what D-Bus calls a bus that is not the whole computer's",
    }
    check_rule(workplace_words_in_prose, python_files(""), own, "remove it")


AVOIDED = re.compile(
    rf"\b(?:{'|'.join(tomllib.loads(text('pyproject.toml'))['tool']['diffuscope']['avoided-words'])})\b", re.IGNORECASE
)
RECORDS = ("tests/golden/records/", "tests/golden/kept", "tests/frozen_names.txt")


def frozen_names(name: str) -> list[str]:
    """Return the names that stay as they are in a file (`FILE: WORD`) or in every file, the longest first."""
    lines = [line.split("  #")[0] for line in text("tests/frozen_names.txt").splitlines() if line[:1] not in ("", "#")]
    words = [line.removeprefix(f"{name}: ") for line in lines if ": " not in line or line.startswith(f"{name}: ")]
    return sorted(words, key=len, reverse=True)


def without_strings(name: str) -> str:
    """Return a source file without its strings, which may be shown to users; docstrings and comments stay."""
    source = text(name)
    if name.endswith(".js"):
        return re.sub(r'"(?:[^"\\\n]|\\.)*"|`[^`]*`', '""', source)
    if not name.endswith(".py"):
        return source
    described = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        node.body[0].lineno
        for node in nodes(source)
        if isinstance(node, described) and node.body and ast.get_docstring(node, clean=False) is not None
    }
    kept = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_string = tokenize.tok_name[token.type] in ("STRING", "FSTRING_MIDDLE")
        if not is_string or token.start[0] in docstrings:
            kept.append(token.string)
    return " ".join(kept)


def avoided_words(name: str) -> list[str]:
    """Return the avoided words in the names, comments and docstrings of a file, without its frozen names."""
    rest = without_strings(name)
    for frozen in frozen_names(name):
        rest = re.sub(rf"(?<!\w){re.escape(frozen)}(?!\w)", "", rest)
    return AVOIDED.findall(rest)


def test_names_comments_and_docstrings_use_standard_terms() -> None:
    """The avoided words of pyproject.toml occur in frozen names only."""
    names = [
        name
        for name in files()
        if name.startswith(("device/", "services/", "web/", "tests/"))
        and not name.startswith(RECORDS)
        and Path(name).suffix in {".py", ".js", ".css", ".html", ".md", ".toml", ".txt", ".mako", ""}
    ]
    found = [f"{name}: {word}" for name in names for word in avoided_words(name)]
    assert not found, "\n".join(found)


def test_the_top_level_is_fixed() -> None:
    """The top level has the six folders of the design and the files that belong to all of them."""
    assert {name.split("/")[0] for name in files()} <= {*TOP_FOLDERS, *TOP_FILES}


# Examples of each rule

BROKEN: list[tuple[Finder, str]] = [
    (hardware_imports, "def f():\n    import spidev"),
    (hardware_imports, "from gpiod.line import Value"),
    (eager_hardware_imports, "import picamera2"),
    (web_imports, "from sqlalchemy.orm import Session"),
    (long_functions, "def f():\n" + "    x = 1\n" * 41),
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
    (patches, "from device import atomic_io\natomic_io.RESERVE_BYTES = 0"),
    (time_sources, "from time import sleep"),
    (time_sources, "import datetime\ndatetime.datetime.now()"),
    (time_sources, "import asyncio\nasync def f():\n    await asyncio.sleep(1)"),
    (file_calls, "import os\nos.fsync(3)"),
    (file_calls, "import os\nos.replace(a, b)"),
    (file_calls, "part.replace(path)"),
    (file_calls, "part.rename(path)"),
    (file_calls, "import fcntl\nfcntl.flock(file, fcntl.LOCK_EX)"),
    (umask_writes, "path.write_text('a')"),
    (umask_writes, "folder.mkdir(parents=True)"),
    (umask_writes, "open(path, 'a')"),
    (umask_writes, "path.open('wb')"),
    (folder_lists, "for path in folder.iterdir(): ..."),
    (folder_lists, "sorted(folder.glob('*.tiff'))"),
    (folder_lists, "import os\nos.walk('.')"),
    (raw_lamps, "def f(self):\n    return self._lamp(None)"),
    (raw_lamps, "def f(world):\n    with SimLight(world).on(illumination): ..."),
    (leftovers, "# TO" + "DO: later"),
    (leftovers, "see " + "/wo" + "rk/main"),
    (workplace_words, "from " + "shared" + "/knowledge"),
    (workplace_words, "read ../shared/data here"),
    (workplace_words_in_prose, "x = 1  # as in the last session"),
    (long_functions, "def f():\n    def g():\n" + "        x = 1\n" * 40),
    (large_classes, "class A:\n" + "".join(f"    def m{k}(self): ...\n" for k in range(16))),
    (large_classes, "class A:\n    def f(self):\n" + "".join(f"        self.a{k} = 1\n" for k in range(17))),
    (size_comments, "def f():  # size: a long table of constants of the standard\n    x = 1"),
    (size_comments, "def f():  # size:\n" + "    x = 1\n" * 41),
    (size_comments, "def f():  # noqa: C901\n    x = 1"),
    (private_accesses, "def test(exam):\n    exam._state"),
    (private_accesses, "def test(exam):\n    getattr(exam, '_state')"),
    (untyped_dicts, "def f(report: dict[str, Any]): ..."),
    (untyped_dicts, "async def f(*, changes: Mapping[str, Any] | None = None): ..."),
    (untyped_dicts, "class A:\n    def f(self) -> tuple[int, list[dict[str, Any]]]: ..."),
    (untyped_dicts, 'def f() -> "dict[str, typing.Any]": ...'),
    (untyped_dicts, "@dataclass(frozen=True)\nclass A:\n    light: dict[str, Any] = field(default_factory=dict)"),
    (untyped_dicts, "Found = dict[str, Any]"),
]
FINE: list[tuple[Finder, str]] = [
    (eager_hardware_imports, "def f():\n    import picamera2"),
    (long_functions, "def f():\n    '''It.'''\n\n    # why\n" + "    x = 1\n" * 40),
    (unitless, "def f(exposure_s: float, white: int, gain_e_per_dn: float, level: float): ..."),
    (unitless, "def _f(exposure: float): ..."),
    (swallowers, "try:\n    x\nexcept BaseException:\n    y()\n    raise"),
    (patches, "from device.clock import VirtualClock\nclock = VirtualClock()\nclock.elapsed_s = 1"),
    (time_sources, "from datetime import datetime\ndatetime.fromisoformat('2026-01-01')"),
    (file_calls, "'a-b'.replace('-', '+')\nreplace(spec, name=1)\nday.replace(hour=0)"),
    (leftovers, "Path.home() / 'work'"),
    (workplace_words, "pytest.mark.data: ../shared/data/fundus"),
    (workplace_words_in_prose, 'import pytest\nwith Session(engine) as session:\n    scope = "session"'),
    (long_functions, "def f():  # size: a long table of constants of the standard\n" + "    x = 1\n" * 41),
    (large_classes, "@dataclass(frozen=True)\nclass A:\n" + "".join(f"    a{k}: int\n" for k in range(17))),
    (size_comments, "def f():  # size: a long table of constants of the standard\n" + "    x = 1\n" * 41),
    (private_accesses, "import os\nclass A:\n    def f(self):\n        os._exit(self._code)"),
    (untyped_dicts, "def f(numbers: Mapping[str, float]) -> None:\n    entry: dict[str, Any] = json.loads(text)"),
]


@pytest.mark.parametrize(("finder", "source"), BROKEN)
def test_a_finder_finds_a_violation(finder: Finder, source: str) -> None:
    assert list(finder(source))


@pytest.mark.parametrize(("finder", "source"), FINE)
def test_a_finder_accepts_correct_code(finder: Finder, source: str) -> None:
    assert not list(finder(source))
