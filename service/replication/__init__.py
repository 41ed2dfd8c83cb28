"""Several services on one database: what one has changed, the others take in."""
