"""Simulated power cuts: record the system calls of a program with strace, and cut the power after each.

A disk may lose any unsynced change, in any order. `Disk` simulates such a disk in memory: it follows the recorded calls
and yields the possible contents after a cut. A part of the disk may be FAT, where a rename is three writes. See
README.md for the limits of the simulation.
"""

import random
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

CALLS = (
    "openat,creat,write,pwrite64,writev,pwritev,pwritev2,lseek,ftruncate,truncate,fallocate,rename,renameat,renameat2,"
    "link,linkat,symlink,symlinkat,unlink,unlinkat,rmdir,mkdir,mkdirat,fsync,fdatasync,copy_file_range,sendfile,mmap"
)
LINE = re.compile(r"\d+ +(\w+)\((.*)\) += (0x\w+|\d+)")
WORD = re.compile(r'"((?:\\x..)*)"')
OPENED = re.compile(r"\d+<((?:\\x..)*)>")
OPEN = re.compile(r"^(?:AT_FDCWD|\d+)<((?:\\x..)*)>")
DRAWS = 3
MAX_ALONE = 8  # the last changes, each of which is once the only survivor
SECTOR_BYTES = 512


def record_calls(words: list[str], folder: Path, cwd: Path, devices: Mapping[str, Path] | None = None) -> list[str]:
    """Run a program under strace; return the calls that changed anything below a folder, and its output, in order.

    `devices`: device paths that are replaced by files of the folder.
    """
    if shutil.which("strace") is None:
        raise RuntimeError("strace is missing; tests/hard/install installs it")
    log, below = folder / "log", _escaped(folder)
    trace = ["strace", "-f", "--seccomp-bpf", "-y", "-xx", "-s", "100000000", "-e", f"trace={CALLS}", "-o", str(log)]
    subprocess.run([*trace, "-e", "signal=none", *words], cwd=cwd, stdout=subprocess.DEVNULL, check=True)
    recorded = log.read_text("ascii")
    for device, file in (devices or {}).items():
        for end in '>"':
            recorded = recorded.replace(_escaped(Path(device)) + end, _escaped(file) + end)
    calls = (line for line in _joined_calls(recorded.splitlines()) if below in line or " write(1<" in line)
    return [line for line in calls if " = -1 " not in line]


def _joined_calls(lines: list[str]) -> Iterator[str]:
    """Join calls that strace recorded in two parts, at the position of the second part."""
    begun: dict[str, str] = {}
    for line in lines:
        pid, _, rest = line.partition(" ")
        if rest.endswith("<unfinished ...>"):
            begun[pid] = line.removesuffix("<unfinished ...>").rstrip()
        elif resumed := re.match(r" *<\.\.\. \w+ resumed>", rest):
            yield begun.pop(pid) + rest[resumed.end() :]
        else:
            yield line


def _escaped(path: Path) -> str:
    return "".join(f"\\x{byte:02x}" for byte in bytes(path))


def unescape(escaped: str) -> bytes:
    return bytes.fromhex(escaped.replace("\\x", ""))


@dataclass(eq=False)
class DiskEntry:
    """File or folder: content visible to programs, content certainly on the disk, and the changes since."""

    visible: "bytearray | dict[str, DiskEntry]"
    durable: "bytes | dict[str, DiskEntry]"
    pending: list[tuple[object, ...]] = field(default_factory=list)

    def do(self, *change: object) -> tuple[object, ...]:
        self.pending.append(change)
        _apply(self.visible, change)
        return change

    def sync(self) -> None:
        """Make all changes durable; on FAT the entry of a file is written with the file, not with its folder."""
        if isinstance(self.visible, bytearray):
            self.durable, self.pending = bytes(self.visible), []
            return
        assert isinstance(self.durable, dict)
        placed = [change for change in self.pending if change[0] == "place"]
        for change in self.pending:
            if change not in placed:
                _apply(self.durable, change)
        self.pending = placed

    def place(self, thing: "DiskEntry") -> None:
        """Make the directory entry of a file durable, with its name."""
        assert isinstance(self.durable, dict)
        for change in [change for change in self.pending if change[0] == "place" and change[2] is thing]:
            _apply(self.durable, change)
            self.pending = [other for other in self.pending if other[:2] not in (("name", change[1]), change[:2])]


def _apply(to: "bytearray | dict[str, DiskEntry]", change: tuple[object, ...]) -> None:
    match change, to:
        case ("write", int(at), bytes(data)), bytearray():
            to.extend(bytes(max(0, at - len(to))))
            to[at : at + len(data)] = data
        case ("length", int(length)), bytearray():
            del to[length:]
            to.extend(bytes(length - len(to)))
        case ("name" | "place", str(name), DiskEntry() as thing), dict():
            to[name] = thing
        case ("freed",), bytearray():
            to[:] = bytes(len(to))
        case ("forget", str(name), *_), dict():
            to.pop(name, None)
        case ("rename", str(name), str(new), DiskEntry() as thing), dict():  # atomic within one folder
            to[new] = thing
            if to.get(name) is thing:
                del to[name]
        case _:
            raise AssertionError(f"{change[0]} of a {type(to).__name__}")


