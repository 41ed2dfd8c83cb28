"""Sends the events of alarms to the operator's webhook, at least once each, in a thread of its own.

Events are rows of the database. A sender claims an event by moving its next attempt into the future. So several
services share the work, and no event is lost if one of them ends. An acknowledged event is deleted.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from prometheus_client.core import Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from service import __version__
from service.foundation.settings import Settings
from service.journal.alarms import EVENT_AGE_S
from service.storage.database import AlarmEventRow, Database
from service.telemetry.meters import MetricKind

logger = logging.getLogger(__name__)

SIGNATURE = "LIPServe-Signature"
"""Header with the time of sending and the HMAC-SHA256 of time and body: `t=1767225600,v1=5f0c…`."""
POLL_S = 1.0
"""Seconds between two reads of the database. Other processes add events, too."""
ANSWER_S = 10.0
"""Timeout of connecting, and of each part of an answer, s."""
CLOSE_S = 2.0
"""Seconds that a stopping service waits for a running attempt."""
RETRY_S, MAX_RETRY_S = 30.0, 3600.0
"""Seconds from the first attempt to the second. They double with each attempt up to a max. An attempt is shorter."""
OUTCOMES = ("delivered", "failed", "dropped")


def sign(secret: str, body: bytes, at: int) -> str:
    """Return the value of `SIGNATURE` for a body sent at a Unix time, s."""
    digest = hmac.new(secret.encode(), b"%d.%b" % (at, body), hashlib.sha256).hexdigest()
    return f"t={at},v1={digest}"


class Webhook(Collector):
    """The sender of one service, and its metrics. It sends nothing if LIPSERVE_ALARM_WEBHOOK is not set.

    clock: Unix time, s.
    """

    sent = MetricKind(
        "counter",
        "lipserve_webhook_total",
        "Attempts to send an alarm to the webhook since the start of the service; dropped: older than a day",
        ("outcome",),
    )
    waiting = MetricKind("gauge", "lipserve_webhook_waiting", "Events of alarms that the webhook has not acknowledged")

    def __init__(self, database: Database, settings: Settings, clock: Callable[[], float] = time.time) -> None:
        self._database, self._clock = database, clock
        self._url, secret = settings.alarm_webhook, settings.alarm_webhook_secret
        self._secret = "" if secret is None else secret.get_secret_value()
        self._counts = dict.fromkeys(OUTCOMES, 0)
        self._failing = False
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread that sends."""
        if self._url is not None:
            logging.getLogger("httpx").setLevel(logging.WARNING)  # it logs each request with its URL, often a secret
            self._thread = threading.Thread(target=self._run, name="webhook", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop after the running attempt. The next start sends the events that are left."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def describe(self) -> list[Metric]:
        """Return nothing: the number of waiting events is in the database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield every metric. Without a webhook, the number of waiting events is zero."""
        yield self.sent.of(([outcome], count) for outcome, count in self._counts.items())
        waiting = 0
        if self._url is not None:
            with self._database.session() as session:
                waiting = session.scalar(select(func.count()).select_from(AlarmEventRow)) or 0
        yield self.waiting.of([((), waiting)])

    def send_next(self) -> bool:
        """Send the event that is due first. Return whether the receiver acknowledged it. The call blocks."""
        event = self._claim()
        if event is None:
            return False
        error = self._post(event.body)
        self._counts["failed" if error else "delivered"] += 1
        if error is None:
            with self._database.transaction() as session:
                if (row := session.get(AlarmEventRow, event.seq)) is not None:
                    session.delete(row)
        self._log(error)
        return error is None

    def _claim(self) -> AlarmEventRow | None:
        """Return the event that is due first, and schedule its next attempt. Delete events that are too old."""
        moment = self._clock()
        first = select(AlarmEventRow).where(AlarmEventRow.due <= moment).order_by(AlarmEventRow.due, AlarmEventRow.seq)
        with self._database.session() as session:
            if session.scalar(first.limit(1)) is None:  # a transaction would block other writers
                return None
        with self._database.transaction() as session:
            for row in session.scalars(first):
                if moment - row.at <= EVENT_AGE_S:
                    row.attempts += 1
                    row.due = moment + min(RETRY_S * 2.0 ** min(row.attempts - 1, 10), MAX_RETRY_S)
                    break
                session.delete(row)
                self._counts["dropped"] += 1
            else:
                return None
        return row

    def _post(self, body: dict[str, Any]) -> str | None:
        """Send one event. Return the reason of a failure, or None if the receiver acknowledged it."""
        import httpx  # noqa: PLC0415 - 20 MB that only a service with a webhook needs

        assert self._url is not None
        content = json.dumps(body).encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"lipserve/{__version__}",
            SIGNATURE: sign(self._secret, content, int(self._clock())),
        }
        try:
            with httpx.stream("POST", self._url, content=content, headers=headers, timeout=ANSWER_S) as answer:
                return None if answer.is_success else f"it answered {answer.status_code}"  # the body is not read
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            return f"{type(error).__name__}: {error}"

    def _log(self, error: str | None) -> None:
        """Log the first failure, and the first success after it."""
        if error is not None and not self._failing:
            logger.warning("the webhook of LIPSERVE_ALARM_WEBHOOK fails (%s); alarms are sent again for a day", error)
        elif error is None and self._failing:
            logger.info("the webhook of LIPSERVE_ALARM_WEBHOOK works again")
        self._failing = error is not None

    def _run(self) -> None:
        pause = 0.0
        while not self._ended.wait(pause):
            try:
                pause = 0.0 if self.send_next() else POLL_S
            except Exception:  # the database may be unreachable
                if self._ended.is_set():
                    return
                if pause < RETRY_S:  # once
                    logger.exception("the alarms for the webhook cannot be read; retrying")
                pause = RETRY_S
