"""Learning while serving: under load, over a change, and over kills."""
