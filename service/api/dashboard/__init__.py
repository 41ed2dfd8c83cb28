"""The dashboard: pages in plain JavaScript that use the same API as every other client."""
