"""Refreshing a version in the background, and the contest that decides whether the new one takes over."""
