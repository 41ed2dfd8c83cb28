"""Files of the service: below its home, or in a store that several services share."""

from service.storage.files.local import DamagedFileError
from service.storage.files.objects import FilesUnreachableError
from service.storage.files.store import PATIENCE_S, Files, new_id

__all__ = ["PATIENCE_S", "DamagedFileError", "Files", "FilesUnreachableError", "new_id"]
