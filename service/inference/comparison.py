"""Compare two versions of a model on one data set, independent of any transport."""

from __future__ import annotations

from collections.abc import Collection
from math import isfinite

from lipcore.data import metrics
from lipcore.data.metrics import Comparison, Difference, TorqueDistribution, evaluate
from lipcore.data.samples import Samples
from service.contract import predictions as schema
from service.contract.states import Outcome
from service.foundation.errors import invalid_request
from service.foundation.fields import finite
from service.inference.evaluating import read_dataset
from service.models.evaluation import joint_figures
from service.models.loaded import LoadedModels, ServedModel


def compare(loaded: LoadedModels, model: str, request: schema.CompareRequest) -> schema.CompareResponse:
    """Compare two versions on a data set. Not for the event loop.

    Raise InvalidRequestError, NotFoundError, DamagedDataError or UnreadableVersionError.
    """
    first, second = versions = _versions(loaded, model, request)
    recorded = read_dataset(loaded, request.dataset, *versions)
    answers = [_answer(each, recorded.used) for each in versions]
    compared = metrics.compare(recorded.used, *answers)
    outcome, verdict = _verdict(first.version, second.version, compared)
    in_training = [each.has_learnt_from(recorded.id, recorded.sha256) for each in versions]
    return schema.CompareResponse(
        model=model,
        dataset=recorded.id,
        joint_names=list(first.model.joint_names),
        samples=recorded.samples,
        samples_used=len(recorded.used),
        blocks=compared.blocks,
        versions=[
            schema.VersionFigures(
                version=each.version,
                revision=each.revision,
                **joint_figures(evaluate(recorded.used.tau, *answer)),
                in_training=trained,
            )
            for each, answer, trained in zip(versions, answers, in_training, strict=True)
        ],
        differences=schema.JointDifferences(
            **{
                name: schema.Differences(**_lists(getattr(compared, name)))
                for name in schema.JointDifferences.model_fields
            }
        ),
        nlpd=_total(compared.total, 0),
        nmse=_total(compared.total, 1),
        outcome=outcome,
        better={"first_better": first.version, "second_better": second.version}.get(outcome),
        verdict=verdict,
        warnings=_warnings(versions, in_training),
    )


def _versions(loaded: LoadedModels, model: str, request: schema.CompareRequest) -> tuple[ServedModel, ServedModel]:
    first, second = (
        loaded.get(model, named, None) if isinstance(named, int) else loaded.get(model, None, named)
        for named in request.versions
    )
    if first.version == second.version:
        raise invalid_request("versions[1]", request.versions[1], f"another version than versions[0], {first.version}")
    return first, second


def _answer(served: ServedModel, samples: Samples) -> TorqueDistribution:
    answer = served.model.predict(samples.q, samples.dq, samples.ddq)
    return answer.interval


def _verdict(first: int, second: int, compared: Comparison) -> tuple[Outcome, str]:
    """Return the outcome of a comparison, as a code and in words."""
    if compared.blocks < metrics.MIN_BLOCKS:
        return "cannot_tell", (
            f"These data cannot tell: they make {compared.blocks} stretches of {metrics.BLOCK_S:g} s, or episodes, and "
            f"a verdict needs {metrics.MIN_BLOCKS}. Record longer, or more episodes."
        )
    total = compared.total
    (density, nmse), (clear, larger_or_smaller) = total.mean.tolist(), total.significant.tolist()
    better, worse = (first, second) if density > 0 else (second, first)
    if clear:
        outcome: Outcome = "first_better" if better == first else "second_better"
        text = (
            f"Version {better} predicts better than version {worse}: its negative log predictive density is lower by "
        )
    else:
        outcome, better = "no_difference", second
        text = f"These data show no difference between versions {first} and {second}: their negative log predictive "
        text += "densities differ by "
    text += f"{_amount(total, 0)} nats a sample (95 % interval)."
    if not isfinite(nmse):
        return outcome, text
    if not larger_or_smaller:
        return outcome, f"{text} Their mean nMSE differs by {_amount(total, 1)}, which shows no difference."
    smaller = (nmse < 0) == (better == second)
    text += f" The errors of version {better} are {'smaller' if smaller else 'larger'}: its mean nMSE is "
    text += f"{'lower' if smaller else 'higher'} by {_amount(total, 1)}."
    if clear and not smaller:
        text += " What is better is how true its stated uncertainty is."
    return outcome, text


def _amount(difference: Difference, place: int) -> str:
    return f"{abs(difference.mean[place]):.3g} ± {difference.half_width[place]:.2g}"


def _warnings(versions: Collection[ServedModel], in_training: Collection[bool]) -> list[str]:
    """Return the reasons why figures favour one of the versions."""
    warnings = []
    for served, trained in zip(versions, in_training, strict=True):
        if trained:
            warnings.append(f"version {served.version} was trained on this data set: its figures flatter it")
        if served.revision:
            warnings.append(
                f"version {served.version} has learnt online since, up to revision {served.revision}: where that was "
                "from the motion of this data set, its figures flatter it"
            )
    return warnings


def _lists(difference: Difference) -> dict[str, list[float | None]]:
    names = {"difference": difference.mean, "standard_error": difference.standard_error}
    return {name: finite(values) for name, values in {**names, "half_width": difference.half_width}.items()}


def _total(difference: Difference, place: int) -> schema.TotalDifference:
    return schema.TotalDifference(**{name: values[place] for name, values in _lists(difference).items()})
