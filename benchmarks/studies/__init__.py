"""Scripts that print figures of docs/numbers.md and CHANGELOG.md, or that tuned a constant of lipcore."""
