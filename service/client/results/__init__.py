"""Results whose numbers are arrays."""

from service.client.results.arm import Arm, Frames, Version
from service.client.results.evaluation import Comparison, Evaluation, Interval, Reliability, VersionFigures
from service.client.results.series import Component, Live, LivePart, LiveRows, Prediction, Preview, PreviewColumn, Trace

__all__ = [
    "Arm",
    "Comparison",
    "Component",
    "Evaluation",
    "Frames",
    "Interval",
    "Live",
    "LivePart",
    "LiveRows",
    "Prediction",
    "Preview",
    "PreviewColumn",
    "Reliability",
    "Trace",
    "Version",
    "VersionFigures",
]
