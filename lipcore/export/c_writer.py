"""A model of rigid bodies as C99 for hard real time: source and header, from the templates in `lipcore/export/c`.

Torque is linear in the weights w of arm and friction, tau = Φ w with w ~ N(ŵ, C). The mean and the features φ_b of the
bodies are written operation by operation, see `c_program`. The standard deviation is |Uᵀ φ_b|, see `c_weights`. A
nonlinear term adds its covariances with stored torques, see `c_rest`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.export.c_program import BodiesProgram, others_statements
from lipcore.export.c_rest import NonlinearTerm, correction_tables
from lipcore.export.c_weights import LinearWeights, UnsupportedEstimatorError, expand_weights
from lipcore.export.origin import SELF_TEST_STATES, ModelOrigin, draw_states
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.drive.play import ELEMENTS, MAX_GAP_S, PlayState, element_widths
from lipcore.kernels.drive.terms import SHAPE_SPEEDS, SIGN_WIDTH, STRIBECK_SPEED
from lipcore.kernels.fast.answer import ACCELERATED, MISFIT_ROWS
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.fast.drive import HARMONICS
from lipcore.kernels.fast.play import CERTAIN_SHARE
from lipcore.kernels.payload import PayloadKernel
from lipcore.model import dynamics
from lipcore.model.body import Body
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.vocabulary import DRIVE_KINDS, ROBOT_ESTIMATORS

SOURCE, HEADER = "lipserve_model.c", "lipserve_model.h"
WIDE = 8
"""Columns of a panel of the root."""
VECTORS = SELF_TEST_STATES
"""Queries of the self-test, half of them with PAYLOAD. Every second one has a state after TRAIL."""
TRAIL = (0.3, -0.5, 0.004, 0.0)
"""Positions before a query, relative to the query's, in widths of the largest element.

