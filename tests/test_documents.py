"""Rules of the documents: length and links of READMEs, names in them, snippets, tables of threads and of terms."""

import ast
import re
from collections.abc import Iterator
from contextlib import chdir
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import signal

from tests.bench.readme import rows as rows_of_first_readme
from tests.project_files import ROOT, TOP_FOLDERS, files, nodes, python_files, text
from tests.scenes import speckle

SITE = "services/research/site/"
DOCUMENTS = [
    name
    for name in files()
    if name.endswith(".md") and not re.search(r"/decisions/|^tests/golden/(kept|records)|^CHANGELOG", name)
]
PAGES = [name for name in DOCUMENTS if Path(name).name == "README.md" or name.startswith(SITE)]
FENCE = re.compile(r"^ *```.*?^ *```$", re.M | re.S)


@cache
def places() -> frozenset[str]:
    """Return every file and folder of the repository."""
    return frozenset(str(path) for name in files() for path in (Path(name), *Path(name).parents))


# Length, links and names


def test_the_first_readme_is_short() -> None:
    """A reader sees the purpose, one command, what was asked and the map on a few screens."""
    lines = text("README.md").splitlines()
    assert len(lines) <= 110
    assert not [line for line in lines if len(line) > (360 if line.startswith("|") else 160)]  # a row is one line


def test_each_row_of_what_was_asked_has_files_a_command_and_words_to_find() -> None:
    """`make readme` runs the commands; make targets, commands of `diffuscope` and their options are tested apart."""
    assert len(rows_of_first_readme()) >= 16
    for row in rows_of_first_readme():
        assert row.where
        assert row.promised, row.command
        missing = [path for path in re.findall(r"tests/\S+\.py", row.command) if path not in places()]
        missing += [path for path in row.where if path.rstrip("/") not in places()]
        assert not missing


def anchors(markdown: str) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", markdown), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", [name for name in DOCUMENTS if not name.startswith(SITE)])
def test_links_of_a_document_resolve(document: str) -> None:
    """Every relative link and picture is a file or folder, every anchor a heading; its build checks the site."""
    broken = []
    for link in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", FENCE.sub("", text(document))):
        path, _, anchor = link.partition("#")
        target = document if not path else str((ROOT / document).parent.joinpath(path).resolve().relative_to(ROOT))
        if target not in places() or (anchor and anchor not in anchors(text(target))):
            broken.append(link)
    assert not broken


def is_name(dotted: str) -> bool:
    """Return whether a dotted name is a module or package, or a name that a module binds or imports."""
    words = dotted.split(".")
    for end in range(len(words), 0, -1):
        path, rest = "/".join(words[:end]), words[end:]
        if source := next((name for name in (f"{path}.py", f"{path}/__init__.py") if name in places()), None):
            return not rest or re.search(rf"\b{rest[0]}\b", text(source)) is not None
    return False


def is_test(file: str, name: str) -> bool:
    """Return whether a file of the repository has the test."""
    return file in places() and f"\ndef {name}(" in text(file)


def missing_names(markdown: str) -> list[str]:
    """Return the modules, files and tests in code spans that the repository does not have."""
    spans = re.findall(r"`([^`\n]+)`", FENCE.sub("", markdown))
    modules = [span for span in spans if re.fullmatch(rf"(?:{'|'.join(TOP_FOLDERS)})(?:\.\w+)+", span)]
    sources = [span for span in spans if re.fullmatch(r"[\w/-]*[a-z0-9_]\.(?:py|js)", span)]
    tests = [span for span in spans if re.fullmatch(r"tests/[\w/]+\.py::test_\w+", span)]
    vendored = {path.name for path in (ROOT / "web" / "vendor").glob("*.js")}
    missing = [name for name in modules if not is_name(name)]
    missing += [id for id in tests if not is_test(*id.split("::"))]
    return missing + [
        name
        for name in sources
        if name not in vendored and not any(f"/{place}".endswith(f"/{name}") for place in places())
    ]


def test_every_control_of_the_threat_model_names_its_test() -> None:
    """A row without a test belongs to the section of threats without a control."""
    table = [line for line in text(".github/THREAT_MODEL.md").splitlines() if line.startswith("| ")][1:]
    assert len(table) > 40
    assert not [line for line in table if not re.search(r"`tests/[\w/]+\.py::test_\w+` \|$", line)]


def test_a_missing_name_is_noticed() -> None:
    gone = "`device.recon.gone` `services.research.frontier.gone` `gone.py` `core/gone.js`"
    assert missing_names(gone) == gone.replace("`", "").split()
    assert missing_names("`device.recon.methods.METHODS` `exam_loop.py` `core/capture.js` `hardware.parts`") == []
    here = "tests/test_documents.py::test_a_missing_name_is_noticed"
    assert missing_names(f"`{here}` `{here}_not`") == [f"{here}_not"]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_modules_named_in_a_document_exist(document: str) -> None:
    assert not missing_names(text(document))


# Snippets


