"""Tests of the compiled evaluator against the dense formulas."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Barrier

import numpy as np
import pytest

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.base import LinearKernel, PairKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.kernels.fast.answer import root_of_part
from lipcore.posterior.evaluator import QUERIES, Evaluator
from lipcore.robots.library import load_robot
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import DRIVE_KINDS
from tests.lipcore.kernels.test_baseline_kernels import BASELINES, random_case
from tests.lipcore.oracles import random_problem

RELATIVE_TOLERANCE = 1e-10
STD_FACTOR = 1.3
MIXED = ("revolute", "prismatic", "revolute", "prismatic", "revolute")


@dataclass
class Case:
    """Random arguments of an evaluator, and queries."""

    term: PairKernel | None
    inducing: Motion | None
    linear: list[LinearKernel]
    params: dict[str, Array]
    outputs: np.ndarray
    weights: np.ndarray
    root: np.ndarray
    query: Motion

    def evaluator(self) -> Evaluator:
        return Evaluator(
            self.term, self.params, self.inducing, self.outputs, self.linear, self.weights, self.root, STD_FACTOR
        )

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (N, n) and covariance (N, n, n) by the formulas of `Evaluator`."""
        mean, prior, explained, left = self.parts()
        return mean, STD_FACTOR**2 * (prior - explained + left)

    def parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the mean, the term's prior and explained covariance, and the weights' remaining covariance."""
        query, n = self.query, self.query.n_joints
        before, rows, terms = np.zeros((len(query), n, n)), [], [*self.linear]
        if self.term is not None:
            terms.append(self.term)
            rows.append(self.term.gram(self.params, self.inducing, query)[self.outputs])
            before = self.term.variance(self.params, query)
        for each in self.linear:
            features = each.features(query)
            rows.append(np.diag(each.variances(self.params)) @ features.reshape(len(query) * n, -1).T)
        cross = np.concatenate(rows)
        mean = SumKernel(*terms).mean(query) + (self.weights @ cross).reshape(-1, n)
        white, chosen = (self.root @ cross).reshape(-1, len(query), n), len(self.outputs)
        explained, left = (np.einsum("kmi,kmj->mij", part, part) for part in (white[:chosen], white[chosen:]))
        return mean, before, explained, left


def rigid_body(name: str, order: Sequence[int] | None = None, **options: object) -> ArmKernel:
    """Return the kernel of a robot with another joint order in the data."""
    robot = load_robot(name)
    order = order or range(robot.n_joints)
    names, types = (tuple(parts[i] for i in order) for parts in (robot.joint_names, robot.joint_types))
    return ArmKernel(arm_of_robot(RigidBody.from_profile(name, names, types), **options))


def case(
    joint_types: tuple[str, ...],
    kernel: str | None = "chain",
    linear: tuple[LinearKernel, ...] = (),
    *,
    queries: int = 5,
) -> Case:
    """About half of the torques are inducing outputs; the first two samples have none, the third has one."""
    rng, n, samples = np.random.default_rng(0), len(joint_types), 20
    if kernel in BASELINES:
        term, params, motion = random_case(kernel, joint_types, samples + queries)
    else:
        problem = random_problem(joint_types, samples + queries, 0, kernel or "chain")
        term, params, motion = problem.kernel, dict(problem.params), problem.motion
    for each in linear:
        params |= each.initial(motion, rng.uniform(0.5, 2.0, (samples + queries, n)))
    chosen = rng.random((samples, n)) < 0.5
    chosen[:2], chosen[2, 1:], chosen[2, 0] = False, False, True
    outputs = np.flatnonzero(chosen) if kernel else np.zeros(0, dtype=np.int64)
    anchors = len(outputs) + sum(each.features(motion[:1]).shape[-1] for each in linear)
    root = np.tril(rng.standard_normal((anchors, anchors)) + 4 * np.eye(anchors))
    model = (term, motion[:samples]) if kernel else (None, None)
    made = Case(*model, list(linear), params, outputs, rng.standard_normal(anchors), root, motion[samples:])
    if kernel:
        _, prior, explained, _ = made.parts()
        # up to half of a variance is explained: errors in that half show, and little cancels
        diagonals = (part.diagonal(axis1=1, axis2=2) for part in (explained, prior))
        made.root = root * np.sqrt(0.5 / np.divide(*diagonals).max())
    return made


def friction(n: int) -> tuple[LinearKernel, ...]:
    return (DriveKernel(Drive(n)),)


def around_robot(name: str, kernel: str | None = None, order: Sequence[int] | None = None, **options: object) -> Case:
    """Return a case with the rigid bodies of a robot and friction."""
    types = load_robot(name).joint_types
    joint_types = tuple(types[i] for i in order or range(len(types)))
    return case(joint_types, kernel, (rigid_body(name, order, **options), *friction(len(types))))


def rigid_body_with_drive(name: str) -> tuple[LinearKernel, ...]:
    """Return the rigid bodies of a robot and friction of all kinds."""
    bodies = rigid_body(name)
    return bodies, DriveKernel(
        replace(bodies.arm, drive=DRIVE_KINDS, acceleration=np.full(bodies.n_joints, 3.0)).friction
    )


PANDA = ("revolute",) * 7
CASES: dict[str, Callable[[], Case]] = {
    "chain": lambda: case(PANDA, "chain", friction(7)),
    "lip": lambda: case(PANDA, "tied", friction(7)),
    "lip-untied": lambda: case(MIXED, "untied", friction(5)),
    "prismatic": lambda: case(MIXED, "chain", friction(5)),
    **{name: lambda name=name: case(MIXED, name, friction(5)) for name in BASELINES},
    "frictionless": lambda: case(MIXED, "chain"),
    "rigid-body": lambda: around_robot("panda"),
    "rigid-body alone, from zero": lambda: case(PANDA, None, (rigid_body("panda", prior="zero", gravity=False),)),
    "rigid-body with friction of slow joints": lambda: case(
        PANDA, None, (rigid_body("panda"), DriveKernel(Drive(7, ("stribeck",))))
    ),
    "rigid-body with friction of all kinds": lambda: case(PANDA, None, rigid_body_with_drive("panda")),
    "rigid-body and chain": lambda: around_robot("panda", "chain"),
    "rigid-body with geometry": lambda: around_robot("panda", mode="calibrate"),
    "unbounded joints in another order": lambda: around_robot("kinova", "chain", (3, 0, 5, 1, 4, 2)),
    "prismatic rigid body in another order": lambda: around_robot(
        "tiago", None, (1, 2, 3, 4, 5, 6, 7, 0), mode="calibrate"
    ),
    **{
        f"{n} joints": lambda n=n: case((("revolute", "prismatic") * 5)[:n], "chain", friction(n))
        for n in (1, 2, 3, 4, 6, 8, 9, 10)
    },
    **{
        f"{count} queries": lambda count=count: case(MIXED, "chain", friction(5), queries=count)
        for count in (1, QUERIES - 1, QUERIES, QUERIES + 1, 2 * QUERIES + 3)
    },
}


@pytest.fixture(params=CASES)
def evaluator_case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]()


def arrays_of(query: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return query.q, query.dq, query.ddq


def assert_close(found: np.ndarray | None, expected: np.ndarray) -> None:
    assert found is not None
    np.testing.assert_allclose(found, expected, rtol=0, atol=RELATIVE_TOLERANCE * np.abs(expected).max())


def test_batch_equals_the_dense_formulas(evaluator_case: Case) -> None:
    mean, covariance = evaluator_case.dense()
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    assert (variance > 0).all()
    evaluator = evaluator_case.evaluator()
    evaluator.warm_up()  # changes nothing
    tau, std, found, _ = evaluator.many(*arrays_of(evaluator_case.query), covariance=True)
    assert_close(tau, mean)
    assert_close(std, np.sqrt(variance))
    assert_close(found, covariance)
    assert np.array_equal(found, found.transpose(0, 2, 1))


def test_single_query_gives_identical_bits(evaluator_case: Case) -> None:
    evaluator, query = evaluator_case.evaluator(), evaluator_case.query
    tau, std, nothing, _ = evaluator.many(*arrays_of(query))
    assert nothing is None
    between, own = evaluator.many(*arrays_of(query), covariance=True)[2], np.empty((1, *query.q.shape[1:] * 2))
    for k, motion in enumerate(query.arrays()):
        one, deviation, _ = evaluator.one(motion)
        assert np.array_equal(one, tau[k])
        assert np.array_equal(deviation, std[k])
        mean_only, nothing, _ = evaluator.one(motion, std=False)
        assert nothing is None
        assert np.array_equal(mean_only, tau[k])
        one, deviation, _ = evaluator.one(motion, covariance=own)
        assert np.array_equal(one, tau[k])
        assert_close(deviation, std[k])
        assert_close(own[0], between[k])


@pytest.mark.parametrize("name", [name for name in CASES if "rigid" in name and "chain" not in name])
def test_torque_without_gravity_has_the_covariance_of_the_difference(name: str) -> None:
    """The features of the difference, from the formulas of the array API, times the dense posterior of the weights."""
    made = CASES[name]()
    query, n, evaluator = made.query, made.query.n_joints, made.evaluator()
    rest, rows, centres = Motion(query.q, *np.zeros((2, *query.q.shape))), [], []
    for kernel in made.linear:
        held = np.array(kernel.formula(rest))
        if isinstance(kernel, DriveKernel):
            held[[term != "gain" for term in kernel.drive.terms] * n] = 0.0
        rows.append(np.array(kernel.formula(query)) - held)
        centre = kernel.prior_weights()
        centres.append(np.zeros(len(held)) if centre is None else centre)
    variance = np.concatenate([kernel.variances(made.params) for kernel in made.linear])
    mean, difference = np.concatenate(centres) + variance * made.weights, np.concatenate(rows)
    tau, std = evaluator.without_gravity(query.arrays())
    assert_close(tau, np.einsum("p,pjk->kj", mean, difference))
    assert_close(std, STD_FACTOR * np.linalg.norm(np.tensordot(made.root * variance, difference, 1), axis=0).T)
    for row, motion in enumerate(query.arrays()):
        reduced, plain = np.empty((2, n)), evaluator.one(motion)
        again = evaluator.one(motion, reduced=reduced)
        np.testing.assert_array_equal(reduced, [tau[row], std[row]])
        np.testing.assert_array_equal(again[:2], plain[:2])


@pytest.mark.parametrize("mixed", [False, True], ids=["own rows", "rows of others"])
def test_root_of_a_part_has_the_same_squares(mixed: bool) -> None:
    root = np.tril(np.random.default_rng(0).normal(size=(9, 9)))
    places = np.array([1, 2, 7, 8])
    others = np.setdiff1d(np.arange(9), places)
    if not mixed:
        root[np.ix_(others, places)] = 0.0
    part = root_of_part(root, places)
    assert not np.triu(part, 1).any()
    np.testing.assert_allclose(part.T @ part, root[:, places].T @ root[:, places], rtol=1e-12, atol=1e-12)


def test_negative_variance_gives_zero_std() -> None:
    chain = case(MIXED)
    chain.root *= 100
    _, std, covariance, _ = chain.evaluator().many(*arrays_of(chain.query), covariance=True)
    assert (np.diagonal(covariance, axis1=1, axis2=2) == 0).all()
    assert (std == 0).all()


def test_threads_get_identical_and_own_predictions() -> None:
    threads, rounds = 4, 30
    both = case(PANDA, "chain", (rigid_body("panda"), DriveKernel(Drive(7))), queries=threads)
    evaluator, motions = both.evaluator(), both.query.arrays()
    tau, std, covariance, _ = evaluator.many(*arrays_of(both.query), covariance=True)
    start = Barrier(threads)

    def work(k: int) -> bool:
        start.wait(timeout=60)
        same = True
        for _ in range(rounds):
            one, deviation, _ = evaluator.one(motions[k])
            same &= np.array_equal(one, tau[k]) and np.array_equal(deviation, std[k])
            same &= np.array_equal(evaluator.many(*motions[k][:, None], covariance=True)[2][0], covariance[k])
        return same

    with ThreadPoolExecutor(threads) as pool:
        assert all(pool.map(work, range(threads)))


def test_inputs_stay_unchanged_and_results_are_owned() -> None:
    chain = case(MIXED, "chain", friction(5))
    evaluator, (motion, other, *_) = chain.evaluator(), chain.query.arrays()
    motion.flags.writeable = False  # like bytes from a socket
    first = evaluator.one(motion)[0]
    before = first.copy()
    evaluator.one(other)
    assert np.array_equal(first, before)
    for array in (chain.outputs, chain.weights, chain.root):
        assert array.any()
        array[:] = 0
    assert np.array_equal(evaluator.one(motion)[0], first)  # no view of the arguments is kept


def test_invalid_arguments_are_named() -> None:
    good = case(MIXED, "chain", friction(5))
    anchors = len(good.weights)

    def refused(**changes: object) -> str:
        with pytest.raises(ValueError, match="expected") as error:
            replace(good, **changes).evaluator()
        return str(error.value)

    assert "outputs are" in refused(outputs=np.append(good.outputs[:-1], 100))
    assert "outputs are" in refused(outputs=np.append(-1, good.outputs[1:]))
    assert f"weights have shape (3,), expected ({anchors},)" in refused(weights=np.zeros(3))
    assert f"expected ({anchors}, {anchors})" in refused(root=np.zeros((anchors, anchors - 1)))
    assert "above the diagonal" in refused(root=np.ones((anchors, anchors)))
    assert "term and inducing" in refused(inducing=None)
    assert "term is None and linear is empty" in refused(term=None, inducing=None, linear=[])
