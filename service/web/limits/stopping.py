"""That the service is about to stop, for those who should know before it does."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import Depends, Request


class Stopping:
    """begun: the service was told to stop, and says so, though it may still answer.

    closing: set when it takes no more connections: who would answer for long, as with events, ends now.
    """

    def __init__(self) -> None:
        self.begun = False
        self.closing = asyncio.Event()


async def _stopping(request: Request) -> Stopping:
    found: Stopping = request.app.state.stopping
    return found


StoppingDep = Annotated[Stopping, Depends(_stopping)]
