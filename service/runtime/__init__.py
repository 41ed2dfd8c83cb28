"""Work that is divided among processes, of this host or of a cluster."""
