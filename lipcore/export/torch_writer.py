"""A model as an archive of `torch.export`, which PyTorch loads without LIPServe.

Example:
    extra = {"lipserve.json": ""}
    torque = torch.export.load("my-arm-v1.pt2", extra_files=extra).module()
    tau, tau_std = torque(q, dq, ddq)  # float64, (batch, n)
"""

from __future__ import annotations

import io

from lipcore.export.function import function
from lipcore.export.function_sheet import FunctionSheet
from lipcore.export.origin import ModelOrigin
from lipcore.extras import import_extra
from lipcore.model.torque_model import TorqueModel

FACTS = "lipserve.json"
"""Name of the extra file with origin, units and self-test."""
EXAMPLE_STATES = 11
"""States of the traced call. The batch of the archive is dynamic."""


def torch_archive(model: TorqueModel, origin: ModelOrigin) -> bytes:
    """Return the archive. Raise MissingExtraError without PyTorch."""
    torch = import_extra("torch", "train")
    answer = function(model)
    sheet = FunctionSheet.of(model, answer, origin)

    class Torque(torch.nn.Module):  # type: ignore[misc, name-defined] # torch is optional
        def forward(self, *state):  # type: ignore[no-untyped-def] # noqa: ANN002, ANN202 - traced
            return answer(*state)

    example = tuple(torch.from_numpy(sheet.self_test[name][:EXAMPLE_STATES]) for name in sheet.arguments)
    batch = {0: torch.export.Dim("batch")}
    shapes = (tuple(batch for _ in example),)
    program = torch.export.export(Torque(), example, dynamic_shapes=shapes)
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={FACTS: sheet.json()})
    return file.getvalue()
