"""The weigher process: it follows what streams carry, beside the service and at its priority."""
