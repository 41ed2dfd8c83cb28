"""Binary WebSocket frames for control loops."""
