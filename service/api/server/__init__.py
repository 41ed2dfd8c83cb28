"""What extends uvicorn: connections, sockets, and the protocol of streams."""

HOLDS_FOR = {"uvicorn": ">=0.54,<0.60", "websockets": ">=15,<18"}
"""Versions whose internals these extend: a test compares them with what is installed and with pyproject.toml."""
