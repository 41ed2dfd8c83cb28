"""Simulates what a disk may hold after a power cut, from the record of all changes before it.

A synced file has its content at the sync. Of later writes any part may be on the disk: none, all, the first ones, any
subset, and any sectors of a write. Names in folders reach the disk by one of two rules:

- JOURNALED, as in ext4 and XFS: name changes reach the disk in their order, across folders. Those before the last sync
  of a folder, or of a file that was new or had grown, are there; then possibly the next few.
- STRICT, the minimum of POSIX: a sync of a file does not cover its name. A sync of a folder covers the names in it; any
  subset of later changes may be there. Only a rename within one folder is atomic.

A failed sync leaves any part of its data on the disk and forgets the rest, as Linux does: a later successful sync does
not cover it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Literal

from tests.system.power.recording import Kind, Record, Recording

Model = Literal["journaled", "strict"]
MODELS: tuple[Model, ...] = ("journaled", "strict")
SECTOR, PAGE = 512, 4096
MAPPED_SUFFIX = "-shm"
"""Suffix of the file that SQLite maps into memory; its content after a power cut does not matter."""


@dataclass(frozen=True)
class PendingWrite:
    """A write that may not be on the disk; if `data` is None, a new size of the file."""

    at: int
    data: bytes | None = None

    def apply_to(self, content: bytearray) -> None:
        """Apply the write to the content of a file."""
        if self.data is None:
            content[self.at :] = bytes(max(self.at - len(content), 0))
            return
        content.extend(bytes(max(self.at - len(content), 0)))
        content[self.at : self.at + len(self.data)] = self.data

    def sectors(self) -> Iterator[PendingWrite]:
        """Yield the parts that the disk writes atomically."""
        if self.data is None:
            yield self
            return
        begin = self.at
        while begin < self.at + len(self.data):
            end = min((begin // SECTOR + 1) * SECTOR, self.at + len(self.data))
            yield PendingWrite(begin, self.data[begin - self.at : end - self.at])
            begin = end


class File:
    """visible: content that programs read; durable: content on the disk, without `pending`."""

    def __init__(self, content: bytes = b"") -> None:
        self.visible, self.durable = bytearray(content), bytearray(content)
        self.pending: list[PendingWrite] = []
        self.grown = False
        self._lost: set[int] = set()  # pages that a failed sync forgot: the next write to them makes them pending again

    def write(self, piece: PendingWrite) -> None:
        """Change the visible content."""
        size = len(self.visible)
        piece.apply_to(self.visible)
        self.grown |= len(self.visible) != size
        if piece.data is not None and self._lost:
            first, last = piece.at // PAGE, (piece.at + len(piece.data) - 1) // PAGE
            for page in sorted(self._lost.intersection(range(first, last + 1))):
                self._lost.remove(page)
                self.pending.append(PendingWrite(page * PAGE, bytes(self.visible[page * PAGE : (page + 1) * PAGE])))
        self.pending.append(piece)

    def sync(self) -> None:
        """Make all writes durable."""
        for piece in self.pending:
            piece.apply_to(self.durable)
        self.pending, self.grown = [], False

    def fail(self, random: Random) -> None:
        """Make some writes durable, and forget the others."""
        durable = choose_survivors(self.pending, random)
        for piece in durable:
            piece.apply_to(self.durable)
        for piece in self.pending:
            if piece.data is not None:
                self._lost.update(range(piece.at // PAGE, (piece.at + len(piece.data) - 1) // PAGE + 1))
        self.pending = []

    def cut(self, random: Random) -> bytes:
        """Return the content that a power cut may leave."""
        content = bytearray(self.durable)
        for piece in choose_survivors(self.pending, random):
            piece.apply_to(content)
        return bytes(content)


class Folder:
    """visible: names that programs see; durable: names on the disk."""

    def __init__(self) -> None:
        self.visible: dict[str, File | Folder] = {}
        self.durable: dict[str, File | Folder] = {}


@dataclass
class Change:
    """Names that change atomically: folder, name, and its new target."""

    parts: list[tuple[Folder, str, File | Folder | None]] = field(default_factory=list)

    def apply_to(self, names: Callable[[Folder], dict[str, File | Folder]]) -> None:
        """Apply the change to the names of its folders."""
        for folder, name, node in self.parts:
            if node is None:
                names(folder).pop(name, None)
            else:
                names(folder)[name] = node

    def touches(self, node: File | Folder) -> bool:
        """Return whether it changes a folder, or a name of a file."""
        return any(folder is node or each is node for folder, _, each in self.parts)


class Disk:
    """The recorded folder on a simulated disk. random: decides what failed syncs keep."""

    def __init__(self, recording: Recording, model: Model, random: Random) -> None:
        self.path, self.model, self._random = str(recording.root), model, random
        self.root = Folder()
        self.changes: list[Change] = []
        self._files: dict[int, File] = {}
        for path, inode, content in recording.before:
            folder, name = self._place(path)
            node = Folder() if content is None else self._files.setdefault(inode, File(content))
            folder.visible[name] = folder.durable[name] = node

    def apply(self, record: Record) -> None:
        """Apply the next record."""
        if record.kind == Kind.UNKNOWN:
            raise AssertionError(f"no record tells what happens to {record.path}: {record.other}")
        if record.kind == Kind.CREATE:
            file = self._files[record.inode] = File()
            if record.path:
                self._change([(*self._place(record.path), file)])
        elif record.kind in (Kind.WRITE, Kind.RESIZE):
            data = record.data if record.kind == Kind.WRITE else None
            self._files[record.inode].write(PendingWrite(record.at, data))
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
        parts: list[tuple[Folder, str, File | Folder | None]] = [(new, after, old.visible[before]), (old, before, None)]
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
            durable, self.changes = self.changes[: last + 1], self.changes[last + 1 :]
        else:
            durable = [each for each in self.changes if isinstance(node, Folder) and _changes_folder(each, node)]
            self.changes = [each for each in self.changes if each not in durable]
        for change in durable:
            change.apply_to(lambda folder: folder.durable)
        if isinstance(node, File):
            node.sync()

    def _fail(self, node: File | Folder) -> None:
        if isinstance(node, File):
            node.fail(self._random)
            return
        forgotten = [each for each in self.changes if _changes_folder(each, node)]
        self.changes = [each for each in self.changes if each not in forgotten]
        for change in forgotten:
            if self._random.random() < 0.5:
                change.apply_to(lambda folder: folder.durable)

    def _change(self, parts: list[tuple[Folder, str, File | Folder | None]]) -> None:
        change = Change(parts)
        change.apply_to(lambda folder: folder.visible)
        self.changes.append(change)

    def _folder(self, path: str) -> Folder:
        node: File | Folder = self.root
        for name in Path(path).relative_to(self.path).parts:
            assert isinstance(node, Folder)
            node = node.visible[name]
        assert isinstance(node, Folder)
        return node

    def _place(self, path: str) -> tuple[Folder, str]:
        return self._folder(str(Path(path).parent)), Path(path).name

    def visible(self) -> dict[str, bytes | None]:
        """Return the content that programs read by path; None for a folder."""
        return _list_tree(self.root, lambda folder: folder.visible, lambda file: bytes(file.visible))

    def cut(self, random: Random) -> dict[str, bytes | None]:
        """Return the content that a power cut may leave now, by path."""
        names: dict[int, dict[str, File | Folder]] = {}

        def of(folder: Folder) -> dict[str, File | Folder]:
            return names.setdefault(id(folder), dict(folder.durable))

        changes = self.changes
        left = (
            changes[: random.randint(0, len(changes))]
            if self.model == "journaled"
            else choose_survivors(changes, random)
        )
        for change in left:
            change.apply_to(of)
        left = _list_tree(self.root, of, lambda file: file.cut(random))
        for path in [path for path in left if path.endswith(MAPPED_SUFFIX)]:
            left[path] = random.choice([b"", bytes(1 << 15), random.randbytes(1 << 15)])
        return left


def _changes_folder(change: Change, node: Folder) -> bool:
    return any(folder is node for folder, _, _ in change.parts)


def _list_tree(
    folder: Folder, names: Callable[[Folder], dict[str, File | Folder]], content: Callable[[File], bytes], at: str = ""
) -> dict[str, bytes | None]:
    found: dict[str, bytes | None] = {}
    for name, node in sorted(names(folder).items()):
        if isinstance(node, Folder):
            found |= {f"{at}{name}": None} | _list_tree(node, names, content, f"{at}{name}/")
        else:
            found[f"{at}{name}"] = content(node)
    return found


def choose_survivors(pending: list, random: Random) -> list:
    """Choose which pending changes survive, in order."""
    rule = random.randrange(5)
    if rule == 0:
        return []
    if rule == 1:
        return pending
    if rule == 2:
        return pending[: random.randint(0, len(pending))]
    if rule == 3 and pending and isinstance(pending[0], PendingWrite):
        pending = [sector for piece in pending for sector in piece.sectors()]
    share = random.random()
    return [each for each in pending if random.random() < share]


def write(content: dict[str, bytes | None], folder: Path) -> None:
    """Write the content to a new folder."""
    folder.mkdir()
    for name, data in content.items():
        if data is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(data)


def read(folder: Path) -> dict[str, bytes | None]:
    """Return the content of a folder, in the form of `Disk.visible`."""
    paths: Iterable[Path] = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes() for path in paths}
