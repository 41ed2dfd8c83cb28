"""Found by processes that get this folder on their path, but no environment, as those that read uploads."""

from hiding import hide

hide(__name__)
raise ModuleNotFoundError(f"No module named {__name__!r}", name=__name__)
