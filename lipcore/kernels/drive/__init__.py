"""The drive of each joint: friction between motor and link, linear in its coefficients."""
