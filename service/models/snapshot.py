"""What answers at one time: versions in memory and aliases. It is immutable and replaced as a whole."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from service.models.registry import SERVING, Serving
from service.models.served import Alias, Key, ServedModel


@dataclass(frozen=True)
class Snapshot:
    """Versions in memory, the serving version of each model, all other aliases, and the versions that were deleted."""

    served: Mapping[Key, ServedModel] = field(default_factory=dict)
    serving: Mapping[str, Serving] = field(default_factory=dict)
    aliases: Mapping[Alias, int] = field(default_factory=dict)
    deleted: frozenset[Key] = frozenset()

    def pointed(self, model: str, alias: str | None) -> int | None:
        """Return the version of an alias, the serving version if `alias` is None.

        Return None if this snapshot does not contain it.
        """
        if alias is None or alias == SERVING:
            serving = self.serving.get(model)
            return None if serving is None else serving.version
        return self.aliases.get((model, alias))

    def find(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version, or the version of an alias, if it is in memory."""
        if version is None:
            version = self.pointed(model, alias)
            if version is None:
                return None
        return self.served.get((model, version))

    def versions_of(self, model: str) -> dict[int, ServedModel]:
        """Return a model's versions that are in memory."""
        return {version: each for (name, version), each in self.served.items() if name == model}

    def with_version(self, served: ServedModel) -> Snapshot:
        """Return a copy with a version or a higher revision of it; this snapshot if it has an equal or higher one."""
        key = (served.name, served.version)
        known = self.served.get(key)
        if known is not None and known.revision >= served.revision:
            return self
        return replace(self, served={**self.served, key: served})

    def with_serving(self, model: str, serving: Serving) -> Snapshot:
        """Return a copy in which a version serves its model, unless a later change is known."""
        known = self.serving.get(model)
        if known is not None and known.change >= serving.change:
            return self
        return replace(self, serving={**self.serving, model: serving})

    def with_alias(self, model: str, alias: str, version: int | None) -> Snapshot:
        """Return a copy in which an alias names a version, or none."""
        aliases = {key: number for key, number in self.aliases.items() if key != (model, alias)}
        if version is not None:
            aliases[model, alias] = version
        return replace(self, aliases=aliases)

    def with_aliases(self, aliases: Mapping[Alias, int], models: Collection[str] | None) -> Snapshot:
        """Return a copy with these aliases instead of those of these models, or of all models if None."""
        kept = {} if models is None else {key: each for key, each in self.aliases.items() if key[0] not in models}
        return replace(self, aliases=kept | dict(aliases))

    def without(self, dropped: Collection[Key]) -> Snapshot:
        """Return a copy without versions that were dropped from memory. They can be loaded again."""
        if not dropped:
            return self
        return replace(self, served={key: each for key, each in self.served.items() if key not in dropped})

    def without_deleted(self, gone: Collection[Key], model: str | None = None) -> Snapshot:
        """Return a copy without deleted versions and, if `model` is given, without that model's aliases."""
        return Snapshot(
            {key: each for key, each in self.served.items() if key not in gone},
            {name: each for name, each in self.serving.items() if name != model},
            {key: each for key, each in self.aliases.items() if key[0] != model},
            self.deleted.union(gone),
        )