Survives = Callable[[DiskEntry, tuple[object, ...]], tuple[object, ...] | None]


class Disk:
    """Folder on a disk that loses unsynced data; its initial content is durable.

    `fat`: folders on FAT, mounted without `sync`. `parts`: subfolders on the disk, if not all.
    """

    def __init__(self, folder: Path, before: Path, fat: tuple[str, ...] = (), parts: tuple[str, ...] = ("",)) -> None:
        self._at, self._fat = f"{folder}/", fat
        self._prefixes = tuple(f"{folder}/{part}" for part in parts)
        self._root = _read_tree(before)
        self._offsets: dict[tuple[str, int], int] = {}
        self.output = ""

    def follow(self, line: str) -> bool:
        """Apply one recorded call; return whether it changed this disk or was output of the program."""
        call, words, result = _parsed(line)
        if call == "write" and words.startswith("1<"):
            self.output += unescape(WORD.findall(words)[0]).decode()
            return True
        paths = self._paths(call, words)
        if not any(f"{path}/".startswith(self._prefixes) for path in paths):
            return False
        return self._do(call, words, result, [f"{path}/".removeprefix(self._at).rstrip("/") for path in paths])

    def _paths(self, call: str, words: str) -> list[str]:
        if call in ("rename", "unlink", "rmdir", "mkdir", "openat", "unlinkat", "mkdirat", "renameat2"):
            base = OPEN.match(words)
            named = [unescape(word).decode() for word in WORD.findall(words)]
            return [
                name if name.startswith("/") else f"{unescape(base[1]).decode()}/{name}"
                for name in named
                if base or name
            ]
        return [unescape(path).decode() for path in OPENED.findall(words)]

    def _do(self, call: str, words: str, result: int, paths: list[str]) -> bool:
        """Apply a call; return whether it changed anything."""
        name = paths[0].rpartition("/")[2]
        match call:
            case "openat":
                return self._open(paths[0], words, (paths[0], result))
            case "mmap":
                assert "PROT_WRITE" not in words or "MAP_SHARED" not in words or name.endswith("-shm"), words
                return False
            case "fsync" | "fdatasync":
                self._thing(paths[0]).sync()
                if paths[0]:
                    self._folder(paths[0]).place(self._thing(paths[0]))
            case "mkdir" | "mkdirat":
                self._folder(paths[0]).do("name", name, DiskEntry({}, {}))
            case "unlink" | "rmdir" | "unlinkat":
                self._folder(paths[0]).do("forget", name)
            case "rename" | "renameat2":
                self._rename(*paths)
            case _:
                return self._write(call, words, result, paths)
        return True

    def _write(self, call: str, words: str, result: int, paths: list[str]) -> bool:
        place, thing = (paths[0], int(words.split("<")[0])), self._thing(paths[0])
        match call:
            case "lseek":
                self._offsets[place] = result
                return False
            case "write" | "pwrite64":
                data = unescape(WORD.findall(words)[0])[:result]
                at = int(words.rsplit(",", 1)[1]) if call == "pwrite64" else self._offsets.get(place, 0)
                self._offsets[place] = at + result
                thing.do("write", at, data)
            case "sendfile":  # complete copy of a file of this disk
                source = self._thing(paths[1]).visible
                assert isinstance(source, bytearray)
                assert result in (0, len(source)), words
                thing.do("write", 0, bytes(source[:result]))
            case "ftruncate":
                thing.do("length", int(words.rsplit(",", 1)[1]))
            case "fallocate":
                thing.do("length", max(len(thing.visible), sum(map(int, words.rsplit(",", 2)[1:]))))
            case _:
                raise AssertionError(f"the simulated disk does not support {call}")
        return True

    def _open(self, path: str, words: str, place: tuple[str, int]) -> bool:
        """Apply an open call, which may create or truncate the file."""
        folder, name = self._folder(path), path.rpartition("/")[2]
        assert isinstance(folder.visible, dict)
        made = name not in folder.visible and "O_CREAT" in words
        if made:
            folder.do("name", name, DiskEntry(bytearray(), b""))
        thing = folder.visible.get(name)
        empties = thing is not None and "O_TRUNC" in words and bool(thing.visible)
        if thing is not None and empties:
            thing.do("length", 0)
        self._offsets[place] = len(thing.visible) if thing is not None and "O_APPEND" in words else 0
        return made or empties

    def _rename(self, old: str, new: str) -> None:
        thing, source, target = self._thing(old), self._folder(old), self._folder(new)
        names = old.rpartition("/")[2], new.rpartition("/")[2]
        if new.split("/")[0] in self._fat:
            _rename_on_fat(source, target, names, thing)
        elif source is target:
            source.do("rename", *names, thing)
        else:  # a journaling file system removes the old name after it stores the new one
            source.do("forget", names[0], target.do("name", names[1], thing))

    def _folder(self, path: str) -> DiskEntry:
        return self._thing(path.rpartition("/")[0])

    def _thing(self, path: str) -> DiskEntry:
        thing = self._root
        for name in filter(None, path.split("/")):
            assert isinstance(thing.visible, dict)
            thing = thing.visible[name]
        return thing

    def as_seen(self) -> dict[str, bytes | None]:
        """Return the content that programs see now, by path; None is a folder."""
        left: dict[str, bytes | None] = {}
        _collect(self._root, "", lambda thing, change: change, left)
        return left

    def cuts(self, draw: random.Random, draws: int = DRAWS) -> Iterator[dict[str, bytes | None]]:
        """Yield possible contents after a power cut now, by path; None is a folder.

        All unsynced changes are lost; none is; only names remain; only content remains; each change alone; random
        subsets.
        """
        waiting: list[tuple[object, ...]] = []
        _collect(self._root, "", lambda thing, change: waiting.append(change) or change, {})  # type: ignore[func-returns-value]
        ways: list[Survives] = [
            lambda thing, change: None,
            lambda thing, change: change,
            lambda thing, change: change if isinstance(thing.visible, dict) else None,
            lambda thing, change: change if isinstance(thing.visible, bytearray) else None,
        ]

        def some(thing: DiskEntry, change: tuple[object, ...]) -> tuple[object, ...] | None:
            if draw.random() < 0.5:
                return None
            match change:
                case ("write", at, bytes(data)) if draw.random() < 0.3:
                    return "write", at, data[: SECTOR_BYTES * draw.randint(0, len(data) // SECTOR_BYTES)]
            return change

        alone = [partial(_alone, change) for change in waiting[-MAX_ALONE:]]
        for way in (*ways, *alone, *[some] * draws):
            left: dict[str, bytes | None] = {}
            _collect(self._root, "", _together(way, waiting), left)
            yield left


def _rename_on_fat(source: DiskEntry, target: DiskEntry, names: tuple[str, str], thing: DiskEntry) -> None:
    """Apply a rename on FAT as three separate writes: new entry, its location, removal of the old entry.

    The clusters of an overwritten file are freed: its old entry, if it remains, refers to arbitrary content.
    """
    assert isinstance(target.visible, dict)
    before = target.visible.get(names[1])
    if before is None:
        target.do("name", names[1], DiskEntry(type(thing.visible)(), type(thing.durable)()))
    else:
        before.do("freed")
    target.do("place", names[1], thing)
    source.do("forget", names[0])


def _alone(survivor: tuple[object, ...], thing: DiskEntry, change: tuple[object, ...]) -> tuple[object, ...] | None:
    return change if change is survivor else None


def _together(way: Survives, waiting: list[tuple[object, ...]]) -> Survives:
    """Return the same rule, but an old name disappears only if the new name in another folder exists."""
    kept: dict[int, tuple[object, ...] | None] = {}
    ids = {id(change) for change in waiting}

    def decide(thing: DiskEntry, change: tuple[object, ...]) -> tuple[object, ...] | None:
        if id(change) not in kept:
            kept[id(change)] = way(thing, change)
        match change:
            case ("forget", _, tuple() as moved) if id(moved) in ids and decide(thing, moved) is None:
                return None
        return kept[id(change)]

    return decide


def _parsed(line: str) -> tuple[str, str, int]:
    found = LINE.match(line)
    assert found, f"unknown line of strace: {line[:200]}"
    return found[1], found[2], int(found[3], 0)


def _read_tree(place: Path) -> DiskEntry:
    if place.is_dir():
        names = {path.name: _read_tree(path) for path in place.iterdir()}
        return DiskEntry(names, dict(names))
    content = place.read_bytes()
    return DiskEntry(bytearray(content), content)


def _collect(thing: DiskEntry, path: str, way: Survives, left: dict[str, bytes | None]) -> None:
    content = bytearray(thing.durable) if isinstance(thing.durable, bytes) else dict(thing.durable)
    for change in thing.pending:
        if (survived := way(thing, change)) is not None:
            _apply(content, survived)
    if isinstance(content, bytearray):
        left[path] = bytes(content)
        return
    left[path] = None
    for name, inner in content.items():
        if not name.endswith("-shm"):  # index that SQLite rebuilds after every power cut
            _collect(inner, f"{path}/{name}", way, left)


def write_tree(left: dict[str, bytes | None], to: Path) -> Path:
    """Write the remaining content into a real folder."""
    for path, content in left.items():
        place = to / path.lstrip("/")
        if content is None:
            place.mkdir()
        else:
            place.write_bytes(content)
    return to