They deflect every element partly.
"""
PAYLOAD = Body(1.3, np.array([0.02, -0.03, 0.11]), np.diag([0.004, 0.005, 0.003]))
"""Payload in half of the queries of the self-test."""


def c_files(model: TorqueModel, origin: ModelOrigin) -> dict[str, str]:
    """Return the texts of SOURCE and HEADER by name, ASCII.

    Raise UnsupportedEstimatorError for an estimator that is not one of ROBOT_ESTIMATORS.
    """
    if model.estimator.name not in ROBOT_ESTIMATORS:
        raise UnsupportedEstimatorError(
            f"estimator is {model.estimator.name!r}, expected one of {', '.join(ROBOT_ESTIMATORS)} for C"
        )
    learnt = LinearWeights.of(model)
    fields = _texts(model, origin) | _tables(model, learnt) | {"stack": _stack(model)}
    written = {}
    for name in (SOURCE, HEADER):
        written[name] = _template(name).substitute(fields)
    return written


def _template(name: str) -> Template:
    return Template((Path(__file__).parent / "c" / f"{name}.in").read_text(encoding="ascii"))


def _tables(model: TorqueModel, learnt: LinearWeights) -> dict[str, str]:
    """Return all numbers of the source."""
    arm, posterior = learnt.arm.arm, model.posterior
    n, size, order = arm.n_joints, PARAMETERS * arm.n_joints, arm.order
    rubbing = learnt.mean[learnt.arm.size :].reshape(n, -1)
    own = np.concatenate([learnt.mean[size : size + n, None], rubbing], axis=1)[order]
    change = learnt.mean[:size].reshape(n, PARAMETERS)[order] - arm.parameters
    program = BodiesProgram.of(arm.geometry, learnt.mean[learnt.arm.steps], arm.parameters, change)
    root, shared = learnt.root(expand_weights(learnt, program.weights))
    others = 0 if learnt.arm.others is None else learnt.arm.others.size
    owns, share, others_written = "{0}", "{0}", ""
    if learnt.arm.others is not None:
        gravity = arm.alternatives[0].geometry.gravity
        each = [(replace(alone.geometry, gravity=gravity), alone.parameters) for alone in arm.alternatives]
        others_written = others_statements(each)
        owns = _braced(
            np.stack(
                [np.concatenate([alone.rotor[:, None], alone.friction], axis=1)[order] for alone in arm.alternatives]
            )
        )
        share = _braced(learnt.arm.others.mixing @ learnt.mean[learnt.arm.steps.stop : learnt.arm.size])
    limits = [[model.training_range[name][end] for end in ("min", "max")] for name in ("q", "dq", "ddq")]
    body = PAYLOAD.inertia
    assert body is not None
    vectors = _vectors(model, learnt)
    misfit, elements = posterior.misfit.packed(), learnt.friction.drive.elements
    return {
        "n": str(n),
        "friction": str(rubbing.shape[1]),
        **{kind: str(int(kind in learnt.friction.drive.kinds)) for kind in DRIVE_KINDS},
        "harmonics": str(HARMONICS),
        "numbers": str(program.weights.shape[1]),
        "others": str(others),
        "vectors": str(VECTORS),
        "order": _integers(order),
        "slides": _integers([kind == "prismatic" for kind in arm.geometry.joint_types]),
        "first": _integers(program.first),
        "tip": _braced(np.append(arm.geometry.across[-1], arm.geometry.axis[-1])),
        "sign_width": repr(SIGN_WIDTH),
        "slow_speed": repr(STRIBECK_SPEED),
        "elements": str(len(ELEMENTS)),
        "loose": str((len(misfit) - MISFIT_ROWS) // 2),
        "width": _braced(element_widths(model.joint_types)),
        "usual": _braced(np.zeros(n) if elements is None else elements.acceleration),
        "certain": repr(CERTAIN_SHARE),
        "max_gap": repr(MAX_GAP_S),
        "trail_size": str(len(TRAIL)),
        "trail": _braced(TRAIL),
        "shapes": _braced(SHAPE_SPEEDS),
        "accelerated": repr(ACCELERATED),
        "quantile": repr(quantile(LEVEL)),
        "drive": _braced(own),
        "owns": owns,
        "torque_written_out": program.torque,
        "features_written_out": program.features,
        "others_written_out": others_written,
        "share": share,
        "root": _braced(_panels(root)),
        **_rest(NonlinearTerm.of(posterior), shared),
        **_correction(posterior, shared),
        "misfit": _braced(misfit),
        "arm": _integers(posterior.misfit.arms[order]),
        "floor": _braced(posterior.floor),
        "range": _braced(np.array(limits)),
        "payload": "{" + f"{PAYLOAD.mass!r}, {_braced(PAYLOAD.com)}, {_braced(body.reshape(-1))}" + "}",
        "vector": _braced(vectors),
        "part": _braced(_parts(model, vectors[: VECTORS // 2]).reshape(VECTORS // 2, -1)),
        "noise": _braced(model.noise_std),
        "scale": _braced(model.scale),
    }


def _texts(model: TorqueModel, origin: ModelOrigin) -> dict[str, str]:
    """Return the texts of both files. Names are arbitrary, so they are escaped for comments and strings."""
    names = [name.encode() for name in model.joint_names]
    limits = model.training_range
    joints = []
    for k, name in enumerate(model.joint_names):
        unit = "m" if model.joint_types[k] == "prismatic" else "rad"
        seen = [
            f"{what} {limits[what]['min'][k]:.4g} to {limits[what]['max'][k]:.4g}{mark}"
            for what, mark in (("q", f" {unit}"), ("dq", "/s"), ("ddq", "/s^2"))
        ]
        joints.append(f" *       {k}  {_comment(name)}, {model.joint_types[k]}, trained for {', '.join(seen)}")
    mode = model.arm is not None and model.arm.mode == "learn"
    frame = "in the last link's frame of the learnt arm, see\n * `parameters.geometry` of the version"
    last = "the URDF's last movable joint"
    if model.arms > 1 and model.arm is not None:
        last = (
            f"joint\n * {_comment(model.joint_names[model.arm.order[-1]])}, the last arm's; other arms have no payload"
        )
    return {
        "title": f"Inverse dynamics of {_comment(origin.model)}, version {origin.version}",
        "model": _comment(origin.model),
        "version": str(origin.version),
        "revision": str(origin.revision),
        "digest": _comment(origin.digest),
        "estimator": model.estimator.name,
        "convention": _comment(model.torque_convention.replace("_", " ")),
        "joints": "\n".join(joints),
        "names": "{" + ", ".join(_string(name) for name in names) + "}",
        "name_size": str(max(map(len, names)) + 1),
        "model_text": _string(origin.model.encode()),
        "frame": frame if mode and model.arms == 1 else f"in the frame of {last}",
    }


def _rest(rest: NonlinearTerm | None, shared: Array) -> dict[str, str]:
    """Return the contribution of a nonlinear term, empty for rigid bodies alone. shared: V of `LinearWeights.root`."""
    if rest is None:
        return {"outputs": "0", "alpha": "{0}", "learnt": "{0}", "shared": "{0}", "factor": "0", "term": ""}
    tables = {name: _braced(values) for name, values in rest.tables.items()}
    places = "{" + ",\n".join(_integers(row) for row in rest.places) + "}"
    return {
        "outputs": str(len(rest.alpha)),
        "alpha": _braced(rest.alpha),
        "learnt": _braced(_panels(rest.factor * rest.learnt.T)),
        "shared": _braced(_full_panels(shared)),
        "factor": repr(rest.factor**2),
        "term": _template("energy.c").substitute(tables, groups=str(rest.groups), places=places),
    }


def _correction(posterior: CompactPosterior, shared: Array) -> dict[str, str]:
    """Return the contribution of a local correction, empty if no joint is corrected. shared: see `_rest`."""
    residual = posterior.basis.residual
    if residual is None or not residual.prior.any():
        return {"corrected": "0", "correction": ""}
    tables = correction_tables(residual, posterior) | {"shared": _full_panels(shared)}
    texts = {
        name: _integers(values) if values.dtype == np.int64 else _braced(values) for name, values in tables.items()
    }
    most = str(max(1, int(residual.sizes.max())))
    return {"corrected": "1", "correction": _template("residual.c").substitute(texts, most=most)}


def _stack(model: TorqueModel) -> str:
    """Return the stack of a call in kB: features, covariances and products of energies, some of them twice."""
    n, outputs = model.n_joints, len(model.posterior.basis.outputs)
    residual = model.posterior.basis.residual
    rows = 0 if residual is None else (n + 1) * int(residual.sizes.max())
    energies = 2 * 8e-3 * n * outputs + 0.6 * n**2 if outputs else 0.0
    return str(round(4 + 0.5 * n**2 + energies + 2 * 8e-3 * rows))


def _panels(root: Array) -> Array:
    """Return the root's columns, WIDE at a time, row by row down to the diagonal: flat, padded with zeros."""
    size = len(root)
    padded = np.pad(root, ((0, 0), (0, -size % WIDE)))
    starts = range(0, size, WIDE)
    return np.concatenate([padded[: min(at + WIDE, size), at : at + WIDE].reshape(-1) for at in starts])


