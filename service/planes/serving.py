"""The start of a service of two planes: listeners, shared memory, and the supervisor of all processes."""

from __future__ import annotations

import signal
import sys
from functools import partial

from service.api.oip import rpc
from service.foundation.settings import Settings
from service.planes import control, data
from service.planes.inheritance import DATA_PARTS, inheritance
from service.planes.preparation import share_memory
from service.planes.pulse import Plane
from service.planes.supervisor import STOPS, Child, Supervisor
from service.runtime import forking
from service.runtime.allocator import limit_heaps
from service.storage.storage import check_home


def serve(settings: Settings) -> None:
    """Serve until a signal. Raise HomeError, SocketError or ThreadsError; exit with the code of a failed start."""
    forking.call(check_home, settings)
    with inheritance(rpc.choose_port(settings)) as inherited:
        limit_heaps()
        share_memory(settings)
        forking.check_threads()
        forking.adopt_orphans()
        children = [
            Child(Plane.CONTROL, partial(control.run, inherited), "control"),
            *(Child(Plane.DATA, partial(data.run, inherited, part), "spare") for part in DATA_PARTS),
        ]
        ending = Supervisor(children, inherited.pulse, inherited.close_listeners).run()
    if ending < 0:  # as of a process without a handler; the first process of a container ends with 0
        signal.signal(-ending, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
        signal.raise_signal(-ending)
    elif ending:
        sys.exit(ending)
