"""Inverse dynamics of other libraries in batches: each is optional, and its absence is a note."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np

from benchmarks.batch.symbolic import rnea_function
from benchmarks.exported.running import compile_pinocchio, run_command
from benchmarks.latency.baselines import rnea
from benchmarks.workload import BenchError
from lipcore.data.samples import Array
from lipcore.export.formats import FORMATS
from lipcore.export.origin import ModelOrigin
from lipcore.kernels.geometry import STANDARD_GRAVITY
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.library import Robot

FLAGS = ("-O3", "-march=native")
"""Flags for CasADi's code. Pinocchio's wheel needs the alignment of Eigen without `-march=native`."""
MAX_LOOP_STATES = 1000
"""States of a Python loop in one repetition."""
MAX_FRAX_STATES = 100_000
"""States of a call of frax, which stores a 6 × 6 inertia for each link and state."""
BASE_BODY = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'

Prepare = Callable[[Array], Callable[[], Any]]
"""Returns a function that computes the torques of states, (3, N, n), prepared for the library."""


@dataclass(frozen=True)
class Peer:
    """A library; `max_states`: of one call; `knows_arm`: it computes the simulator's torques, not the learnt arm's."""

    name: str
    prepare: Prepare
    max_states: int | None = None
    knows_arm: bool = True


@contextmanager
def open_peers(
    model: TorqueModel, parameters: Mapping[str, Any], robot: Robot | None, eigen: Path | None
) -> Iterator[tuple[list[Peer], list[str]]]:
    """Yield the libraries that can be measured, and notes about the others.

    parameters: those of the model's manifest. robot: the simulator of its arm, for libraries that need a known arm.
    eigen: Eigen's headers.
    """
    peers, notes = list[Peer](), list[str]()
    with TemporaryDirectory(prefix="lipserve-bench-") as home:
        folder = Path(home)
        makers: dict[str, Callable[[], Peer]] = {
            "Pinocchio": lambda: _pinocchio(_known(robot)),
            "Pinocchio in C++": lambda: _pinocchio_cpp(_known(robot), eigen, folder),
            "CasADi": lambda: _casadi(_known(robot), folder),
            "frax": lambda: _frax(model, parameters, folder),
        }
        for library, make in makers.items():
            try:
                peers.append(make())
            except (BenchError, ImportError) as error:
                notes.append(f"{library} is not measured: {error}")
        yield peers, notes


def _known(robot: Robot | None) -> Robot:
    if robot is None:
        raise BenchError("the model's joints are not those of a simulated arm.")
    return robot


def _pinocchio(robot: Robot) -> Peer:
    def prepare(states: Array) -> Callable[[], Any]:
        ask, count = rnea(robot, states.swapaxes(0, 1)), states.shape[1]

        def work() -> Array:
            return np.array([np.array(ask(number)) for number in range(count)])

        return work

    return Peer("Pinocchio's RNEA, Python loop", prepare, MAX_LOOP_STATES)


def _pinocchio_cpp(robot: Robot, eigen: Path | None, folder: Path) -> Peer:
    eigen = eigen or _casadi_eigen()
    if eigen is None:
        raise BenchError("give the folder of Eigen's headers with --eigen, or pip install casadi, which includes them.")
    compile_pinocchio(robot, eigen, ("-O3", "-shared", "-fPIC"), folder)
    library = ctypes.CDLL(str(folder / "rnea"))
    library.read_robot.restype = ctypes.c_void_p
    read = ctypes.c_void_p(library.read_robot(str(folder / "robot").encode()))

    def prepare(states: Array) -> Callable[[], Any]:
        q, dq, ddq = states
        if robot.model.nq != robot.n_joints:
            q = np.array([robot.configuration(each) for each in q])
        motions = np.concatenate([q, dq, ddq], axis=1)
        tau = np.empty(states.shape[1:])
        given = read, ctypes.c_long(len(tau)), ctypes.c_void_p(motions.ctypes.data), ctypes.c_void_p(tau.ctypes.data)

        def work(_: Array = motions) -> Array:  # keeps the motions in memory
            library.rnea_batch(*given)
            return tau

        return work

    return Peer("Pinocchio's RNEA, C++", prepare)


def _casadi_eigen() -> Path | None:
    """Return the headers of Eigen that CasADi's package includes, if it is installed."""
    try:
        casadi = _import("casadi")
    except ImportError:
        return None
    found = Path(str(casadi.__file__)).parent / "include/eigen3"
    return found if found.is_dir() else None


def _casadi(robot: Robot, folder: Path) -> Peer:
    casadi = _import("casadi")
    code = casadi.CodeGenerator("casadi_rnea.c")
    code.add(rnea_function(casadi, robot))
    code.generate(f"{folder}/")
    loop = Path(__file__).parent / "loop.c"
    run_command(["cc", *FLAGS, "-shared", "-fPIC", "casadi_rnea.c", str(loop), "-o", "casadi.so", "-lm"], folder)
    library = ctypes.CDLL(str(folder / "casadi.so"))

    def prepare(states: Array) -> Callable[[], Any]:
        parts, tau = np.ascontiguousarray(states), np.empty(states.shape[1:])
        sizes = ctypes.c_longlong(states.shape[1]), ctypes.c_longlong(states.shape[2])
        given = [ctypes.c_void_p(values.ctypes.data) for values in (*parts, tau)]

        def work(_: Array = parts) -> Array:  # keeps the states in memory
            if library.rnea_batch(*sizes, *given):
                raise BenchError("CasADi's code failed.")
            return tau

        return work

    return Peer("CasADi's C code of RNEA", prepare)


def _frax(model: TorqueModel, parameters: Mapping[str, Any], folder: Path) -> Peer:
    frax, jax = _import("frax.core.robot"), _import("jax")
    jax.config.update("jax_enable_x64", True)
    try:
        (urdf,) = FORMATS["urdf"].write(model, parameters, ModelOrigin("arm", 1, 0, "")).values()
    except ValueError as error:
        raise BenchError(f"the model has no URDF: {error}") from error
    root = ElementTree.fromstring(urdf)  # noqa: S314 - ours
    for link in root.iter("link"):
        if link.find("inertial") is None:  # the base: frax expects a body, which no torque depends on
            link.append(ElementTree.fromstring(BASE_BODY))  # noqa: S314
    (folder / "arm.urdf").write_bytes(ElementTree.tostring(root))
    arm = frax.Robot(str(folder / "arm.urdf"))
    gravity = jax.numpy.array([0, 0, STANDARD_GRAVITY, 0, 0, 0])
    compiled = jax.jit(jax.vmap(lambda q, dq, ddq: arm.rnea(q, dq, ddq, gravity, None)))

    def prepare(states: Array) -> Callable[[], Any]:
        given = [jax.numpy.asarray(each) for each in states]
        return lambda: compiled(*given).block_until_ready()

    return Peer("frax (JAX), the exported URDF", prepare, MAX_FRAX_STATES, knows_arm=False)


def _import(name: str) -> ModuleType:
    """Return an optional module; raise ImportError with its package."""
    import importlib  # noqa: PLC0415

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{error}: pip install {name.partition('.')[0]}") from error
