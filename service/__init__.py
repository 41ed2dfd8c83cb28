"""The LIPServe service: data sets in, training jobs, versioned models, torques with uncertainty out."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("lipserve")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
