"""Power cuts: what a program wrote is noted down call by call, and cut off after each of them.

A disk may forget whatever was not synced, any part of it, in any order. `Disk` is such a disk in memory: it follows the
system calls that `strace` noted, and says what it could hold after a cut. A part of it may be FAT, where a rename is
three writes. See README.md for what it does not know.
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
MOST_ALONE = 8  # changes of which each is once the only one that is left: the last ones
SECTOR_BYTES = 512


def noted(words: list[str], folder: Path, cwd: Path, devices: Mapping[str, Path] | None = None) -> list[str]:
    """Run a program under strace; what it said, and the calls that did something below a folder, in order.

    `devices` are read as if they were files in there.
    """
    if shutil.which("strace") is None:
        raise RuntimeError("strace is missing; tests/hard/install installs it")
    log, below = folder / "log", _escaped(folder)
    trace = ["strace", "-f", "--seccomp-bpf", "-y", "-xx", "-s", "100000000", "-e", f"trace={CALLS}", "-o", str(log)]
    subprocess.run([*trace, "-e", "signal=none", *words], cwd=cwd, stdout=subprocess.DEVNULL, check=True)
    said = log.read_text("ascii")
    for device, file in (devices or {}).items():
        for end in '>"':
            said = said.replace(_escaped(Path(device)) + end, _escaped(file) + end)
    calls = (line for line in _in_one(said.splitlines()) if below in line or " write(1<" in line)
    return [line for line in calls if " = -1 " not in line]


def _in_one(lines: list[str]) -> Iterator[str]:
    """Calls that strace noted in two halves, since others came between, stand where they ended."""
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


def plain(escaped: str) -> bytes:
    return bytes.fromhex(escaped.replace("\\x", ""))


@dataclass(eq=False)
class Thing:
    """A file or a folder: what programs see, what is on the disk for certain, and what was done since."""

    now: "bytearray | dict[str, Thing]"
    sure: "bytes | dict[str, Thing]"
    since: list[tuple[object, ...]] = field(default_factory=list)

    def do(self, *change: object) -> tuple[object, ...]:
        self.since.append(change)
        _apply(self.now, change)
        return change

    def sync(self) -> None:
        """All is on the disk; but on FAT, where a thing lies is written with the thing, not with its folder."""
        if isinstance(self.now, bytearray):
            self.sure, self.since = bytes(self.now), []
            return
        assert isinstance(self.sure, dict)
        placed = [change for change in self.since if change[0] == "place"]
        for change in self.since:
            if change not in placed:
                _apply(self.sure, change)
        self.since = placed

    def place(self, thing: "Thing") -> None:
        """Where a thing in this folder lies is on the disk, and with it, in one entry, what it is called."""
        assert isinstance(self.sure, dict)
        for change in [change for change in self.since if change[0] == "place" and change[2] is thing]:
            _apply(self.sure, change)
            self.since = [other for other in self.since if other[:2] not in (("name", change[1]), change[:2])]


def _apply(to: "bytearray | dict[str, Thing]", change: tuple[object, ...]) -> None:
    match change, to:
        case ("write", int(at), bytes(data)), bytearray():
            to.extend(bytes(max(0, at - len(to))))
            to[at : at + len(data)] = data
        case ("length", int(length)), bytearray():
            del to[length:]
            to.extend(bytes(length - len(to)))
        case ("name" | "place", str(name), Thing() as thing), dict():
            to[name] = thing
        case ("freed",), bytearray():
            to[:] = bytes(len(to))
        case ("forget", str(name), *_), dict():
            to.pop(name, None)
        case ("rename", str(name), str(new), Thing() as thing), dict():  # one step, if it is within one folder
            to[new] = thing
            if to.get(name) is thing:
                del to[name]
        case _:
            raise AssertionError(f"{change[0]} of a {type(to).__name__}")


Survives = Callable[[Thing, tuple[object, ...]], tuple[object, ...] | None]


class Disk:
    """A folder on a disk that forgets; everything in it at the beginning is there for certain.

    `fat` names the folders in it that are FAT, without `sync` among the words of their mount; `parts` what of the
    folder is on the disk, if not all of it.
    """

    def __init__(self, folder: Path, before: Path, fat: tuple[str, ...] = (), parts: tuple[str, ...] = ("",)) -> None:
        self._at, self._fat = f"{folder}/", fat
        self._on_it = tuple(f"{folder}/{part}" for part in parts)
        self._root = _found(before)
        self._places: dict[tuple[str, int], int] = {}
        self.said = ""

    def follow(self, line: str) -> bool:
        """Do what a call did; whether it changed this disk, or was a word of the program."""
        call, words, result = _parsed(line)
        if call == "write" and words.startswith("1<"):
            self.said += plain(WORD.findall(words)[0]).decode()
            return True
        paths = self._paths(call, words)
        if not any(f"{path}/".startswith(self._on_it) for path in paths):
            return False
        return self._do(call, words, result, [f"{path}/".removeprefix(self._at).rstrip("/") for path in paths])

    def _paths(self, call: str, words: str) -> list[str]:
        if call in ("rename", "unlink", "rmdir", "mkdir", "openat", "unlinkat", "mkdirat", "renameat2"):
            base = OPEN.match(words)
            named = [plain(word).decode() for word in WORD.findall(words)]
            return [
                name if name.startswith("/") else f"{plain(base[1]).decode()}/{name}" for name in named if base or name
            ]
        return [plain(path).decode() for path in OPENED.findall(words)]

    def _do(self, call: str, words: str, result: int, paths: list[str]) -> bool:
        """Whether the call changed something."""
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
                self._folder(paths[0]).do("name", name, Thing({}, {}))
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
                self._places[place] = result
                return False
            case "write" | "pwrite64":
                data = plain(WORD.findall(words)[0])[:result]
                at = int(words.rsplit(",", 1)[1]) if call == "pwrite64" else self._places.get(place, 0)
                self._places[place] = at + result
                thing.do("write", at, data)
            case "sendfile":  # a whole copy of a file on this disk
                source = self._thing(paths[1]).now
                assert isinstance(source, bytearray)
                assert result in (0, len(source)), words
                thing.do("write", 0, bytes(source[:result]))
            case "ftruncate":
                thing.do("length", int(words.rsplit(",", 1)[1]))
            case "fallocate":
                thing.do("length", max(len(thing.now), sum(map(int, words.rsplit(",", 2)[1:]))))
            case _:
                raise AssertionError(f"this disk does not know {call}")
        return True

    def _open(self, path: str, words: str, place: tuple[str, int]) -> bool:
        """A file that is opened may be made, or emptied."""
        folder, name = self._folder(path), path.rpartition("/")[2]
        assert isinstance(folder.now, dict)
        made = name not in folder.now and "O_CREAT" in words
        if made:
            folder.do("name", name, Thing(bytearray(), b""))
        thing = folder.now.get(name)
        empties = thing is not None and "O_TRUNC" in words and bool(thing.now)
        if thing is not None and empties:
            thing.do("length", 0)
        self._places[place] = len(thing.now) if thing is not None and "O_APPEND" in words else 0
        return made or empties

    def _rename(self, old: str, new: str) -> None:
        thing, source, target = self._thing(old), self._folder(old), self._folder(new)
        names = old.rpartition("/")[2], new.rpartition("/")[2]
        if new.split("/")[0] in self._fat:
            _rename_on_fat(source, target, names, thing)
        elif source is target:
            source.do("rename", *names, thing)
        else:  # a journal does not forget the old name before it knows the new one
            source.do("forget", names[0], target.do("name", names[1], thing))

    def _folder(self, path: str) -> Thing:
        return self._thing(path.rpartition("/")[0])

    def _thing(self, path: str) -> Thing:
        thing = self._root
        for name in filter(None, path.split("/")):
            assert isinstance(thing.now, dict)
            thing = thing.now[name]
        return thing

    def as_seen(self) -> dict[str, bytes | None]:
        """What programs see now, by path; None is a folder."""
        left: dict[str, bytes | None] = {}
        _collect(self._root, "", lambda thing, change: change, left)
        return left

    def cuts(self, draw: random.Random, draws: int = DRAWS) -> Iterator[dict[str, bytes | None]]:
        """What could be on the disk if the power went now, by path; None is a folder.

        All that was not synced is gone; nothing is; only names are left; only content; each change alone; and draws of
        any part of it.
        """
        waiting: list[tuple[object, ...]] = []
        _collect(self._root, "", lambda thing, change: waiting.append(change) or change, {})  # type: ignore[func-returns-value]
        ways: list[Survives] = [
            lambda thing, change: None,
            lambda thing, change: change,
            lambda thing, change: change if isinstance(thing.now, dict) else None,
            lambda thing, change: change if isinstance(thing.now, bytearray) else None,
        ]

        def some(thing: Thing, change: tuple[object, ...]) -> tuple[object, ...] | None:
            if draw.random() < 0.5:
                return None
            match change:
                case ("write", at, bytes(data)) if draw.random() < 0.3:
                    return "write", at, data[: SECTOR_BYTES * draw.randint(0, len(data) // SECTOR_BYTES)]
            return change

        alone = [partial(_alone, one) for one in waiting[-MOST_ALONE:]]
        for way in (*ways, *alone, *[some] * draws):
            left: dict[str, bytes | None] = {}
            _collect(self._root, "", _together(way, waiting), left)
            yield left


def _rename_on_fat(source: Thing, target: Thing, names: tuple[str, str], thing: Thing) -> None:
    """Three writes, of which any may be left: a new entry that leads nowhere, where it leads, the old entry's end.

    Of a file that was there before, the room is given back: its entry, if it is left as it was, leads to anything.
    """
    assert isinstance(target.now, dict)
    before = target.now.get(names[1])
    if before is None:
        target.do("name", names[1], Thing(type(thing.now)(), type(thing.sure)()))
    else:
        before.do("freed")
    target.do("place", names[1], thing)
    source.do("forget", names[0])


def _alone(one: tuple[object, ...], thing: Thing, change: tuple[object, ...]) -> tuple[object, ...] | None:
    return change if change is one else None


def _together(way: Survives, waiting: list[tuple[object, ...]]) -> Survives:
    """The same, but the old name of what was moved to another folder goes only if the new one is there."""
    kept: dict[int, tuple[object, ...] | None] = {}
    ids = {id(change) for change in waiting}

    def decide(thing: Thing, change: tuple[object, ...]) -> tuple[object, ...] | None:
        if id(change) not in kept:
            kept[id(change)] = way(thing, change)
        match change:
            case ("forget", _, tuple() as moved) if id(moved) in ids and decide(thing, moved) is None:
                return None
        return kept[id(change)]

    return decide


def _parsed(line: str) -> tuple[str, str, int]:
    found = LINE.match(line)
    assert found, f"strace says what nobody understands: {line[:200]}"
    return found[1], found[2], int(found[3], 0)


def _found(place: Path) -> Thing:
    if place.is_dir():
        names = {path.name: _found(path) for path in place.iterdir()}
        return Thing(names, dict(names))
    content = place.read_bytes()
    return Thing(bytearray(content), content)


def _collect(thing: Thing, path: str, way: Survives, left: dict[str, bytes | None]) -> None:
    content = bytearray(thing.sure) if isinstance(thing.sure, bytes) else dict(thing.sure)
    for change in thing.since:
        if (survived := way(thing, change)) is not None:
            _apply(content, survived)
    if isinstance(content, bytearray):
        left[path] = bytes(content)
        return
    left[path] = None
    for name, inner in content.items():
        if not name.endswith("-shm"):  # an index that SQLite makes anew after every power cut
            _collect(inner, f"{path}/{name}", way, left)


def written(left: dict[str, bytes | None], to: Path) -> Path:
    """Make a real folder of what was left."""
    for path, content in left.items():
        place = to / path.lstrip("/")
        if content is None:
            place.mkdir()
        else:
            place.write_bytes(content)
    return to
