"""Extensions of uvicorn: connections, sockets, and the WebSocket protocol."""

HOLDS_FOR = {"uvicorn": ">=0.54,<0.60", "websockets": ">=15,<18"}
"""Supported versions; their internals are extended here. A test checks them against pyproject.toml."""
