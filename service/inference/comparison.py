"""Compare two versions of a model on one data set, independent of any transport."""

from __future__ import annotations

from collections.abc import Collection
from math import isfinite

from lipcore.data import metrics
from lipcore.data.metrics import Comparison, Difference
from service.contract import predictions as schema
from service.contract.states import Outcome
from service.foundation.errors import invalid_request
from service.foundation.fields import finite
from service.inference import texts
from service.inference.evaluating import judge, read_dataset
from service.models.loaded import LoadedModels, ServedModel
from service.storage.storage import Storage

FIGURES = ("nmse", "rmse", "coverage", "nlpd", "interval_width", "verdict")
"""Fields of an evaluation that a comparison has of each version."""


def compare(
    storage: Storage, versions: tuple[ServedModel, ServedModel], request: schema.CompareRequest
) -> schema.CompareResponse:
    """Compare two versions of a model on a data set; raise InvalidRequestError, NotFoundError or DamagedDataError."""
    first, second = versions
    recorded = read_dataset(storage, request.dataset, *versions)
    answers = [each.model.predict_along(recorded.used).interval for each in versions]
    compared = metrics.compare(recorded.used, *answers)
    outcome, verdict = _verdict(first.version, second.version, compared)
    in_training = [each.has_learnt_from(recorded.id, recorded.sha256) for each in versions]
    judged = [judge(storage, recorded, *each) for each in zip(versions, answers, in_training, strict=True)]
    return schema.CompareResponse(
        model=first.name,
        dataset=recorded.id,
        joint_names=list(first.model.joint_names),
        samples=recorded.samples,
        samples_used=len(recorded.used),
        blocks=compared.blocks,
        versions=[
            schema.VersionFigures(
                version=each.version,
                revision=each.revision,
                in_training=trained,
                **{name: figures[name] for name in FIGURES},
            )
            for each, trained, figures in zip(versions, in_training, judged, strict=True)
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


def find_versions(loaded: LoadedModels, model: str, request: schema.CompareRequest) -> tuple[ServedModel, ServedModel]:
    """Return the two versions of a comparison. Blocking: use it in a thread.

    Raise InvalidRequestError if they are the same, NotFoundError or UnreadableVersionError.
    """
    first, second = (
        loaded.get(model, named, None) if isinstance(named, int) else loaded.get(model, None, named)
        for named in request.versions
    )
    if first.version == second.version:
        raise invalid_request(
            "versions[1]", request.versions[1], f"another version than that of versions[0], {first.version}"
        )
    return first, second


def _verdict(first: int, second: int, compared: Comparison) -> tuple[Outcome, str]:
    """Return the outcome of a comparison, as a code and in words."""
    if compared.blocks < metrics.MIN_BLOCKS:
        return "cannot_tell", texts.describe_too_little(compared.blocks, metrics.BLOCK_S, metrics.MIN_BLOCKS)
    total = compared.total
    (density, nmse), (clear, larger_or_smaller) = total.mean.tolist(), total.significant.tolist()
    better, worse = (first, second) if density > 0 else (second, first)
    if clear:
        outcome: Outcome = "first_better" if better == first else "second_better"
        said = [texts.describe_better(better, worse, _amount(total, 0))]
    else:
        outcome, better = "no_difference", second
        said = [texts.describe_no_difference(first, second, _amount(total, 0))]
    smaller = (nmse < 0) == (better == second)
    if isfinite(nmse) and not larger_or_smaller:
        said.append(texts.describe_equal_errors(_amount(total, 1)))
    elif isfinite(nmse):
        said.append(texts.describe_errors(better, smaller, _amount(total, 1)))
        if clear and not smaller:
            said.append(texts.BETTER_UNCERTAINTY)
    return outcome, " ".join(said)


def _amount(difference: Difference, place: int) -> str:
    return f"{abs(difference.mean[place]):.3g} ± {difference.half_width[place]:.2g}"


def _warnings(versions: Collection[ServedModel], in_training: Collection[bool]) -> list[str]:
    """Return the reasons why figures favour one of the versions."""
    warnings = []
    for served, trained in zip(versions, in_training, strict=True):
        if trained:
            warnings.append(texts.describe_trained_on(served.version))
        if served.revision:
            warnings.append(texts.describe_learnt_online(served.version, served.revision))
    return warnings


def _lists(difference: Difference) -> dict[str, list[float | None]]:
    names = {"difference": difference.mean, "standard_error": difference.standard_error}
    return {name: finite(values) for name, values in {**names, "half_width": difference.half_width}.items()}


def _total(difference: Difference, place: int) -> schema.TotalDifference:
    return schema.TotalDifference(**{name: values[place] for name, values in _lists(difference).items()})
