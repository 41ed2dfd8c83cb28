"""Time and memory from the upload of a long recording to its report."""
