"""Runs Python blocks in one namespace: reads code as lines of JSON, writes the output as lines of JSON."""

import contextlib
import io
import json
import sys
import traceback


def main() -> None:
    """Run every line of standard input."""
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
