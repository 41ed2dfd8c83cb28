"""Many clients at once for minutes: errors, memory, and whether every accepted write is there afterwards."""