def _full_panels(matrix: Array) -> Array:
    """Return the rows of a matrix, WIDE at a time, column by column: flat, padded with zeros."""
    padded = np.pad(matrix, ((0, -len(matrix) % WIDE), (0, 0)))
    return padded.reshape(-1, WIDE, padded.shape[1]).transpose(0, 2, 1).reshape(-1)


def _vectors(model: TorqueModel, learnt: LinearWeights) -> Array:
    """Return queries within the training's range, and the model's own predictions: (VECTORS, 5, n)."""
    motions, half, widths = draw_states(model).swapaxes(0, 1), VECTORS // 2, element_widths(model.joint_types)
    out = np.empty((VECTORS, 5, model.n_joints))
    for carried, known in product((False, True), repeat=2):
        rows = slice(half * carried + known, half * (1 + carried), 2)
        q, dq, ddq = motion = [each[rows] for each in motions]
        before = _deflections_after_trail(q, widths) if known else None
        evaluator = (_add_payload(model, learnt) if carried else model).evaluator
        mean, std, *_ = evaluator.many(q, dq, ddq, deflections=before)
        more = np.zeros_like(mean)
        if carried:
            more = PayloadKernel(learnt.arm.arm, np.ones(PARAMETERS)).features(Motion(q, dq, ddq)) @ PAYLOAD.parameters
        out[rows] = np.stack([*motion, mean + more, std], axis=1)
    return out


