"""Tests of both planes: connections, frames and publications."""
