"""Generated requests to every operation of the OpenAPI document: responses are as documented, and never a 500."""

import pytest
import requests
from hypothesis import HealthCheck, Phase, assume, given, settings
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
MAX_URL_LENGTH = 65536
"""Longest address that httpx sends."""
ENDLESS_RESPONSES = ("GET /v1/jobs/{job}/events", "GET /v1/models/{model}/live")
"""Responses that end only with the job or the model."""
ANY_BODY = ("POST /v1/echo",)
"""Operations that accept any body."""
REQUEST_KINDS = {
    "existing resources": ("fitting", GenerationMode.POSITIVE),
    "documented requests": ("document", GenerationMode.POSITIVE),
    "undocumented requests": ("narrowed", GenerationMode.NEGATIVE),
}


def checks():
    load_all_checks()
    return [CHECKS.get_one(name) for name in NAMES]


def operations(fuzzed, part, mode):
    """Return every operation that requests are generated for; deletions last, because other requests need the
    resources."""
    outcome = [result.ok() for result in getattr(fuzzed, part).get_all_operations()]
    if part == "fitting":
        outcome = [one for one in outcome if one.label not in ENDLESS_RESPONSES]
    if mode is GenerationMode.NEGATIVE:  # skip requests that are invalid only by their path
        outcome = [one for one in outcome if (one.query or one.body) and one.label not in ANY_BODY]
    return sorted(outcome, key=lambda one: one.method == "delete")


def send(client, case):
    """Send a request with the exact bytes that schemathesis generated; skip an address that the client refuses."""
    prepared = requests.Request(**case.as_transport_kwargs(base_url=ADDRESS)).prepare()
    assume(len(prepared.url) <= MAX_URL_LENGTH)
    return client.request(prepared.method, prepared.url, content=prepared.body, headers=dict(prepared.headers))


@pytest.mark.parametrize("kind", REQUEST_KINDS)
def test_responses_to_generated_requests_are_as_documented(fuzzed, subtests, kind):
    """Sixty requests of each operation."""
    (part, mode), chosen = REQUEST_KINDS[kind], checks()
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
