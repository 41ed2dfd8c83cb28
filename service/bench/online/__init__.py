"""`lipserve bench online` and `bench durability`: learning while serving, under load, over a change, and over kills."""
