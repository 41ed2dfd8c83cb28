"""A model as functions of `jax.export`, which JAX loads without LIPServe.

Example:
    jax.config.update("jax_enable_x64", True)
    torque = jax.export.deserialize(Path("my-arm-v1.torque.jax").read_bytes()).call
    effort = jax.grad(lambda ddq: (torque(q, dq, ddq) ** 2).sum())(ddq)  # float64, (batch, n)
"""

from __future__ import annotations

from lipcore.export.function import function
from lipcore.export.function_sheet import FunctionSheet
from lipcore.export.origin import ModelOrigin
from lipcore.extras import import_extra
from lipcore.model.torque_model import TorqueModel

PLATFORMS = ("cpu", "cuda")


def jax_files(model: TorqueModel, origin: ModelOrigin) -> dict[str, bytes]:
    """Return the serialised functions and their facts by file name.

    - STEM.torque.jax: the torque, with its derivative.
    - STEM.torque_std.jax: torque and standard deviation.
    - STEM.json: origin, arguments and self-test.

    Raise MissingExtraError without JAX.
    """
    jax, export = import_extra("jax", "jax"), import_extra("jax.export", "jax")
    answer = function(model)
    sheet = FunctionSheet.of(model, answer, origin)
    written = {f"{origin.stem}.json": sheet.json().encode()}
    with jax.enable_x64(True):
        (batch,) = export.symbolic_shape("batch")
        shapes = [jax.ShapeDtypeStruct((batch, *shape), "float64") for shape in sheet.arguments.values()]
        for name, call, order in (("torque", answer.torque, 1), ("torque_std", answer, 0)):
            made = export.export(jax.jit(call), platforms=PLATFORMS)(*shapes)
            written[f"{origin.stem}.{name}.jax"] = bytes(made.serialize(vjp_order=order))
    return written
