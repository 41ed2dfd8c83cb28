"""The dashboard: pages in plain JavaScript that ask the same API as every other client."""
