"""The ingest of observation batches and frames into the log."""
