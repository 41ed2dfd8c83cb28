"""The exported function of a model in PyTorch, on a device, in float32 and float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from lipcore.data.samples import Array
from lipcore.export.function import function
from lipcore.model.torque_model import TorqueModel

CHUNK = 250_000
"""States computed together. With std, a chunk needs some GB in float64."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}

Chunk = tuple[Tensor, ...]
"""q, dq and ddq, (N, n) each."""


def on_device(
    model: TorqueModel, device: str, states: Array, compiles: bool
) -> Iterator[tuple[str, Callable[[], list[Any]]]]:
    """Yield names of subjects, and functions that compute all states, which are on the device already.

    states: (3, N, n). compiles: whether batches of full chunks are also compiled, which takes a minute each. Raise what
    PyTorch raises if it has no such device.
    """
    answer = function(model)
    kinds: dict[str, Callable[..., Any]] = {"mean": answer.torque, "with std": answer}
    for dtype_name, dtype in DTYPES.items():
        if dtype == torch.float32 and len(model.posterior.basis.outputs):
            continue  # these models need float64
        parts = torch.split(torch.from_numpy(states).to(device, dtype), CHUNK, dim=1)
        chunks = [tuple(each.contiguous() for each in part) for part in parts]
        for kind, ask in kinds.items():
            name = f"{kind}, {device} {dtype_name}"
            yield name, partial(_compute, ask, chunks, device)
            if compiles and states.shape[1] % CHUNK == 0:
                yield f"{name}, compiled", partial(_compute, _compiled(ask, chunks[0]), chunks, device)


def _compiled(ask: Callable[..., Any], chunk: Chunk) -> Callable[..., Any]:
    """Return the compiled operations of a call, for chunks of the same size.

    `torch.compile` fails to trace the function itself.
    """

    def call(q: Tensor, dq: Tensor, ddq: Tensor) -> Any:  # without the optional argument, which `make_fx` expects
        return ask(q, dq, ddq)

    with torch.no_grad():
        traced = make_fx(call)(*chunk)
    return torch.compile(traced, dynamic=False)


def _compute(ask: Callable[..., Any], chunks: Sequence[Chunk], device: str) -> list[Any]:
    with torch.no_grad():
        found = [ask(*chunk) for chunk in chunks]
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
    return found