def snippets() -> Iterator[tuple[str, int, str]]:
    """Yield document, line and code of each fenced Python snippet, but those of the site, whose tests run its pages."""
    for document in DOCUMENTS:
        if document.startswith(SITE):
            continue
        for found in re.finditer(r"^( *)```python\n(.*?)^\1```$", text(document), re.M | re.S):
            line = text(document).count("\n", 0, found.start(2)) + 1
            yield document, line, re.sub(rf"^{found[1]}", "", found[2], flags=re.M)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files that snippets read: raw.tiff, psf.tiff, dark.tiff, truth.npy (96 x 128)."""
    folder = tmp_path_factory.mktemp("recording")
    rng = np.random.default_rng(1)
    psf, truth = speckle((96, 128)), np.zeros((96, 128), np.float32)
    truth[24:72, 32:96] = 20_000 + 10_000 * np.kron(rng.random((12, 16)), np.ones((4, 4)))
    light = signal.fftconvolve(truth, psf, mode="same").clip(0)
    for name, image in (
        ("raw", light + 64 + rng.normal(0, 4, light.shape)),
        ("psf", psf / psf.max() * 60_000 + 64),
        ("dark", np.full_like(light, 64)),
    ):
        tifffile.imwrite(folder / f"{name}.tiff", image.round().astype(np.uint16))
    np.save(folder / "truth.npy", truth)
    return folder


@pytest.mark.parametrize("document", list(dict.fromkeys(document for document, _, _ in snippets())))
def test_python_snippets_of_a_document_run(document: str, recording: Path, tmp_path: Path) -> None:
    """Each snippet runs alone, in a folder with the files of a small recording."""
    for file in recording.iterdir():
        (tmp_path / file.name).symlink_to(file)
    with chdir(tmp_path):
        for _, line, code in (snippet for snippet in snippets() if snippet[0] == document):
            exec(compile("\n" * (line - 1) + code, document, "exec"), {"__name__": "__main__"})


# Decisions

SECTIONS = [
    re.compile(
        r"^# \d+\.? .*\n\n(?:Date: )?20\d\d-\d\d-\d\d.*\n\n"
        rf"{begin}Context{end}(?:.*\n)+?{begin}Decision{end}(?:.*\n)+?{begin}Consequences{end}",
        re.M,
    )
    for begin, end in ((r"## ", r"\n"), (r"\*\*", r"\.\*\*\s"))
]


@pytest.mark.parametrize("decision", [name for name in files() if "/decisions/" in name])
def test_a_decision_has_date_context_decision_and_consequences(decision: str) -> None:
    number = re.match(r"# 0*(\d+)", text(decision))
    assert number is not None
    assert int(number[1]) == int(Path(decision).name[:4])
    assert any(form.match(text(decision)) for form in SECTIONS)


@pytest.mark.parametrize("page", PAGES)
def test_decisions_stand_in_files_of_their_own(page: str) -> None:
    assert not re.search(r"^\*\*20\d\d-|\*Context:\*|\*Decision:\*", text(page), re.M)


# Threads and processes


def started_threads(source: str) -> Iterator[str]:
    """Yield the name of each thread that a module starts; without a name, that of its class."""
    for node in nodes(source) if re.search(r"Thread\(|Timer\(|Executor\(|Worker\(", source) else ():
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        if node.func.id in ("Thread", "Timer", "ThreadPoolExecutor", "PeriodicWorker"):
            given = {key.arg: key.value for key in node.keywords}
            at = {"PeriodicWorker": 0, "ThreadPoolExecutor": 1}.get(node.func.id, 9)
            name = given.get("name") or given.get("thread_name_prefix") or next(iter(node.args[at:]), None)
            if name is None or isinstance(name, ast.Constant):
                yield node.func.id if name is None else str(name.value)


def starts_process(source: str) -> bool:
    """Return whether a module starts a process that runs beside it."""
    return re.search(r"\bPopen\(|\bProcess\(|ProcessPoolExecutor\(|create_subprocess", source) is not None


def rows(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading, without its first two lines."""
    part = text(page).split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_a_started_thread_is_noticed() -> None:
    code = "Thread(target=f, name='a')\nTimer(1, f)\nThreadPoolExecutor(1, 'b')\nPeriodicWorker('c', f, 1, '')\nrun(x)"
    assert sorted(started_threads(code)) == ["Timer", "a", "b", "c"]
    assert starts_process("SPAWNED.Process(target=f)")
    assert starts_process("subprocess.Popen([])")
    assert not starts_process("subprocess.run([])")


def test_the_table_of_threads_is_that_of_the_code() -> None:
    """Each thread that the code starts has a row, and each row with a file has its thread there."""
    started = [(name, file) for file in python_files("device", "services") for name in started_threads(text(file))]
    listed = [
        (row[0].strip("`"), row[1].strip("`")) for row in rows(f"{SITE}threads.md", "Threads of the instrument")[2:]
    ]
    assert sorted(listed) == sorted(started)


def test_the_table_of_processes_is_that_of_the_code() -> None:
    """Each module that starts a process and each service of systemd has a row, and each row one of them."""
    started = {file for file in python_files("device", "services") if starts_process(text(file))}
    started |= {file for file in files() if re.fullmatch(r"systemd/[^/]+\.service", file)}
    listed = [
        set(re.findall(r"`([\w/@.-]+\.(?:py|service))`", row[1])) for row in rows(f"{SITE}threads.md", "Processes")
    ]
    assert set.union(*listed) == started
    assert all(listed)


# Glossary


def test_the_glossary_has_one_sentence_for_each_term() -> None:
    terms = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", text(f"{SITE}glossary.md"), re.M)
    terms = [(term, meaning) for term, meaning in terms if term not in ("term", "---")]
    assert len(terms) > 100
    assert len({term for term, _ in terms}) == len(terms)
    assert not [term for term, meaning in terms if not re.fullmatch(r"[A-Z`].*[^.]\.", meaning) or ". " in meaning]
