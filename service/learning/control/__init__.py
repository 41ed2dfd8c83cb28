"""Control of a learning model by its owner: status, log, undoing, options and payloads."""
