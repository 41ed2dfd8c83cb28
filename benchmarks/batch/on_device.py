"""The exported function of a model in PyTorch, on a device, in float32 and float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lipcore.data.samples import Array
from lipcore.export.function import function
from lipcore.model.torque_model import TorqueModel

CHUNK = 65_536
"""States computed together. With std, a chunk needs about 1 GB in float64."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def on_device(model: TorqueModel, device: str, states: Array) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield names of subjects, and functions that compute all states, which are on the device already.

    states: (3, N, n). Raise what PyTorch raises if it has no such device.
    """
    answer = function(model)
    kinds: dict[str, Callable[..., Any]] = {"mean": answer.torque, "with std": answer}
    for dtype_name, dtype in DTYPES.items():
        if dtype == torch.float32 and len(model.posterior.basis.outputs):
            continue  # these models need float64
        # split before: a chunk must be in one piece of memory
        all_states = torch.from_numpy(states).to(device, dtype)
        chunks = [tuple(each.contiguous() for each in part) for part in torch.split(all_states, CHUNK, dim=1)]
        for kind, ask in kinds.items():
            for how, made in _variants(ask, device):
                yield f"{kind}, {device} {dtype_name}{how}", partial(_compute, made, chunks, device)


def _variants(ask: Callable[..., Any], device: str) -> Iterator[tuple[str, Callable[..., Any]]]:
    yield "", ask
    if device != "cpu":
        yield ", compiled", torch.compile(ask, dynamic=False)


def _compute(ask: Callable[..., Any], chunks: list[tuple[Tensor, ...]], device: str) -> list[Any]:
    with torch.no_grad():
        found = [ask(*chunk) for chunk in chunks]
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
    return found
