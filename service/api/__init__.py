"""Everything that speaks HTTP, WebSocket or gRPC: it translates requests into calls, and results into answers."""
