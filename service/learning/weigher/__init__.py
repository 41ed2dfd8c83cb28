"""The weigher process: it follows the payloads of streams, beside the service and at its priority."""
