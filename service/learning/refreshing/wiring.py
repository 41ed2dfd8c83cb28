"""What the service does when the learner process reports motion beyond a version, or the end of a contest."""

from __future__ import annotations

from service.learning.learner.messages import Contested, Published
from service.learning.refreshing import promotion, refresh
from service.learning.updates import Updates
from service.training.queue import JobQueue


def attach(updates: Updates, jobs: JobQueue) -> None:
    """Let versions be refreshed and promoted by themselves; once, before the first observation comes."""

    def published(message: Published) -> None:
        refresh.consider(updates.settings, updates.database, jobs, message)

    def contested(message: Contested) -> None:
        promotion.decide(updates.database, updates.loaded, updates.learner.wake, message)

    updates.when_published.append(published)
    updates.when_contested.append(contested)
