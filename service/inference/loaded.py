"""Model versions in memory: loaded once, the least recently used dropped."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict

import lipcore
from lipcore.model import TorqueModel
from service.database import Database, VersionRow
from service.files import Files
from service.models import registry

logger = logging.getLogger(__name__)


class LoadedModels:
    """Cache of loaded versions; safe to share between threads. Versions never change, so neither do its entries."""

    def __init__(self, database: Database, files: Files, capacity: int) -> None:
        self.database, self.files, self.capacity = database, files, capacity
        self._models: OrderedDict[str, TorqueModel] = OrderedDict()
        self._lock = threading.Lock()
        self._loading: dict[str, threading.Lock] = {}

    def get(self, model: str, version: int | None) -> tuple[VersionRow, TorqueModel]:
        """Return a version, the latest where None, and its model, loaded if need be; raise NotFoundError."""
        row = registry.find(self.database, model, version)
        return row, self._load(row.folder)

    def preload(self) -> int:
        """Load the latest versions of the models that changed last, as many as fit; return how many."""
        loaded = 0
        for row in registry.recent(self.database, self.capacity):
            try:
                self._load(row.folder)
                loaded += 1
            except lipcore.ModelFormatError as error:  # the others shall answer all the same
                logger.error("version %d of model %s cannot be loaded: %s", row.version, row.model, error)
        return loaded

    def _load(self, folder: str) -> TorqueModel:
        with self._lock:
            if folder in self._models:
                self._models.move_to_end(folder)
                return self._models[folder]
            loading = self._loading.setdefault(folder, threading.Lock())
        with loading:  # a second request for the same version waits for the first, others do not
            with self._lock:
                if folder in self._models:
                    return self._models[folder]
            model = lipcore.load(self.files.versions / folder)
            with self._lock:
                self._models[folder] = model
                self._loading.pop(folder, None)
                while len(self._models) > self.capacity:
                    self._models.popitem(last=False)
            return model
