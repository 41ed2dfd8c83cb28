"""Hides the module from processes that inherit the path but not the environment, such as readers of uploads."""

from hiding import hide

hide(__name__)
raise ModuleNotFoundError(f"No module named {__name__!r}", name=__name__)
