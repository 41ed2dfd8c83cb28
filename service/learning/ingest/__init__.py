"""A batch of observations on its way into the log."""