def _parts(model: TorqueModel, vectors: Array) -> Array:
    """Return gravity, Coriolis, friction and inertia matrix at vectors without payload, (V, 3 + n, n)."""
    q, dq, ddq = vectors[:, :3].transpose(1, 0, 2)
    out, widths = np.empty((len(q), 3 + model.n_joints, model.n_joints)), element_widths(model.joint_types)
    rest = dynamics.components(model, Motion(q, 0 * q, 0 * q), ["gravity", "inertia_matrix"])
    out[:, 0], out[:, 3:] = rest["gravity"].mean, rest["inertia_matrix"].mean
    out[:, 1] = dynamics.components(model, Motion(q, dq, ddq), ["coriolis"])["coriolis"].mean
    for known in (False, True):
        rows = slice(int(known), None, 2)
        before = _deflections_after_trail(q[rows], widths) if known else None
        motion = Motion(q[rows], dq[rows], ddq[rows], before)
        out[rows, 2] = dynamics.components(model, motion, ["friction"])["friction"].mean
    return out


def _deflections_after_trail(q: Array, widths: Array) -> Array:
    """Return the deflections at N positions, (N, 2 K, n), each after TRAIL."""
    time, still = np.full(len(TRAIL), 1e-3).cumsum(), np.zeros((len(TRAIL), q.shape[1]))
    trails = q[:, None] + np.array(TRAIL)[:, None] * widths[-1]
    start = PlayState.unknown(q.shape[1])
    return np.stack([start.follow(time, each, still, widths)[0][-1] for each in trails])


def _add_payload(model: TorqueModel, learnt: LinearWeights) -> TorqueModel:
    """Return the model with the torque's change with the geometry of an arm that carries PAYLOAD."""
    parameters = learnt.arm.arm.parameters.copy()
    parameters[-1] += PAYLOAD.parameters
    loaded = ArmKernel(replace(learnt.arm.arm, parameters=parameters))
    before = model.posterior.basis.linear[:-2]
    basis = replace(model.posterior.basis, linear=(*before, loaded, DriveKernel(loaded.arm.friction)))
    return replace(model, posterior=replace(model.posterior, basis=basis))


def _braced(values: Any) -> str:
    """Return numbers as an initializer that reads back exactly, in lines of about 100 characters."""
    if np.ndim(values) > 1:
        return "{" + ",\n".join(_braced(each) for each in values) + "}"
    texts, lines, line = [repr(float(each)) for each in values], list[str](), ""
    for text in texts:
        if len(line) + len(text) > 100:
            lines.append(line.rstrip())
            line = ""
        line += f"{text}, "
    return "{" + "\n".join([*lines, line]).rstrip(", ") + "}"


def _integers(values: Iterable[Any]) -> str:
    return "{" + ", ".join(str(int(each)) for each in values) + "}"


def _comment(text: str) -> str:
    """Return text for a comment, which it cannot end: ASCII, without line ends, backslashes and slashes."""
    return "".join(each if each.isascii() and each.isprintable() and each not in "/\\?" else "_" for each in text)


def _string(text: bytes) -> str:
    """Return a string literal of these bytes: three octal digits for all but letters, digits and a few marks."""
    plain = b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-. "
    return '"' + "".join(chr(each) if each in plain else f"\\{each:03o}" for each in text) + '"'
