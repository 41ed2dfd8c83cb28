"""What the service does when the learner process reports motion beyond a version, or the end of a contest."""

from __future__ import annotations

from service.context import Service
from service.learning.learner.messages import Contested, Published
from service.learning.refreshing import promotion, refresh


def attach(service: Service) -> None:
    """Let versions be refreshed and promoted by themselves; once, before the first observation comes."""

    def published(message: Published) -> None:
        refresh.consider(service.settings, service.database, service.jobs, message)

    def contested(message: Contested) -> None:
        promotion.decide(service.database, service.loaded, service.updates.learner.wake, message)

    service.updates.when_published.append(published)
    service.updates.when_contested.append(contested)
