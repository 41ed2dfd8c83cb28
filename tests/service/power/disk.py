"""What a disk may hold after a power cut, by a record of all that was done before.

A file that was synced is as it was then. Of what was written since, any part may be there: none of it, all, what came
first, any of the writes without those before them, and of a write any of its sectors. The names in folders are on the
disk by one of two rules:

- JOURNALED, as ext4 and XFS do it: changes of names reach the disk in the order in which they were made, whatever the
  folder. Those before the last sync of a folder, or of a file that was new or had grown, are there; then the next few.
- STRICT, as POSIX promises no more: a sync of a file says nothing of its name. Names in a folder are kept by a sync of
  that folder alone, and of those changed since any may be there, without those before them. Only a renaming within one
  folder happens at once.

A sync that fails leaves of what it was to keep any part on the disk and forgets the rest, as Linux does: a later one
that succeeds says nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Literal

from tests.service.power.recording import Kind, Record, Recording

Model = Literal["journaled", "strict"]
MODELS: tuple[Model, ...] = ("journaled", "strict")
SECTOR, PAGE = 512, 4096
MAPPED = "-shm"
"""End of the name of what SQLite maps into memory, and expects nothing of after a power cut."""


@dataclass(frozen=True)
class Piece:
    """A write that is not on the disk for sure, or where `data` is None the new size of a file."""

    at: int
    data: bytes | None = None

    def put(self, content: bytearray) -> None:
        """Do it."""
        if self.data is None:
            content[self.at :] = bytes(max(self.at - len(content), 0))
            return
        content.extend(bytes(max(self.at - len(content), 0)))
        content[self.at : self.at + len(self.data)] = self.data

    def sectors(self) -> Iterator[Piece]:
        """The parts that reach the disk whole."""
        if self.data is None:
            yield self
            return
        begin = self.at
        while begin < self.at + len(self.data):
            end = min((begin // SECTOR + 1) * SECTOR, self.at + len(self.data))
            yield Piece(begin, self.data[begin - self.at : end - self.at])
            begin = end


class File:
    """seen: what programs read; kept: what is on the disk for sure, `pending` aside."""

    def __init__(self, content: bytes = b"") -> None:
        self.seen, self.kept = bytearray(content), bytearray(content)
        self.pending: list[Piece] = []
        self.grown = False
        self._lost: set[int] = set()  # pages that a failed sync has given up: written again when anything in them is

    def write(self, piece: Piece) -> None:
        """Change what programs read."""
        size = len(self.seen)
        piece.put(self.seen)
        self.grown |= len(self.seen) != size
        if piece.data is not None and self._lost:
            first, last = piece.at // PAGE, (piece.at + len(piece.data) - 1) // PAGE
            for page in sorted(self._lost.intersection(range(first, last + 1))):
                self._lost.remove(page)
                self.pending.append(Piece(page * PAGE, bytes(self.seen[page * PAGE : (page + 1) * PAGE])))
        self.pending.append(piece)

    def sync(self) -> None:
        """Keep all."""
        for piece in self.pending:
            piece.put(self.kept)
        self.pending, self.grown = [], False

    def fail(self, random: Random) -> None:
        """Keep some and forget the rest."""
        kept = some(self.pending, random)
        for piece in kept:
            piece.put(self.kept)
        for piece in self.pending:
            if piece.data is not None:
                self._lost.update(range(piece.at // PAGE, (piece.at + len(piece.data) - 1) // PAGE + 1))
        self.pending = []

    def cut(self, random: Random) -> bytes:
        """What may be left."""
        content = bytearray(self.kept)
        for piece in some(self.pending, random):
            piece.put(content)
        return bytes(content)


class Folder:
    """seen: names as programs see them; kept: those on the disk for sure."""

    def __init__(self) -> None:
        self.seen: dict[str, File | Folder] = {}
        self.kept: dict[str, File | Folder] = {}


@dataclass
class Change:
    """Names that change at once: folder, name, and what it is the name of from now on."""

    parts: list[tuple[Folder, str, File | Folder | None]] = field(default_factory=list)

    def put(self, names: Callable[[Folder], dict[str, File | Folder]]) -> None:
        """Do it."""
        for folder, name, node in self.parts:
            if node is None:
                names(folder).pop(name, None)
            else:
                names(folder)[name] = node

    def touches(self, node: File | Folder) -> bool:
        """Whether a folder changes, or the name of a file."""
        return any(folder is node or each is node for folder, _, each in self.parts)


class Disk:
    """The folder of a recording on a disk, as one record after the other makes it. random: what failed syncs keep."""

    def __init__(self, recording: Recording, model: Model, random: Random) -> None:
        self.path, self.model, self._random = str(recording.root), model, random
        self.root = Folder()
        self.changes: list[Change] = []
        self._files: dict[int, File] = {}
        for path, inode, content in recording.before:
            folder, name = self._place(path)
            node = Folder() if content is None else self._files.setdefault(inode, File(content))
            folder.seen[name] = folder.kept[name] = node

    def do(self, record: Record) -> None:
        """Take what happened next."""
        if record.kind == Kind.UNKNOWN:
            raise AssertionError(f"no record tells what happens to {record.path}: {record.other}")
        if record.kind == Kind.CREATE:
            file = self._files[record.inode] = File()
            if record.path:
                self._change([(*self._place(record.path), file)])
        elif record.kind in (Kind.WRITE, Kind.RESIZE):
            data = record.data if record.kind == Kind.WRITE else None
            self._files[record.inode].write(Piece(record.at, data))
        elif record.kind == Kind.MKDIR:
            self._change([(*self._place(record.path), Folder())])
        elif record.kind in (Kind.UNLINK, Kind.RMDIR):
            self._change([(*self._place(record.path), None)])
        elif record.kind == Kind.RENAME:
            self._rename(record)
        elif record.kind in (Kind.SYNC, Kind.FAILED):
            node = self._files[record.inode] if record.inode else self._folder(record.path)
            self._sync(node) if record.kind == Kind.SYNC else self._fail(node)

    def _rename(self, record: Record) -> None:
        (old, before), (new, after) = self._place(record.path), self._place(record.other)
        parts: list[tuple[Folder, str, File | Folder | None]] = [(new, after, old.seen[before]), (old, before, None)]
        if old is new or self.model == "journaled":
            self._change(parts)
        else:
            for part in parts:
                self._change([part])

    def _sync(self, node: File | Folder) -> None:
        if self.model == "journaled":
            last = max((place for place, each in enumerate(self.changes) if each.touches(node)), default=-1)
            if isinstance(node, File) and node.grown:
                last = len(self.changes) - 1
            kept, self.changes = self.changes[: last + 1], self.changes[last + 1 :]
        else:
            kept = [each for each in self.changes if isinstance(node, Folder) and _is_in(each, node)]
            self.changes = [each for each in self.changes if each not in kept]
        for change in kept:
            change.put(lambda folder: folder.kept)
        if isinstance(node, File):
            node.sync()

    def _fail(self, node: File | Folder) -> None:
        if isinstance(node, File):
            node.fail(self._random)
            return
        given_up = [each for each in self.changes if _is_in(each, node)]
        self.changes = [each for each in self.changes if each not in given_up]
        for change in given_up:
            if self._random.random() < 0.5:
                change.put(lambda folder: folder.kept)

    def _change(self, parts: list[tuple[Folder, str, File | Folder | None]]) -> None:
        change = Change(parts)
        change.put(lambda folder: folder.seen)
        self.changes.append(change)

    def _folder(self, path: str) -> Folder:
        node: File | Folder = self.root
        for name in Path(path).relative_to(self.path).parts:
            assert isinstance(node, Folder)
            node = node.seen[name]
        assert isinstance(node, Folder)
        return node

    def _place(self, path: str) -> tuple[Folder, str]:
        return self._folder(str(Path(path).parent)), Path(path).name

    def seen(self) -> dict[str, bytes | None]:
        """What programs read, by path below the folder; None for a folder."""
        return _found(self.root, lambda folder: folder.seen, lambda file: bytes(file.seen))

    def cut(self, random: Random) -> dict[str, bytes | None]:
        """What may be left after a power cut now, by path below the folder."""
        names: dict[int, dict[str, File | Folder]] = {}

        def of(folder: Folder) -> dict[str, File | Folder]:
            return names.setdefault(id(folder), dict(folder.kept))

        changes = self.changes
        left = changes[: random.randint(0, len(changes))] if self.model == "journaled" else some(changes, random)
        for change in left:
            change.put(of)
        left = _found(self.root, of, lambda file: file.cut(random))
        for path in [path for path in left if path.endswith(MAPPED)]:
            left[path] = random.choice([b"", bytes(1 << 15), random.randbytes(1 << 15)])
        return left


def _is_in(change: Change, node: Folder) -> bool:
    return any(folder is node for folder, _, _ in change.parts)


def _found(
    folder: Folder, names: Callable[[Folder], dict[str, File | Folder]], content: Callable[[File], bytes], at: str = ""
) -> dict[str, bytes | None]:
    found: dict[str, bytes | None] = {}
    for name, node in sorted(names(folder).items()):
        if isinstance(node, Folder):
            found |= {f"{at}{name}": None} | _found(node, names, content, f"{at}{name}/")
        else:
            found[f"{at}{name}"] = content(node)
    return found


def some(pending: list, random: Random) -> list:
    """Some of what is not on the disk for sure, in order."""
    way = random.randrange(5)
    if way == 0:
        return []
    if way == 1:
        return pending
    if way == 2:
        return pending[: random.randint(0, len(pending))]
    if way == 3 and pending and isinstance(pending[0], Piece):
        pending = [sector for piece in pending for sector in piece.sectors()]
    share = random.random()
    return [each for each in pending if random.random() < share]


def write(content: dict[str, bytes | None], folder: Path) -> None:
    """Make a folder of what is left."""
    folder.mkdir()
    for name, data in content.items():
        if data is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(data)


def read(folder: Path) -> dict[str, bytes | None]:
    """What a folder holds, as `Disk.seen` has it."""
    paths: Iterable[Path] = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes() for path in paths}
