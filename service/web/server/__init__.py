"""What extends uvicorn: connections, sockets, and the protocol of streams. Held to its versions by a test."""
