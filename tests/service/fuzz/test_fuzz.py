"""Generated requests to every operation of the OpenAPI document: answers are as documented, and never a failure."""

import pytest
import requests
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import CHECKS, load_all_checks

from tests.service.data import ADDRESS

NAMES = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
)
ENDLESS = ("GET /v1/jobs/{job}/events", "GET /v1/models/{model}/live")
"""Answers that end with the job, of one that stays queued never, and with the model."""
ANYTHING = ("POST /v1/echo",)
"""Operations that take any body."""
WAYS = {
    "what is there": ("fitting", GenerationMode.POSITIVE),
    "anything documented": ("document", GenerationMode.POSITIVE),
    "what is not documented": ("narrowed", GenerationMode.NEGATIVE),
}


def checks():
    load_all_checks()
    return [CHECKS.get_one(name) for name in NAMES]


def operations(fuzzed, part, mode):
    """Every operation that there are requests of, deletions last: what they delete, others ask for."""
    outcome = [result.ok() for result in getattr(fuzzed, part).get_all_operations()]
    if part == "fitting":
        outcome = [one for one in outcome if one.label not in ENDLESS]
    if mode is GenerationMode.NEGATIVE:  # nothing is wrong with a path that leads to nothing
        outcome = [one for one in outcome if (one.query or one.body) and one.label not in ANYTHING]
    return sorted(outcome, key=lambda one: one.method == "delete")


def send(client, case):
    """Send a request as schemathesis would, bytes and all."""
    prepared = requests.Request(**case.as_transport_kwargs(base_url=ADDRESS)).prepare()
    return client.request(prepared.method, prepared.url, content=prepared.body, headers=dict(prepared.headers))


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_answers_to_generated_requests(fuzzed, subtests, way):
    """Sixty requests of each operation."""
    (part, mode), chosen = WAYS[way], checks()
    for operation in operations(fuzzed, part, mode):

        @settings(
            max_examples=60,
            database=None,
            derandomize=True,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy(generation_mode=mode))
        def run(case):
            answer = send(fuzzed.client, case)
            fuzzed.tally[case.operation.label, answer.status_code] += 1
            case.validate_response(answer, checks=chosen)

        with subtests.test(operation.label):
            run()
