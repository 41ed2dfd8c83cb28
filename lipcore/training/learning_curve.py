"""Learning curve of a model: its error on held-out samples, if it learns fewer samples.

A part of the training samples is either spread over the recording, or is its beginning. If the error with half of the
samples, spread, is larger than with all, more of the same motion reduces it further. If the error with the first half
is larger than with a spread half, the motion of the second half was new: other motion reduces it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.independence import thinned_weights
from lipcore.data.metrics import BlockScores, average_blocks
from lipcore.data.motion import Indices
from lipcore.data.samples import Samples
from lipcore.estimators.task import Task
from lipcore.model.torque_model import TorqueModel
from lipcore.training.refit import relearn


@dataclass(frozen=True)
class CurveOptions:
    """Parts of the training samples, and when they differ."""

    shares: tuple[float, ...] = (0.25, 0.5)
    """Shares of the samples that are spread over the recording."""
    pieces: int = 64
    """Pieces that the recording is divided into; a share is some of them, chosen at random."""
    piece_weight: float = 10.0
    """Min effective samples of a piece: a second."""
    min_pieces: int = 16
    """Min pieces of a curve."""
    min_gain: float = 0.1
    """Min gain from more samples, as a share of the error."""


OPTIONS = CurveOptions()


@dataclass(frozen=True)
class CurvePoint:
    """Error with a part of the training samples."""

    rows: int
    """Number of samples that were learnt."""
    spread: bool
    """Whether they were spread over the recording; else they are its beginning."""
    nmse: float
    """Mean of the joints' squared error / variance of the torque."""


@dataclass(frozen=True)
class LearningCurve:
    """Errors with parts of the training samples and with all, the fewest first."""

    points: tuple[CurvePoint, ...]
    more_helps: bool
    """Whether more samples of the same motion reduce the error beyond chance."""
    variety_helps: bool
    """Whether other motion reduces it beyond chance."""
    text: str
    """What to record next."""


def learning_curve(model: TorqueModel, task: Task, held_out: Samples) -> LearningCurve | None:
    """Return the learning curve of a model; None if the training has too few effective samples or no varying torque.

    task: with the samples that the model has learnt. Each part of them is learnt by `relearn`: geometry,
    hyperparameters and centres stay those of all samples. held_out: in order. Raise like `relearn`.
    """
    samples = task.samples
    order = np.lexsort((samples.t, samples.episode))
    weight = float(thinned_weights(samples.t[order]).sum())
    pieces = min(OPTIONS.pieces, int(weight / OPTIONS.piece_weight))
    if pieces < OPTIONS.min_pieces or not (np.ptp(held_out.tau, axis=0) > 0).any():
        return None
    piece = np.arange(len(samples)) * pieces // len(samples)
    shuffled = np.random.default_rng(0).permutation(pieces)

    def scores_of(learnt: TorqueModel) -> BlockScores:
        return BlockScores.of(held_out, learnt.predict_along(held_out).interval)

    def learn(chosen: Indices) -> tuple[int, BlockScores]:
        rows = order[np.isin(piece, chosen)]
        return len(rows), scores_of(relearn(model, task.on(samples.rows(np.sort(rows)))))

    spread = [learn(shuffled[: round(share * pieces)]) for share in OPTIONS.shares]
    first, every = learn(np.arange(pieces // 2)), (len(samples), scores_of(model))
    points = [CurvePoint(rows, True, _nmse(scores)) for rows, scores in (*spread, every)]
    more, variety = _excess(spread[-1][1], every[1]), _excess(first[1], spread[-1][1])
    found = []
    if more > 0:
        found.append(f"More of this motion would help: half of the samples give {_larger(more)}.")
    if variety > 0:
        found.append(f"Other motion would help: the first half of the samples gives {_larger(variety)}.")
    return LearningCurve(
        (*points[:-1], CurvePoint(first[0], False, _nmse(first[1])), points[-1]),
        more > 0,
        variety > 0,
        " ".join(found) or "More samples would hardly help: half of them give about the same error.",
    )


def _larger(excess: float) -> str:
    return f"a squared error that is typically {100 * excess:.0f} % larger"


def _nmse(scores: BlockScores) -> float:
    return float(scores.sums[:, 1].sum() / scores.rows.sum())


def _excess(fewer: BlockScores, more: BlockScores) -> float:
    """Return by how much the error is larger with fewer samples, as a share of it; zero if that may be chance.

    It is the geometric mean over the blocks, because few blocks often have most of the error.
    """
    ratios = np.log(np.maximum(fewer.sums[:, 1:], 1e-300) / np.maximum(more.sums[:, 1:], 1e-300))
    gain = average_blocks(fewer.rows, fewer.rows[:, None].astype(np.float64) * ratios)
    excess = float(np.expm1(gain.mean[0]))
    return excess if gain.significant[0] and excess > OPTIONS.min_gain else 0.0
