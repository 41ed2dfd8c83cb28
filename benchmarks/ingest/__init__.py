"""How long a long recording takes from upload to report, and how much memory."""
