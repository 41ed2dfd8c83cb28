"""What monitoring reads at /metrics, in the format of Prometheus: computed when it is asked for."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from service.web.route import Route

EXAMPLE = """# HELP lipserve_requests_total Requests that were answered; 101: a stream, 499: the client went away before
# TYPE lipserve_requests_total counter
lipserve_requests_total{method="POST",route="/v1/models/{model}/predict",status="200"} 86400.0
# HELP lipserve_quality_coverage Share of measurements inside the 95 % interval, noise included
# TYPE lipserve_quality_coverage gauge
lipserve_quality_coverage{joint="panda_joint1",model="panda-sim",window="60"} 0.953
"""

router = APIRouter(tags=["health"], route_class=Route)


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Text of Prometheus, or OpenMetrics where that is accepted",
            "content": {"text/plain": {"example": EXAMPLE}},
        }
    },
)
def metrics(request: Request) -> Response:
    """Latency and errors of requests and streams, training jobs, quality and lag of models that learn, disk, memory,
    and which parts of the service are in order. docs/metrics.md lists all.
    """
    registry = CollectorRegistry()
    for collector in request.app.state.collectors:
        registry.register(collector)
    encode, media_type = choose_encoder(request.headers.get("accept", ""))
    return Response(encode(registry), media_type=media_type)
