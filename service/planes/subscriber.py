"""What one data plane has been sent, and the messages that tell it what has changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from lipcore.online.transfer import Revision
from service.models.served import Key, ServedModel
from service.models.snapshot import Snapshot
from service.planes.publications import Holdings, NewRevision, NewVersion, Pointers, VersionUse
from service.planes.stream_states import PayloadNumbers, SentStreams
from service.runtime.channel import Channel

MAX_UNCONFIRMED = 4
"""Max publications that a data plane has not applied yet. Later changes then wait, and are published together."""


class Subscriber:
    """A data plane that follows the control plane. holdings: what it had in memory when it connected.

    A control plane that has just started knows fewer versions than a data plane. Until `is_complete`, nothing is
    dropped from the data plane but what was deleted.
    """

    def __init__(self, channel: Channel, holdings: Holdings) -> None:
        self.channel, self.answers, self.confirmed = channel, holdings.answers, -1
        self._published, self._unconfirmed = -1, list[int]()
        self.keys: object = None
        """API keys that it was sent."""
        self.is_complete = not holdings.revisions
        """Whether the control plane has loaded what this data plane held."""
        self._missing = self._unreadable = frozenset[Key]()
        self._revisions = dict(holdings.revisions)
        self._streams: dict[Key, SentStreams] = {}
        self._served: dict[Key, ServedModel] = {}
        self._streamed: dict[Key, tuple[ServedModel, int]] = {}
        self._pointers: tuple[Any, ...] = ()
        self._deleted = frozenset[Key]()

    def changes(
        self, snapshot: Snapshot, numbers: PayloadNumbers, publication: int, is_complete: bool
    ) -> Iterator[Any]:
        """Return the messages that it lacks, and count them as sent.

        publication: number of this publication; is_complete: as it was before the snapshot.
        """
        for key, served in snapshot.served.items():
            if key not in self._revisions:
                yield NewVersion(key, served.base)
                self._revisions[key] = 0
            if served.revision > self._revisions[key]:
                yield NewRevision(key, served.revision, Revision.of(served.model))
                self._revisions[key] = served.revision
            yield from self._streams.setdefault(key, SentStreams(key)).changes(served, numbers)
        for key in self._served.keys() - snapshot.served.keys():
            # its streams may keep a version that was dropped: as long as they do, it keeps learning
            self._streamed[key] = self._served[key], publication
        self._served = dict(snapshot.served)
        deleted = (snapshot.deleted | self._missing) - self._deleted
        kept = self._unreadable.union(snapshot.served) if is_complete else None
        pointers = snapshot.serving, snapshot.aliases, kept
        if deleted or pointers != self._pointers:
            yield Pointers(dict(snapshot.serving), dict(snapshot.aliases), deleted, kept)
            self._pointers, self._deleted = pointers, self._deleted | deleted
        if kept is not None:
            self._revisions = {key: each for key, each in self._revisions.items() if key in kept}
            self._streams = {key: each for key, each in self._streams.items() if key in kept}

    def can_follow(self, number: int) -> bool:
        """Return whether a publication of this number is new to it and it has applied enough of those before."""
        return self.lags(number) and len(self._unconfirmed) < MAX_UNCONFIRMED

    def lags(self, number: int) -> bool:
        """Return whether it was not sent this publication."""
        return number > self._published

    def note_published(self, number: int) -> None:
        """Count a publication as sent."""
        self._published = number
        self._unconfirmed.append(number)

    def confirm(self, number: int) -> None:
        """Note that it has applied all publications up to this number."""
        self.confirmed = number
        self._unconfirmed = [each for each in self._unconfirmed if each > number]

    def complete(self, loaded: Mapping[Key, bool | None]) -> None:
        """From now on, drop what the control plane drops. loaded: whether it has loaded each version that was held.

        None stands for a version that does not exist any more. The data plane keeps one that cannot be read.
        """
        self._missing = frozenset(key for key, each in loaded.items() if each is None)
        self._unreadable = frozenset(key for key, each in loaded.items() if each is False)
        self.is_complete = True

    def release(self, use: VersionUse) -> None:
        """Forget dropped versions that no stream of the data plane keeps."""
        self._streamed = {
            key: (served, since)
            for key, (served, since) in self._streamed.items()
            if key in use.streamed or since > use.confirmed
        }
