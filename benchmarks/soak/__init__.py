"""Load by many clients: errors, memory, and a check that no acknowledged write is lost."""
