"""`lipserve` with chores every two seconds, as an hour of the laboratory's time is shorter.

Processes of the service import this module again: it must import nothing of ours.
"""

EVERY_S = 2.0
"""Seconds between two runs of the chores."""

if __name__ == "__main__":
    from service.__main__ import main
    from service.runtime import hourly

    hourly.EVERY_S = EVERY_S
    main()
