"""Runs Python blocks in one namespace: lines of JSON with code in, lines of JSON with what it printed out."""

import contextlib
import io
import json
import os
import sys
import traceback

from service.foundation import settings


def main() -> None:
    """Answer every line on standard input."""
    settings.DEFAULT_URL = os.environ["LIPSERVE_URL"]  # the port that a reader's service has is taken here
    namespace = {"__name__": "__main__"}
    for line in sys.stdin:
        printed, error = io.StringIO(), None
        with contextlib.redirect_stdout(printed):
            try:
                exec(compile(json.loads(line), "<block>", "exec"), namespace)
            except Exception:
                error = traceback.format_exc()
        sys.stdout.write(json.dumps({"printed": printed.getvalue(), "error": error}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
